"""The adversary of WASP's imagined rollouts, and its calibrated budget. Artifact:
`adversary.safetensors` (+ .json), `curve.json`, `quality.json`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs.adversary import AdversaryConfig
from wasp_cli.stages.base import Job


class AdversaryStage:
    """See the module."""

    kind = "adversary"
    config = AdversaryConfig
    settings: tuple[str, ...] = ("returns",)
    needs: tuple[str, ...] = ("dataset", "world_model", "latents", "policies", "heldout")

    def run(self, job: Job) -> Mapping[str, Any]:
        """Calibrate the budget on the held-out episodes of the dataset, train the adversary within
        it, and measure how it changes the imagined cost of the expert's held-out decisions.
        """
        import torch

        from wasp_cli.learning.adversary import DENSITY_ROWS, calibrate, effect, train_adversary
        from wasp_cli.learning.heldout import load_heldout
        from wasp_cli.learning.latents import load_latents
        from wasp_cli.learning.rounding import rounded
        from wasp_cli.learning.shards import HELD_OUT, read_shards
        from wasp_cli.models.adversary import Adversary
        from wasp_cli.models.policy import load_skills
        from wasp_cli.models.weights import save_weights
        from wasp_cli.models.world_model import load_world_model
        from wasp_cli.seeds import derive

        config = cast(AdversaryConfig, job.config)
        gamma_c = job.settings["returns"].gamma_c
        model = load_world_model(job.inputs["world_model"])
        latents = load_latents(job.inputs["latents"])
        skills = load_skills(job.inputs["policies"])
        recording = read_shards(job.inputs["dataset"], ["action", "first", "episode"])
        held_out = recording.held_out(HELD_OUT)
        sizes: dict[str, Any] = {
            "deter": model.sizes.deter,
            "variables": model.sizes.variables,
            "classes": model.sizes.classes,
            "hidden": [config.hidden, config.hidden],
            "largest": config.largest,
            "mass": config.mass,
        }
        torch.manual_seed(derive("adversary-weights", job.task, job.seed))
        adversary = Adversary(**sizes)

        # -- the density, in the precision in which it is stored
        rows = torch.from_numpy(~held_out).nonzero().squeeze(1)
        places = torch.linspace(0, len(rows) - 1, min(DENSITY_ROWS, len(rows))).long()
        adversary.learn_data(latents.at(rows[places]).features)
        adversary.whiten.copy_(adversary.whiten.half())
        adversary.centre.copy_(adversary.centre.half())

        # -- the budget; the images of the held-out episodes are freed afterwards
        seen = read_shards(job.inputs["dataset"], [model.reads, "first", "episode"], held_out)
        held_out_latents = latents.rows(torch.from_numpy(held_out))
        budget = calibrate(adversary, model, held_out_latents, seen, config.alpha)
        del seen

        # -- training
        stream = derive("adversary", job.task, job.seed)
        curve = train_adversary(
            adversary, model, skills, recording, latents, config, gamma_c, stream, job.progress
        )
        save_weights(rounded(adversary), job.out_dir / "adversary.safetensors", **sizes)
        (job.out_dir / "curve.json").write_text(json.dumps(curve, indent=1))

        # -- its effect
        heldout = load_heldout(job.inputs["heldout"])
        stream = derive("adversary-effect", job.task, job.seed)
        costs = effect(
            adversary, model, skills, heldout.latent, heldout.a_h, config.horizon, gamma_c, stream
        )
        quality = {"budget": budget, "expert": costs}
        (job.out_dir / "quality.json").write_text(json.dumps(quality, indent=1))
        return {
            "radius": round(budget["radius"], 4),
            "threshold": round(budget["threshold"], 4),
            "covered": round(budget["covered"], 4),
            "cost_at_0": round(costs["cost_at_0"], 4),
            "cost_at_1": round(costs["cost_at_1"], 4),
        }
