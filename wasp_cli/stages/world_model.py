"""World model: its encoder is taught on single images, Eq. 6 trains the whole, and the heads are
refitted. Artifact: `world_model.safetensors` (+ .json), `curves.json`.
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
"""Names of the terms of the loss in the summary, by the weight that multiplies each."""
OF_VECTORS = {"beta_o": "vector_loss", "ahead_o": "imagined_vector_loss"}
"""The names that differ for a model that sees vectors."""


class WorldModelStage:
    """See the module."""

    kind = "world_model"
    config = WorldModelConfig
    settings = ("action_repeat",)
    needs: tuple[str, ...] = ("dataset",)

    def run(self, job: Job) -> Mapping[str, Any]:
        """Teach the encoder, train the model, encode the dataset with it, and refit the heads. An
        interrupted training goes on from its checkpoint.
        """
        import numpy as np
        import torch
        from numpy.typing import NDArray

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
        allowed = ~recording.held_out(HELD_OUT)
        rows = np.flatnonzero(allowed)

        def stream(role: str) -> int:
            return derive(role, job.task, job.seed)

        def during(low: float, high: float) -> learning.Report:
            return lambda share, text: job.progress(low + (high - low) * share, text)

        # -- the untrained model
        torch.manual_seed(stream("world-model-weights"))
        unit = unit_of(job.task, recording.reward[allowed & (recording.first == 0)])
        if recording.reads == "state":
            config = config.model_copy(update=untaught(config, recording))
            vectors = standard_of(recording.state)
            model = learning.build(config, recording.action.shape[1], vectors, unit)
        else:
            model = learning.build(config, recording.action.shape[1], reward_unit=unit)
            model.mean_image.copy_(learning.mean_image(recording))
        model.to(training_device())

        # -- mirrors; the mirror image of a vector is not known
        mirror: NDArray[np.float32] | None = None
        if config.mirror and model.reads == "pixels":
            matrix = TASKS[job.task].mirror
            if matrix is not None:
                mirror = np.array(matrix, np.float32)
        mirror_of_privileged = privileged_mirror(job.task)

        # -- the head on the privileged vector
        readout: Readout | None = None
        if config.privileged:
            torch.manual_seed(stream("world-model-readout"))
            readout = new_readout(model, recording, rows, config)

        # -- the encoder; an interrupted teaching begins anew, and ends with the same bytes
        teaching_file = job.work_dir / "teaching.json"
        if config.taught and not has_training(job.work_dir):
            teaching_curve = teach_encoder(
                model,
                recording,
                rows,
                config,
                stream("world-model-teaching"),
                during(0.0, 0.1),
                mirror=mirror_of_privileged if config.mirror else None,
            )
            teaching_file.write_text(json.dumps(teaching_curve))

        # -- the whole model
        curves, skipped = learning.train(
            model,
            recording,
            rows,
            config,
            config.updates,
            stream("world-model"),
            job.work_dir,
            during(0.1, 0.85),
            readout=readout,
            mirror=mirror,
            privileged_mirror=mirror_of_privileged,
        )
        model.requires_grad_(False)

        # -- the heads, on latents of the trained model
        latents = encode(model, recording, during(0.85, 0.95))
        learning.refit_heads(
            model,
            recording,
            latents,
            allowed,
            config,
            stream("world-model-refit"),
            during(0.95, 1.0),
        )

        # -- store
        model.cpu()
        save_world_model(rounded(model), job.out_dir)
        if teaching_file.exists():
            curves["teaching"] = json.loads(teaching_file.read_text())
        (job.out_dir / "curves.json").write_text(json.dumps(curves))
        terms = TERMS | OF_VECTORS if model.reads == "state" else TERMS
        summary: dict[str, Any] = {
            f"final_{terms[name]}": round(values[-1], 4)
            for name, values in curves.items()
            if values and name in terms
        }
        summary["skipped"] = skipped
        return summary
