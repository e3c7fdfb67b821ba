"""CSA's consistency model of expert actions. Artifact: `consistency.safetensors` (+ .json),
`quality.json` (see `learning.consistency`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs.consistency import ConsistencyConfig
from wasp_cli.stages.base import Job

STEPS = 40  # of the teacher, with which one step of the student is compared
RATIO = 0.4  # of the ladder, at which they are compared


class ConsistencyStage:
    """See the module."""

    kind = "consistency"
    config = ConsistencyConfig
    settings: tuple[str, ...] = ()
    needs: tuple[str, ...] = ("expert", "dataset", "latents")

    def run(self, job: Job) -> Mapping[str, Any]:
        """Train on the expert's own actions at recorded states, and judge it on held-out ones."""
        import torch

        from wasp_cli.learning.consistency import (
            consistency_quality,
            one_step_error,
            train_consistency,
        )
        from wasp_cli.learning.labelled import load_labelled
        from wasp_cli.learning.rounding import rounded
        from wasp_cli.learning.sampling import generator
        from wasp_cli.models.weights import save_weights
        from wasp_cli.seeds import derive

        config = cast(ConsistencyConfig, job.config)
        states = load_labelled(job.inputs)
        torch.manual_seed(derive("consistency-weights", job.task, job.seed))
        stream = derive("consistency", job.task, job.seed)
        trained = train_consistency(
            states.recording, states.labels, states.latents, config, stream, job.progress
        )
        student = trained.student
        save_weights(
            rounded(student),
            job.out_dir / "consistency.safetensors",
            features=states.latents.features,
            action=states.labels.shape[1],
            width=config.width,
            depth=config.depth,
        )

        # -- quality on held-out decisions
        held_out = states.held_out()
        source = generator(derive("consistency-quality", job.task, job.seed))
        commands = {
            "expert": held_out.expert,
            "recorded": held_out.executed,
            "uniform": 2 * torch.rand(tuple(held_out.expert.shape), generator=source) - 1,
        }
        quality = consistency_quality(student, held_out.features, held_out.expert, commands)
        (job.out_dir / "quality.json").write_text(json.dumps(quality, indent=1))
        gap = one_step_error(
            student, trained.teacher, held_out.features, held_out.executed, RATIO, STEPS
        )
        distances = quality["recorded"]
        return {
            **trained.numbers,
            "one_step_error": round(gap, 4),
            "off_expert": round(distances["0"]["conformity"], 3),
            "off_expert_assisted": round(distances[f"{RATIO:g}"]["conformity"], 3),
        }
