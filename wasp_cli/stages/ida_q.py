"""IDA's Q ensemble. Artifact: `ensemble.safetensors` (+ .json), `curve.json` (TD loss),
`pairs.parquet` and `quality.json`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs.baselines import EnsembleConfig
from wasp_cli.stages.base import Job

COMPARED = 2000  # about as many recorded states compare the expert's action with its opposite


class IDAQStage:
    """See the module."""

    kind = "ida_q"
    config = EnsembleConfig
    settings = ("action_repeat", "returns")
    needs: tuple[str, ...] = ("dataset", "latents", "policies", "heldout")

    def run(self, job: Job) -> Mapping[str, Any]:
        """Train on the latents of the dataset, and compare Q with real discounted sums and the
        expert's action with its opposite.
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
        stream = derive("ida", job.task, job.seed)
        gamma = job.settings["returns"].gamma_r
        is_decision = ~recording.held_out(HELD_OUT) & (recording.first == 0)
        unit = unit_of(job.task, recording.reward[is_decision])
        ensemble, curve = train_ensemble(
            skills, recording, latents, config, gamma, stream, job.progress, unit
        )
        save_weights(
            rounded(ensemble),
            job.out_dir / "ensemble.safetensors",
            members=config.members,
            features=latents.features,
            action=recording.action.shape[1],
            hidden=list(config.hidden),
        )
        (job.out_dir / "curve.json").write_text(json.dumps(curve))

        # -- how far Q of the expert's action lies above that of its opposite
        with torch.inference_mode():
            stride = max(1, len(latents.h) // COMPARED)
            features = latents.at(torch.arange(0, len(latents.h), stride)).features
            expert = skills.expert(features)
            gap = (ensemble(features, expert) - ensemble(features, -expert)).mean()

        # -- Q beside what really followed
        found = heldout_pairs(ensemble, load_heldout(job.inputs["heldout"]), gamma, unit)
        numbers = quality(found)
        (job.out_dir / "quality.json").write_text(json.dumps(numbers, indent=1))
        write_pairs(job.out_dir / "pairs.parquet", {"Q": found})
        return {
            "td_loss": curve[-1],
            "expert_over_opposite": float(gap),
            "rank": numbers["rank"],
            "predicted_over_real": numbers["predicted_over_real"],
            "cut_off": numbers["cut_off"],
        }
