"""V_r and V_c. Artifact: `critics.safetensors` (+ .json), `curve.json`, `pairs.parquet`,
`quality.json` (`learning.critic_quality`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs.latent import CriticsConfig
from wasp_cli.stages.base import Job

SUMMARY = ("rank", "predicted_over_real", "cut_off")
"""Numbers of the quality of each critic that the summary shows."""


class CriticsStage:
    """See the module."""

    kind = "critics"
    config = CriticsConfig
    settings = ("action_repeat", "returns")
    needs: tuple[str, ...] = ("dataset", "world_model", "latents", "policies", "heldout")

    def run(self, job: Job) -> Mapping[str, Any]:
        """Train, then compare the critics with real discounted sums."""
        import torch

        from wasp_cli.learning.critic_quality import heldout_pairs, quality, write_pairs
        from wasp_cli.learning.critics import train_critics
        from wasp_cli.learning.heldout import load_heldout
        from wasp_cli.learning.latents import load_latents
        from wasp_cli.learning.rounding import rounded
        from wasp_cli.learning.shards import read_shards
        from wasp_cli.models.policy import load_skills
        from wasp_cli.models.weights import save_weights
        from wasp_cli.models.world_model import load_world_model
        from wasp_cli.seeds import derive

        config = cast(CriticsConfig, job.config)
        model = load_world_model(job.inputs["world_model"])
        latents = load_latents(job.inputs["latents"])
        recording = read_shards(
            job.inputs["dataset"], ["action", "reward", "cost", "terminal", "first", "episode"]
        )
        skills = load_skills(job.inputs["policies"])
        returns = job.settings["returns"]
        torch.manual_seed(derive("critics-weights", job.task, job.seed))
        stream = derive("critics", job.task, job.seed)
        critics, curve = train_critics(
            model, skills, recording, latents, config, returns, stream, job.progress
        )
        save_weights(
            rounded(critics),
            job.out_dir / "critics.safetensors",
            features=model.feature_size,
            hidden=list(config.hidden),
            bins=config.bins,
            reach=config.reach,
        )
        (job.out_dir / "curve.json").write_text(json.dumps(curve, indent=1))

        # -- predictions beside what really followed, by critic: 'r' and 'c'
        found = heldout_pairs(critics, load_heldout(job.inputs["heldout"]), returns)
        numbers = {name: quality(of_critic) for name, of_critic in found.items()}
        (job.out_dir / "quality.json").write_text(json.dumps(numbers, indent=1))
        by_title = {f"V_{name}": of_critic for name, of_critic in found.items()}
        write_pairs(job.out_dir / "pairs.parquet", by_title)
        summary: dict[str, float | None] = {}
        for name, of_critic in numbers.items():
            for number in SUMMARY:
                value = of_critic[number]
                summary[f"{number}_{name}"] = None if value is None else round(value, 3)
        return summary
