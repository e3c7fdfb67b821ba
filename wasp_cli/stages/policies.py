"""Policies: latent actors distilled from every expert checkpoint, then trained on what they meet
when they drive.

Artifact: `skills.safetensors` (+ .json); `evaluation.json`: every skill beside its privileged
checkpoint on the same episodes, every round, how much of the labels the actors explain, and how
alike they act on both kinds of latents; `reinforcement.json` where there was one. Rounds are judged
on episodes of their own, so that the choice does not flatter the evaluation. An interrupted stage
begins anew.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs.latent import PoliciesConfig
from wasp_cli.stages.base import Job
from wasp_cli.stages.expert_limit import chosen_allowance, expert_limit
from wasp_cli.stages.finite import finite_json

# times `evaluation_episodes` of the privileged expert, whose cost bounds that of the reinforcement
LIMIT_BATCHES = 4


class PoliciesStage:
    """See the module."""

    kind = "policies"
    config = PoliciesConfig
    settings = ("action_repeat",)
    needs: tuple[str, ...] = ("expert", "dataset", "world_model", "latents")

    def run(self, job: Job) -> Mapping[str, Any]:
        """Distil; label on policy until the latent expert is good enough, or else reinforce it;
        evaluate every skill.
        """
        import copy

        import torch

        from wasp_cli.learning import policies as learning
        from wasp_cli.learning import verdicts as verdict
        from wasp_cli.learning.latents import load_latents
        from wasp_cli.learning.privileged import EpisodeSums, evaluate_privileged
        from wasp_cli.learning.reinforce import reinforce
        from wasp_cli.learning.rounding import rounded
        from wasp_cli.learning.shards import HELD_OUT, read_shards
        from wasp_cli.models.policy import checkpoint_fractions, load_privileged, save_skills
        from wasp_cli.models.world_model import load_world_model
        from wasp_cli.seeds import derive
        from wasp_cli.tasks.make import make_task
        from wasp_cli.tasks.registry import TASKS

        config = cast(PoliciesConfig, job.config)
        allowed: dict[str, float] = {}
        if config.cost_allowance == "auto":
            allowed["cost_allowance"] = chosen_allowance(expert_limit(job.inputs["expert"]))
            config = config.model_copy(update=allowed)
        fractions = checkpoint_fractions(job.inputs["expert"])
        experts = [load_privileged(job.inputs["expert"], f) for f in fractions]
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

        # -- the two drivers on the same episodes
        blind, sighted = (
            task(config.evaluation_episodes, "privileged"),
            task(config.evaluation_episodes, model.reads),
        )

        def drive(sums: EpisodeSums) -> verdict.Drive:
            return verdict.Drive.of(
                sums.returns, sums.costs, sums.goals, success_goals, sums.env_steps
            )

        def latent(index: int, seeds: list[int]) -> verdict.Drive:
            loop = learning.latent_episodes(sighted, model, skills, fractions[index], seeds)
            return verdict.Drive.of(
                loop.reward.sum(0),
                loop.cost_env.sum(0),
                loop.goals.sum(0),
                success_goals,
                loop.env_steps.sum(0),
            )

        env_steps = blind.max_decisions * job.settings["action_repeat"]
        judges = [seed("policies-judge", i) for i in range(config.evaluation_episodes)]
        wanted = drive(evaluate_privileged(blind, experts[-1], judges))

        # -- distillation
        labelled = learning.label(
            model,
            experts,
            recording,
            load_latents(job.inputs["latents"]),
            config.imagined_depth,
            seed("policies-prior"),
        )
        held = torch.from_numpy(recording.held_out(HELD_OUT))
        recorded, rest = labelled.rows(~held), labelled.rows(held)
        torch.manual_seed(seed("policies-weights"))
        skills = learning.new_skills(experts, fractions, model.feature_size, config)
        learning.fit(
            skills, recorded, [], config.updates, config, seed("policies"), during(0.0, 0.3)
        )

        # -- labelling rounds
        visited: list[learning.Labelled] = []
        weights: list[dict[str, torch.Tensor]] = []
        verdicts: list[verdict.Verdict] = []
        rounds: list[dict[str, Any]] = []

        def judge(said: str, at: float, **how: Any) -> None:
            found = latent(-1, judges)
            verdicts.append(verdict.compare(found, wanted, config, env_steps))
            weights.append(copy.deepcopy(skills.state_dict()))
            rounds.append({**how, **found.shown(), **verdicts[-1]._asdict()})
            job.progress(
                at,
                f"{said}: return {found.return_:.1f} of {wanted.return_:.1f}, cost "
                f"{found.cost:.1f} of {wanted.cost:.1f}",
            )

        for number in range(config.labelling_rounds + 1):
            low = 0.3 + 0.3 * number / (config.labelling_rounds + 1)
            if number:
                behind = task(config.labelling_episodes, model.reads, "privileged")
                rows = learning.drivers(
                    config.labelling_episodes, len(experts), config.driver_share
                )
                seeds = [
                    seed("policies-visit", number, i) for i in range(config.labelling_episodes)
                ]
                met, latents = learning.visit(
                    behind,
                    model,
                    skills,
                    rows,
                    seeds,
                    seed("policies-drive", number),
                    during(low, low),
                )
                visited.append(
                    learning.label(
                        model,
                        experts,
                        met,
                        latents,
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
                    during(low, low + 0.05),
                )
            judge(
                f"round {number}",
                low + 0.05,
                labelled=sum(part.labels.shape[1] for part in visited),
            )
            if verdicts[-1].reached:
                break

        # -- reinforcement
        best = verdict.best_round(verdicts)
        close_enough = (
            verdicts[best].return_share >= config.reinforce.return_share
            and not verdicts[best].excess_cost
        )
        if not (verdicts[best].reached or close_enough) and config.reinforce.interactions:
            skills.load_state_dict(weights[best])
            # Its limit comes from episodes of their own, and many, since none of them needs a
            # camera.
            batches = [
                [seed("policies-limit", k, i) for i in range(config.evaluation_episodes)]
                for k in range(LIMIT_BATCHES)
            ]
            taught = [drive(evaluate_privileged(blind, experts[-1], seeds)) for seeds in batches]
            limit = verdict.cost_limit(taught, rounds[best]["env_steps"], config, env_steps)
            alone = task(config.reinforce.envs, model.reads)
            better, curve = reinforce(
                skills.expert,
                alone,
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
        kept = verdict.best_round(verdicts)
        skills.load_state_dict(weights[kept])
        save_skills(
            rounded(skills), job.out_dir, model.feature_size, config.hidden, model.action_size
        )

        # -- evaluation
        seeds = [seed("policies-evaluation", i) for i in range(config.evaluation_episodes)]
        evaluation: dict[str, Any] = {}
        for index, fraction in enumerate(fractions):
            job.progress(
                0.9 + 0.1 * index / len(fractions), f"evaluating the skill at {fraction:g}"
            )
            both = latent(index, seeds), drive(evaluate_privileged(blind, experts[index], seeds))
            judged = verdict.compare(*both, config, env_steps)
            evaluation[f"{fraction:g}"] = {
                "latent": both[0].shown(),
                "privileged": both[1].shown(),
                **judged._asdict(),
            }
        shares, agree = learning.explained(skills, rest), learning.agreement(skills, rest)
        written = {
            "skills": evaluation,
            "rounds": rounds,
            "kept_round": kept,
            "judged_against": wanted.shown(),
            "explained": shares,
            "agreement": agree,
        }
        (job.out_dir / "evaluation.json").write_text(finite_json(written))
        final = evaluation[f"{fractions[-1]:g}"]
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
            "kept_round": kept,
            "reinforced": "reinforced" in rounds[kept],
            "explained": round(shares[f"{fractions[-1]:g}"]["filtered"], 3),
            "explained_imagined": round(shares[f"{fractions[-1]:g}"]["imagined"], 3),
            "agreement": round(agree[f"{fractions[-1]:g}"], 3),
            **allowed,
        }
