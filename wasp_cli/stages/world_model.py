"""World model: an encoder of images taught on them, Eq. 6, a refit of the heads. Artifact:
`world_model.safetensors` (+ .json), `curves.json`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs.world import WorldModelConfig
from wasp_cli.stages.base import Job

TERMS = {
    "alpha_q": "kl_representation",
    "alpha_p": "kl_prediction",
    "beta_o": "image_loss",
    "beta_r": "reward_loss",
    "beta_c": "cost_loss",
    "beta_n": "continuation_loss",
    "ahead_r": "imagined_reward_loss",
    "ahead_c": "imagined_cost_loss",
    "ahead_o": "imagined_image_loss",
    "privileged": "privileged_loss",
    "teaching": "teaching_error",
}
"""The terms of the loss by the weight that multiplies them, named for people."""
OF_VECTORS = {"beta_o": "vector_loss", "ahead_o": "imagined_vector_loss"}
"""What is called otherwise of a model that sees vectors."""


class WorldModelStage:
    """See the module."""

    kind = "world_model"
    config = WorldModelConfig
    settings = ("action_repeat",)
    needs: tuple[str, ...] = ("dataset",)

    def run(self, job: Job) -> Mapping[str, Any]:
        """Train, encode, refit."""
        import numpy as np
        import torch

        from wasp_cli.learning import world_model as learning
        from wasp_cli.learning.checkpoint import has_training
        from wasp_cli.learning.device import training_device
        from wasp_cli.learning.encoding import encode
        from wasp_cli.learning.privileged_state import (
            Readout,
            new_readout,
            teach_encoder,
            untaught,
        )
        from wasp_cli.learning.reward_unit import unit_of
        from wasp_cli.learning.rounding import rounded
        from wasp_cli.learning.shards import HELD_OUT, read_shards
        from wasp_cli.models.vectors import standard_of
        from wasp_cli.models.world_model import save_world_model
        from wasp_cli.seeds import derive
        from wasp_cli.tasks.privileged_layout import privileged_mirror
        from wasp_cli.tasks.registry import TASKS

        config = cast(WorldModelConfig, job.config)
        recording = read_shards(job.inputs["dataset"])
        learned = ~recording.held_out(HELD_OUT)
        names = (job.task, job.seed)
        torch.manual_seed(derive("world-model-weights", *names))
        unit = unit_of(job.task, recording.reward[learned & (recording.first == 0)])
        if recording.reads == "state":
            config = config.model_copy(update=untaught(config, recording))
            vectors = standard_of(recording.state)
            model = learning.build(config, recording.action.shape[1], vectors, unit)
        else:
            model = learning.build(config, recording.action.shape[1], reward_unit=unit)
            model.mean_image.copy_(learning.mean_image(recording))
        model.to(training_device())

        def during(low: float, high: float) -> learning.Report:
            return lambda share, text: job.progress(low + (high - low) * share, text)

        rows, seed = np.flatnonzero(learned), derive("world-model", *names)
        # What a vector is in a mirror is not known.
        mirrors = config.mirror and model.reads == "pixels"
        matrix = TASKS[job.task].mirror if mirrors else None
        mirror, turned = (
            None if matrix is None else np.array(matrix, np.float32),
            privileged_mirror(job.task),
        )
        readout: Readout | None = None
        if config.privileged:
            torch.manual_seed(derive("world-model-readout", *names))
            readout = new_readout(model, recording, rows, config)
        teaching = job.work_dir / "teaching.json"
        if config.taught and not has_training(job.work_dir):
            # Not resumed: an interrupted teaching begins anew, and ends with the same bytes.
            shown, teaching_seed = (
                turned if config.mirror else None,
                derive("world-model-teaching", *names),
            )
            taught = teach_encoder(
                model, recording, rows, config, teaching_seed, during(0.0, 0.1), mirror=shown
            )
            teaching.write_text(json.dumps(taught))
        curves, skipped = learning.train(
            model,
            recording,
            rows,
            config,
            config.updates,
            seed,
            job.work_dir,
            during(0.1, 0.85),
            readout=readout,
            mirror=mirror,
            privileged_mirror=turned,
        )
        model.requires_grad_(False)
        latents = encode(model, recording, during(0.85, 0.95))
        learning.refit_heads(
            model,
            recording,
            latents,
            learned,
            config,
            derive("world-model-refit", *names),
            during(0.95, 1.0),
        )
        model.cpu()
        save_world_model(rounded(model), job.out_dir)
        if teaching.exists():
            curves["teaching"] = json.loads(teaching.read_text())
        (job.out_dir / "curves.json").write_text(json.dumps(curves))
        terms = TERMS | (OF_VECTORS if model.reads == "state" else {})
        summary = {
            f"final_{terms[name]}": round(values[-1], 4)
            for name, values in curves.items()
            if values and name in terms
        }
        return {**summary, "skipped": skipped}
