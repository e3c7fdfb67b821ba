"""CSA's consistency model of expert actions.

Artifact: `consistency.safetensors` (+ .json with its sizes), `quality.json` (on held-out episodes: how near one step brings commands to the
expert's actions and how far from the commands, see `learning.consistency`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs.consistency import ConsistencyConfig
from wasp_cli.stages.base import Job

QUALITY_ROWS = 4000
"""Held-out decisions at which the student is judged."""
STEPS = 40
"""Of the teacher, in whose place the student has one."""


class ConsistencyStage:
    """See the module."""

    kind = "consistency"
    config = ConsistencyConfig
    settings = ("action_repeat",)
    needs: tuple[str, ...] = ("expert", "dataset", "latents")

    def run(self, job: Job) -> Mapping[str, Any]:
        """Train on the expert's own actions at recorded states, and judge it on held-out ones."""
        import numpy as np
        import torch

        from wasp_cli.learning.consistency import consistency_quality, one_step_error, train_consistency
        from wasp_cli.learning.latents import load_latents
        from wasp_cli.learning.sampling import generator
        from wasp_cli.learning.shards import HELD_OUT, read_shards
        from wasp_cli.models.policy import load_privileged
        from wasp_cli.models.weights import save_weights
        from wasp_cli.seeds import derive

        config = cast(ConsistencyConfig, job.config)
        recording = read_shards(job.inputs["dataset"], ["privileged", "action", "cost_env", "first", "episode", "behaviour"])
        with torch.inference_mode():
            labels = load_privileged(job.inputs["expert"], 1.0)(torch.from_numpy(recording.privileged))
        latents = load_latents(job.inputs["latents"])
        torch.manual_seed(derive("consistency-weights", job.task, job.seed))
        seed = derive("consistency", job.task, job.seed)
        student, teacher, summary = train_consistency(
            recording, labels.clone(), latents, config, job.settings["action_repeat"], seed, job.progress
        )
        features = latents.h.shape[1] + latents.z.shape[1] * latents.classes
        save_weights(
            student, job.out_dir / "consistency.safetensors",
            features=features, action=labels.shape[1], width=config.width, depth=config.depth,
        )  # fmt: skip
        # The action at row i + 1 is what was executed at the state of row i.
        held = torch.from_numpy(np.flatnonzero(recording.held_out(HELD_OUT)[:-1] & ~recording.first[1:].astype(bool)))
        held = held[:: max(1, len(held) // QUALITY_ROWS)]
        seen, expert, recorded = latents.at(held).features, labels[held], torch.from_numpy(recording.action)[held + 1]
        uniform = 2 * torch.rand(tuple(expert.shape), generator=generator(derive("consistency-quality", job.task, job.seed))) - 1
        quality = consistency_quality(student, seen, expert, {"expert": expert, "recorded": recorded, "uniform": uniform})
        (job.out_dir / "quality.json").write_text(json.dumps(quality, indent=1))
        gap = one_step_error(student, teacher, seen, recorded, 0.4, STEPS)
        asked, given = (quality["recorded"][ratio]["conformity"] for ratio in ("0", "0.4"))
        return summary | {"one_step_error": round(gap, 4), "off_expert": round(asked, 3), "off_expert_assisted": round(given, 3)}
