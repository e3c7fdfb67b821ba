"""Policies: latent actors distilled from every expert checkpoint, then trained on what they meet
when they drive.

Artifact: `skills.safetensors` (+ .json); `evaluation.json`: every skill beside its privileged
checkpoint on the same episodes, every round, how much of the labels the actors explain, and how
alike they act on both kinds of latents; `reinforcement.json` where a policy was reinforced. Rounds
are judged on episodes of their own, so that the choice of a round does not bias the evaluation. An
interrupted stage begins anew.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs.latent import PoliciesConfig
from wasp_cli.stages.base import Job
from wasp_cli.stages.expert_limit import chosen_allowance, expert_limit
from wasp_cli.stages.finite import finite_json

LIMIT_BATCHES = 4
"""Batches of `evaluation_episodes` episodes of the privileged expert, whose mean cost bounds that
of the reinforced policy.
"""


class PoliciesStage:
    """See the module."""

    kind = "policies"
    config = PoliciesConfig
    settings = ("action_repeat",)
    needs: tuple[str, ...] = ("expert", "dataset", "world_model", "latents")

    def run(self, job: Job) -> Mapping[str, Any]:
        """Distil the checkpoints, label on policy until the latent expert is good enough, reinforce
        it where that is not reached, and evaluate every skill.
        """
        import copy

        import torch

        from wasp_cli.learning import policies as learning
        from wasp_cli.learning import verdicts
        from wasp_cli.learning.latents import load_latents
        from wasp_cli.learning.privileged import evaluate_privileged
        from wasp_cli.learning.reinforce import reinforce
        from wasp_cli.learning.rounding import rounded
        from wasp_cli.learning.shards import HELD_OUT, read_shards
        from wasp_cli.models.policy import (
            PrivilegedPolicy,
            checkpoint_fractions,
            load_privileged,
            save_skills,
        )
        from wasp_cli.models.world_model import load_world_model
        from wasp_cli.seeds import derive
        from wasp_cli.tasks.make import make_task
        from wasp_cli.tasks.registry import TASKS

        # -- the allowed cost, which may follow from the limit of the expert
        config = cast(PoliciesConfig, job.config)
        allowance: dict[str, float] = {}
        if config.cost_allowance == "auto":
            allowance["cost_allowance"] = chosen_allowance(expert_limit(job.inputs["expert"]))
            config = config.model_copy(update=allowance)

        # -- what is learned from
        fractions = checkpoint_fractions(job.inputs["expert"])
        experts = [load_privileged(job.inputs["expert"], fraction) for fraction in fractions]
        recording = read_shards(job.inputs["dataset"], ["privileged", "action", "first", "episode"])
        model = load_world_model(job.inputs["world_model"])
        success_goals = TASKS[job.task].success_goals

        def seed(role: str, *parts: int) -> int:
            return derive(role, job.task, job.seed, *parts)

        def task(batch: int, *observe: str) -> Any:
            return make_task(
                job.task,
                batch,
                action_repeat=job.settings["action_repeat"],
                observe=observe,
                threads=job.threads,
            )

        def during(low: float, high: float) -> learning.Report:
            return lambda share, text: job.progress(low + (high - low) * share, text)

        # -- how the privileged and the latent policies are judged, on the same episodes
        privileged_task = task(config.evaluation_episodes, "privileged")
        latent_task = task(config.evaluation_episodes, model.reads)
        env_steps = privileged_task.max_decisions * job.settings["action_repeat"]

        def drive_privileged(policy: PrivilegedPolicy, seeds: list[int]) -> verdicts.Drive:
            sums = evaluate_privileged(privileged_task, policy, seeds)
            return verdicts.Drive.of(
                sums.returns, sums.costs, sums.goals, success_goals, sums.env_steps
            )

        def drive_latent(fraction: float, seeds: list[int]) -> verdicts.Drive:
            loop = learning.latent_episodes(latent_task, model, skills, fraction, seeds)
            return verdicts.Drive.of(
                loop.reward.sum(0),
                loop.cost_env.sum(0),
                loop.goals.sum(0),
                success_goals,
                loop.env_steps.sum(0),
            )

        judge_seeds = [seed("policies-judge", i) for i in range(config.evaluation_episodes)]
        reference = drive_privileged(experts[-1], judge_seeds)

        # -- distillation
        labelled = learning.label(
            model,
            experts,
            recording,
            load_latents(job.inputs["latents"]),
            config.imagined_depth,
            seed("policies-prior"),
        )
        held_out = torch.from_numpy(recording.held_out(HELD_OUT))
        recorded = labelled.rows(~held_out)
        held_out_rows = labelled.rows(held_out)
        torch.manual_seed(seed("policies-weights"))
        skills = learning.new_skills(experts, fractions, model.feature_size, config)
        learning.fit(
            skills, recorded, [], config.updates, config, seed("policies"), during(0.0, 0.3)
        )

        # -- labelling rounds, each judged; round 0 is the distillation
        visited: list[learning.Labelled] = []
        weights: list[dict[str, torch.Tensor]] = []  # of every round
        judged: list[verdicts.Verdict] = []  # of every round
        rounds: list[dict[str, Any]] = []  # of every round, for `evaluation.json`

        def judge(name: str, share: float, **facts: Any) -> None:
            """Compare the latent expert with the privileged one, and remember its weights."""
            drive = drive_latent(fractions[-1], judge_seeds)
            verdict = verdicts.compare(drive, reference, config, env_steps)
            judged.append(verdict)
            weights.append(copy.deepcopy(skills.state_dict()))
            rounds.append({**facts, **drive.shown(), **verdict._asdict()})
            job.progress(
                share,
                f"{name}: return {drive.return_:.1f} of {reference.return_:.1f}, cost "
                f"{drive.cost:.1f} of {reference.cost:.1f}",
            )

        def label_round(number: int, share: float) -> None:
            """Let the latent policies drive, label what they visit, and fit them again."""
            episodes = config.labelling_episodes
            visited_recording, visited_latents = learning.visit(
                task(episodes, model.reads, "privileged"),
                model,
                skills,
                learning.drivers(episodes, len(experts), config.driver_share),
                [seed("policies-visit", number, i) for i in range(episodes)],
                seed("policies-drive", number),
                during(share, share),
            )
            visited.append(
                learning.label(
                    model,
                    experts,
                    visited_recording,
                    visited_latents,
                    config.imagined_depth,
                    seed("policies-prior", number),
                )
            )
            learning.fit(
                skills,
                recorded,
                visited,
                config.labelling_updates,
                config,
                seed("policies", number),
                during(share, share + 0.05),
            )

        for number in range(config.labelling_rounds + 1):
            share = 0.3 + 0.3 * number / (config.labelling_rounds + 1)
            if number:
                label_round(number, share)
            rows = sum(part.labels.shape[1] for part in visited)
            judge(f"round {number}", share + 0.05, labelled=rows)
            if judged[-1].reached:
                break

        # -- reinforcement of the best round, where labels alone were not enough
        best = verdicts.best_round(judged)
        close_enough = (
            judged[best].return_share >= config.reinforce.return_share
            and not judged[best].excess_cost
        )
        if not (judged[best].reached or close_enough) and config.reinforce.interactions:
            skills.load_state_dict(weights[best])
            # The cost limit follows from episodes of its own. They are many, because none of them
            # needs a camera.
            drives = []
            for k in range(LIMIT_BATCHES):
                limit_seeds = [
                    seed("policies-limit", k, i) for i in range(config.evaluation_episodes)
                ]
                drives.append(drive_privileged(experts[-1], limit_seeds))
            limit = verdicts.cost_limit(drives, rounds[best]["env_steps"], config, env_steps)
            better, curve = reinforce(
                skills.expert,
                task(config.reinforce.envs, model.reads),
                model,
                config.reinforce,
                limit,
                job.task,
                seed("policies-reinforce"),
                during(0.6, 0.9),
            )
            skills.expert.load_state_dict(better.state_dict())
            judge("reinforced", 0.9, reinforced=int(curve[-1]["interactions"]), cost_limit=limit)
            (job.out_dir / "reinforcement.json").write_text(finite_json(curve))

        # -- the best of all
        kept_round = verdicts.best_round(judged)
        skills.load_state_dict(weights[kept_round])
        save_skills(
            rounded(skills), job.out_dir, model.feature_size, config.hidden, model.action_size
        )

        # -- evaluation of every skill, on other episodes
        seeds = [seed("policies-evaluation", i) for i in range(config.evaluation_episodes)]
        evaluation: dict[str, Any] = {}
        for number, fraction in enumerate(fractions):
            share = 0.9 + 0.1 * number / len(fractions)
            job.progress(share, f"evaluating the skill at {fraction:g}")
            latent = drive_latent(fraction, seeds)
            privileged = drive_privileged(experts[number], seeds)
            evaluation[f"{fraction:g}"] = {
                "latent": latent.shown(),
                "privileged": privileged.shown(),
                **verdicts.compare(latent, privileged, config, env_steps)._asdict(),
            }
        explained = learning.explained(skills, held_out_rows)
        agreement = learning.agreement(skills, held_out_rows)
        document = {
            "skills": evaluation,
            "rounds": rounds,
            "kept_round": kept_round,
            "judged_against": reference.shown(),
            "explained": explained,
            "agreement": agreement,
        }
        (job.out_dir / "evaluation.json").write_text(finite_json(document))

        # -- summary, of the expert
        expert = f"{fractions[-1]:g}"
        final = evaluation[expert]
        return {
            "return": final["latent"]["return"],
            "cost": final["latent"]["cost"],
            "privileged_return": final["privileged"]["return"],
            "privileged_cost": final["privileged"]["cost"],
            "return_share": final["return_share"],
            "return_share_se": final["return_share_se"],
            "cost_ratio": final["cost_ratio"],
            "reached": final["reached"],
            "rounds": sum("labelled" in row for row in rounds) - 1,
            "kept_round": kept_round,
            "reinforced": "reinforced" in rounds[kept_round],
            "explained": round(explained[expert]["filtered"], 3),
            "explained_imagined": round(explained[expert]["imagined"], 3),
            "agreement": round(agreement[expert], 3),
            **allowance,
        }
