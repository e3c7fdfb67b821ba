"""CSA's consistency model of expert actions. Artifact: `consistency.safetensors` (+ .json),
`quality.json` (see `learning.consistency`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs.consistency import ConsistencyConfig
from wasp_cli.stages.base import Job

STEPS = 40  # of the teacher, in whose place the student has one


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
        seed = derive("consistency", job.task, job.seed)
        student, teacher, summary = train_consistency(*states, config, seed, job.progress)
        save_weights(
            rounded(student),
            job.out_dir / "consistency.safetensors",
            features=states.features,
            action=states.labels.shape[1],
            width=config.width,
            depth=config.depth,
        )
        seen, expert, recorded = states.held_out()
        uniform = (
            2
            * torch.rand(
                tuple(expert.shape),
                generator=generator(derive("consistency-quality", job.task, job.seed)),
            )
            - 1
        )
        quality = consistency_quality(
            student, seen, expert, {"expert": expert, "recorded": recorded, "uniform": uniform}
        )
        (job.out_dir / "quality.json").write_text(json.dumps(quality, indent=1))
        gap = one_step_error(student, teacher, seen, recorded, 0.4, STEPS)
        asked, given = (quality["recorded"][ratio]["conformity"] for ratio in ("0", "0.4"))
        return summary | {
            "one_step_error": round(gap, 4),
            "off_expert": round(asked, 3),
            "off_expert_assisted": round(given, 3),
        }
