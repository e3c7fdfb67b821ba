"""Counterfactual branches of a cell (section 5.3 of the paper). Artifact: `branches.parquet`
(see `store.branches`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs.judged import CounterfactualConfig
from wasp_cli.stages.base import Job


class CounterfactualStage:
    """See the module. The assistant does not decide again: what it executed is stored."""

    kind = "counterfactual"
    config = CounterfactualConfig
    settings = ("action_repeat", "side_by_side")
    needs: tuple[str, ...] = ("world_model", "policies", "heldout")
    needs_informed = ("expert",)

    def run(self, job: Job) -> Mapping[str, Any]:
        """Play the episodes of the cell again, and branch at their interventions.

        Raises:
            TrainingError: no held-out episode of the expert is as long as the window.
        """
        import numpy as np

        from wasp_cli import seeds
        from wasp_cli.errors import TrainingError
        from wasp_cli.learning.closed_loop import batches
        from wasp_cli.learning.counterfactual import Branch, branches, least_gain, sampled
        from wasp_cli.learning.heldout import load_heldout
        from wasp_cli.learning.informed import informed_policies, observed
        from wasp_cli.learning.rerun import Recorded, Rerun
        from wasp_cli.metrics.necessity import ALONE, ASSISTED, necessity
        from wasp_cli.models.policy import load_skills
        from wasp_cli.models.world_model import load_world_model
        from wasp_cli.operators.base import EpisodeNoise, OperatorContext, build_operator
        from wasp_cli.store.branches import (
            BRANCHES_FILE,
            BranchedCell,
            BranchRow,
            read_branches,
            write_branches,
        )
        from wasp_cli.store.recorded import read_recorded
        from wasp_cli.store.tables import CellIdentity, cell_file, read_steps
        from wasp_cli.tasks.make import make_task

        config = cast(CounterfactualConfig, job.config)
        driver = job.axes["operator"]
        value = job.axes["value"]

        # -- tau_R
        heldout = load_heldout(job.inputs["heldout"])
        tau_R = least_gain(heldout, config.window, config.tau_R_fraction)
        if math.isnan(tau_R):
            raise TrainingError(
                f"no held-out episode of the expert has {config.window} decisions, so "
                "there is no tau_R",
                "set a smaller counterfactual.window",
            )

        # -- the episodes of the cell, and the decisions that are branched
        path = cell_file(job.inputs["evaluate"])
        recorded = Recorded(**read_recorded(path))
        count = len(recorded.a)
        ends = np.cumsum([len(actions) for actions in recorded.a])[:-1]
        steps = read_steps(path)
        deviation = np.split(np.asarray(steps["deviation"]), ends)
        gate = np.split(np.asarray(steps["gate"]), ends)
        intervened = [norms > 0.0 for norms in deviation]
        interventions = int(sum(decisions.sum() for decisions in intervened))
        stride = config.stride
        if config.most is not None:
            stride = max(config.stride, math.ceil(interventions / config.most))
        chosen = sampled(intervened, stride)

        # -- branches, in the batches in which the episodes were evaluated
        informed = informed_policies(job.task, job.inputs)
        model = load_world_model(job.inputs["world_model"])
        skills = load_skills(job.inputs["policies"])
        found: list[Branch] = []
        for episodes in batches(0, count, job.settings["side_by_side"]):

            def during(share: float, text: str, episodes: range = episodes) -> None:
                done = (episodes.start + share * len(episodes)) / count
                job.progress(done, f"episodes {episodes.start}-{episodes[-1]}: {text}")

            batch = len(episodes)
            task = make_task(
                job.task,
                batch,
                action_repeat=job.settings["action_repeat"],
                observe=observed(job.task),
                threads=job.threads,
            )
            context = OperatorContext(skills.at, task.action_size, task.decision_seconds, informed)
            mistakes = EpisodeNoise(
                [seeds.operator_seed(job.task, driver, job.seed, e) for e in episodes]
            )
            operator = build_operator(driver, value, context, mistakes, batch)
            rerun = Rerun(task, model, operator, recorded.of(episodes))
            of_batch = branches(rerun, [chosen[e] for e in episodes], config.window, during)
            found += [branch._replace(episode=episodes[branch.episode]) for branch in of_batch]

        # -- rows
        identity = CellIdentity(
            job.task,
            job.axes["method"],
            job.axes["method_config"].get("variant", "full"),
            driver,
            value,
            job.seed,
        )
        rows = [
            BranchRow(
                branch.episode,
                branch.t,
                branch.name,
                branch.cost,
                branch.cost_env,
                branch.reward,
                float(deviation[branch.episode][branch.t]),
                int(gate[branch.episode][branch.t]),
            )
            for branch in found
        ]
        write_branches(
            job.out_dir / BRANCHES_FILE,
            BranchedCell(identity, config.window, stride, tau_R, count),
            rows,
        )

        # -- summary, from the rewards as they are stored, which reports read too
        stored = read_branches(job.out_dir / BRANCHES_FILE)
        judged = necessity(
            stored.cost[ALONE],
            stored.cost[ASSISTED],
            stored.reward[ALONE],
            stored.reward[ASSISTED],
            tau_R,
        )
        shown = {
            "uir": judged.unnecessary,
            "uir_swapped": judged.swapped,
            "rho": judged.rho,
            "delta_c": judged.delta_c,
            "delta_r": judged.delta_r,
        }
        numbers = {
            name: round(float(values.mean()), 4) if len(values) else None
            for name, values in shown.items()
        }
        return {
            "interventions": interventions,
            "branched": len(stored.t),
            **numbers,
            "tau_R": round(tau_R, 4),
        }
