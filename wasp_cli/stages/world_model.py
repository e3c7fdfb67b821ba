"""World model: Eq. 6 on sequences, refit of the heads on prior latents, latents of the whole dataset.

Artifact: `world_model.safetensors` (+ .json sizes), `latents.safetensors` (h float16, z class indices, one row per recorded row),
`open_loop.json` (held-out quality per imagined step), `curves.json`, `reconstruction.png`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs import WorldModelConfig
from wasp_cli.stages.base import Job

TERMS = {
    "alpha_q": "kl_representation", "alpha_p": "kl_prediction", "beta_o": "image_loss", "beta_r": "reward_loss", "beta_c": "cost_loss",
    "beta_n": "continuation_loss",
}  # fmt: skip
"""The terms of Eq. 6 by the weight that multiplies them, named for people."""
HELD_OUT = 0.1
"""Share of the episodes that no gradient sees."""


class WorldModelStage:
    """See the module."""

    kind = "world_model"
    config = WorldModelConfig
    settings = ("action_repeat",)
    needs: tuple[str, ...] = ("dataset",)
    previous = True

    def run(self, job: Job) -> Mapping[str, Any]:
        """Train, encode, refit, judge."""
        import torch

        from wasp_cli.learning import world_model as learning
        from wasp_cli.learning.pictures import reconstruction_sheet
        from wasp_cli.learning.replay import read_replay
        from wasp_cli.seeds import derive

        config = cast(WorldModelConfig, job.config)
        replay = read_replay(job.inputs["dataset"])
        held = replay.held_out(HELD_OUT)
        seen = replay.rows(~held)
        torch.manual_seed(derive("world-model-weights", job.task, job.seed))
        model = learning.build(config, replay.action.shape[1])

        def during(low: float, high: float) -> learning.Report:
            return lambda share, text: job.progress(low + (high - low) * share, text)

        curves = learning.train(model, seen, config, derive("world-model", job.task, job.seed), job.work_dir, during(0.0, 0.8))
        model.requires_grad_(False)
        latents = learning.encode(model, replay, during(0.8, 0.92))
        model.reward_head.requires_grad_(True)
        model.cost_head.requires_grad_(True)
        rows = torch.from_numpy(~held)
        own = learning.Latents(latents.h[rows], latents.z[rows], latents.classes)
        learning.refit_heads(model, seen, own, config, derive("world-model-refit", job.task, job.seed), during(0.92, 0.98))
        model.requires_grad_(False)

        learning.save_world_model(model, job.out_dir)
        learning.save_latents(latents, job.out_dir)
        rows = torch.from_numpy(held)
        test = learning.Latents(latents.h[rows], latents.z[rows], latents.classes)
        quality = learning.open_loop(model, replay.rows(held), test, config.refit_horizon, derive("world-model-judge", job.task, job.seed))
        (job.out_dir / "open_loop.json").write_text(json.dumps(quality, indent=1))
        (job.out_dir / "curves.json").write_text(json.dumps(curves))
        reconstruction_sheet(model, replay.rows(held), test, job.out_dir / "reconstruction.png")
        shown = ("auprc", "persistence", "predicted_over_base", "reward_r2")
        summary = {f"{name}@{row['k']}": round(row[name], 3) for row in quality if row["k"] in (5, 1, 15) for name in shown}
        return summary | {f"final_{TERMS[name]}": round(values[-1], 4) for name, values in curves.items() if values}
