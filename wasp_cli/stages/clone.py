"""Clone: a policy fitted to the commands of one operator, where the planner is not to know its rule (`wasp.operator_model: cloned`).

Artifact: `clone.safetensors` (+ .json), `curve.json` (negative log-likelihood) and `quality.json` (how well the clone, the true rule, the
expert and the last command foretell the next command on held-out episodes; see `learning.clone`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs.latent import CloneConfig
from wasp_cli.stages.base import Job

DRIVING, TRAINING = 0.5, 0.7
"""Shares of the progress at which the episodes to learn from have been driven, and the clone is trained."""


class CloneStage:
    """See the module. One for every operator and severity of a grid."""

    kind = "clone"
    config = CloneConfig
    settings = ("action_repeat",)
    needs: tuple[str, ...] = ("world_model", "policies")

    def run(self, job: Job) -> Mapping[str, Any]:
        """Let the operator drive alone, fit the clone, and judge it on other episodes."""
        import torch

        from wasp_cli.learning.clone import Foreteller, fit_clone, issued, judged
        from wasp_cli.learning.closed_loop import Loop, run_episodes
        from wasp_cli.methods.base import Assistant
        from wasp_cli.methods.human import HumanOnly
        from wasp_cli.models.policy import load_skills
        from wasp_cli.models.weights import save_weights
        from wasp_cli.models.world_model import load_world_model
        from wasp_cli.operators.base import DrawnNoise, EpisodeNoise, Operator, OperatorContext, build_operator
        from wasp_cli.operators.cloned import ClonedOperator
        from wasp_cli.seeds import derive
        from wasp_cli.tasks.make import make_task

        config = cast(CloneConfig, job.config)
        variant, value = job.axes["variant"], job.axes["value"]
        model, skills = load_world_model(job.inputs["world_model"]), load_skills(job.inputs["policies"])

        def drive(part: str, count: int, assistant: Assistant, begun: float, share: float, *, keep_latents: bool = False) -> Loop:
            def streams(role: str) -> list[int]:
                return [derive(f"clone-{part}-{role}", job.task, job.seed, variant, value, i) for i in range(count)]

            task = make_task(job.task, count, action_repeat=job.settings["action_repeat"], observe=("pixels",), threads=job.threads)
            context = OperatorContext(skills.at, task.action_size, task.decision_seconds)
            operator = build_operator(variant, value, context, EpisodeNoise(streams("operator")), count)
            seeds = streams("episode"), streams("draws")
            return run_episodes(
                task, model, operator, assistant, *seeds, keep_latents=keep_latents,
                progress=lambda done, text: job.progress(begun + share * done, f"{part}: {text}"),
            )  # fmt: skip

        seen = issued(drive("learned", config.episodes, HumanOnly(), 0.0, DRIVING, keep_latents=True))
        torch.manual_seed(derive("clone-weights", job.task, job.seed, variant, value))
        stream = derive("clone", job.task, job.seed, variant, value)
        clone, curve = fit_clone(
            seen, skills.expert, config, stream, lambda share, text: job.progress(DRIVING + (TRAINING - DRIVING) * share, text)
        )
        arguments = {"features": seen.features.shape[1], "hidden": list(config.hidden), "action": seen.command.shape[1]}
        save_weights(clone, job.out_dir / "clone.safetensors", **arguments)
        (job.out_dir / "curve.json").write_text(json.dumps(curve, indent=1))

        nothing = DrawnNoise(torch.zeros(0, config.heldout_episodes, 0))
        cloned = ClonedOperator(clone, skills.expert, seen.command.shape[1], nothing, config.heldout_episodes)
        models = {
            "cloned": lambda operator, a_h: cloned.after(a_h, nothing),
            "rule": lambda operator, a_h: operator,
            "expert": lambda operator, a_h: Operator(skills.expert, a_h.shape[1], nothing, len(a_h)),
        }
        told = Foreteller(models, config.draws, derive("clone-draws", job.task, job.seed, variant, value))
        quality = judged(told, drive("held out", config.heldout_episodes, told, TRAINING, 1.0 - TRAINING))
        ways = dict(zip(("repeat", "own", "uniform"), clone.weight_logits.softmax(-1).tolist(), strict=True))
        document = {"ways": ways, "spread": clone.spread.tolist(), "models": quality}
        (job.out_dir / "quality.json").write_text(json.dumps(document, indent=1))
        figures = {f"{name}_{figure}": round(number, 3) for name, row in quality.items() for figure, number in row.items()}
        return figures | {name: round(share, 3) for name, share in ways.items()}
