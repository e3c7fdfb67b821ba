"""IDA's Q ensemble. Artifact: `ensemble.safetensors` (+ .json), `curve.json` (TD loss),
`pairs.parquet` and `quality.json`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs.baselines import EnsembleConfig
from wasp_cli.stages.base import Job


class IDAQStage:
    """See the module."""

    kind = "ida_q"
    config = EnsembleConfig
    settings = ("action_repeat", "returns")
    needs: tuple[str, ...] = ("dataset", "latents", "policies", "heldout")

    def run(self, job: Job) -> Mapping[str, Any]:
        """Train on the dataset's latents; say how far Q tells the expert's action from a random
        one.
        """
        import torch

        from wasp_cli.learning.critic_quality import quality, write_pairs
        from wasp_cli.learning.ensemble import heldout_pairs, train_ensemble
        from wasp_cli.learning.heldout import load_heldout
        from wasp_cli.learning.latents import load_latents
        from wasp_cli.learning.reward_unit import unit_of
        from wasp_cli.learning.rounding import rounded
        from wasp_cli.learning.shards import HELD_OUT, read_shards
        from wasp_cli.models.policy import load_skills
        from wasp_cli.models.weights import save_weights
        from wasp_cli.seeds import derive

        config = cast(EnsembleConfig, job.config)
        recording = read_shards(
            job.inputs["dataset"], ["action", "reward", "terminal", "first", "episode", "behaviour"]
        )
        latents = load_latents(job.inputs["latents"])
        skills = load_skills(job.inputs["policies"])
        torch.manual_seed(derive("ida-weights", job.task, job.seed))
        seed, gamma = derive("ida", job.task, job.seed), job.settings["returns"].gamma_r
        decided = ~recording.held_out(HELD_OUT) & (recording.first == 0)
        unit = unit_of(job.task, recording.reward[decided])
        ensemble, curve = train_ensemble(
            skills, recording, latents, config, gamma, seed, job.progress, unit
        )
        features = latents.h.shape[1] + latents.z.shape[1] * latents.classes
        arguments = {
            "members": config.members,
            "features": features,
            "action": recording.action.shape[1],
            "hidden": list(config.hidden),
        }
        save_weights(rounded(ensemble), job.out_dir / "ensemble.safetensors", **arguments)
        with torch.inference_mode():
            seen = latents.at(
                torch.arange(0, len(latents.h), max(1, len(latents.h) // 2000))
            ).features
            expert = skills.expert(seen)
            gap = (ensemble(seen, expert) - ensemble(seen, -expert)).mean()
        found = heldout_pairs(ensemble, load_heldout(job.inputs["heldout"]), gamma, unit)
        judged = quality(found)
        (job.out_dir / "curve.json").write_text(json.dumps(curve))
        (job.out_dir / "quality.json").write_text(json.dumps(judged, indent=1))
        write_pairs(job.out_dir / "pairs.parquet", {"Q": found})
        told = {name: judged[name] for name in ("rank", "predicted_over_real", "cut_off")}
        return {"td_loss": curve[-1], "expert_over_opposite": float(gap), **told}
