"""SafeRL-Res on tasks whose operators know more than assistants perceive: it is trained behind operators who do.

Artifact: as that of `residual`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs.baselines import ResidualConfig
from wasp_cli.stages.base import Job
from wasp_cli.stages.finite import finite_json
from wasp_cli.stages.residual import ResidualStage


class InformedResidualStage(ResidualStage):
    """See the module."""

    needs = (*ResidualStage.needs, "expert")

    def run(self, job: Job) -> Mapping[str, Any]:
        """Train and store the mean residual."""
        from wasp_cli.learning.residual import train_residual
        from wasp_cli.models.policy import Skills
        from wasp_cli.models.weights import save_weights
        from wasp_cli.models.world_model import load_world_model
        from wasp_cli.operators.informed import Knowledge
        from wasp_cli.tasks.make import make_task

        config = cast(ResidualConfig, job.config)
        model = load_world_model(job.inputs["world_model"])
        task = make_task(job.task, config.envs, action_repeat=job.settings["action_repeat"], observe=("pixels",), threads=job.threads)
        judged = json.loads((job.inputs["policies"] / "evaluation.json").read_text())["skills"]
        alone = judged[max(judged, key=float)]["privileged"]["return"]
        known = cast(Skills, Knowledge(job.inputs["expert"], task))  # nobody imagines here, so that `at` is all that is asked of it
        policy, curve = train_residual(task, model, known, config, job.task, job.seed, job.progress, expert_return=alone)
        save_weights(
            policy, job.out_dir / "residual.safetensors", features=model.feature_size, action=task.action_size, hidden=list(config.hidden)
        )
        (job.out_dir / "curve.json").write_text(finite_json(curve))
        return {name: curve[-1][name] for name in ("interactions", "cost_per_1000", "multiplier")}
