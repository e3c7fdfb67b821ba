"""Look ahead: the probability of any cost within the next decisions, straight from a latent and the next commands.

Artifact: `lookahead.safetensors` (+ .json), `curve.json` (its loss) and `quality.json` (on held-out episodes, under the commands that were
executed, beside the world model's rolled-out sum; see `learning.lookahead`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs.latent import LookaheadConfig
from wasp_cli.stages.base import Job
from wasp_cli.stages.finite import finite_json

TRAINING = 0.9
"""Share of the progress that the training takes."""


class LookaheadStage:
    """See the module."""

    kind = "lookahead"
    config = LookaheadConfig
    settings = ("action_repeat", "returns")
    needs: tuple[str, ...] = ("dataset", "world_model", "latents")

    def run(self, job: Job) -> Mapping[str, Any]:
        """Learn from the recorded rows, then judge on the held-out ones."""
        import torch

        from wasp_cli.learning.latents import load_latents
        from wasp_cli.learning.lookahead import decisions, foreseen, judged, rolled_out, train_lookahead, what_followed
        from wasp_cli.learning.shards import HELD_OUT, read_shards
        from wasp_cli.models.weights import save_weights
        from wasp_cli.models.world_model import load_world_model
        from wasp_cli.seeds import derive

        config = cast(LookaheadConfig, job.config)
        recording = read_shards(job.inputs["dataset"], ["action", "cost", "terminal", "episode"])
        latents = load_latents(job.inputs["latents"])
        torch.manual_seed(derive("lookahead-weights", job.task, job.seed))
        stream = derive("lookahead", job.task, job.seed)
        model, curve = train_lookahead(recording, latents, config, stream, lambda share, text: job.progress(TRAINING * share, text))
        arguments = {"features": latents.h.shape[1] + latents.z.shape[1] * latents.classes, "action": recording.action.shape[1]}
        sizes = {"members": config.members, "commands": config.commands, "hidden": list(config.hidden), "horizon": config.horizon}
        save_weights(model, job.out_dir / "lookahead.safetensors", **arguments, **sizes)
        (job.out_dir / "curve.json").write_text(json.dumps(curve, indent=1))
        job.progress(TRAINING, "judging on held-out episodes")
        rows = decisions(recording)
        ahead = what_followed(recording, rows[recording.held_out(HELD_OUT)[rows]], config.horizon)
        world, gamma = load_world_model(job.inputs["world_model"]), job.settings["returns"].gamma_c
        summed = rolled_out(world, latents, ahead, gamma, config.samples, derive("lookahead-rolled-out", job.task, job.seed))
        quality = judged(recording, ahead, foreseen(model, latents, ahead), summed)
        (job.out_dir / "quality.json").write_text(finite_json(quality))
        names = ("base", "auprc", "sum_auprc", "onset_auprc", "sum_onset_auprc", "predicted_over_base")
        return {f"{name}@{window}": round(row[name], 3) for window, row in quality.items() for name in names}
