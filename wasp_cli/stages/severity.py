"""The severity of one operator where a spec leaves it open (`auto`), from held-out worlds of a
training. Artifact: `severity.json` (see `learning.severity`); of the node of the unimpaired
operator, which all others read, `references.json`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs.severity import SeverityConfig
from wasp_cli.operators.registry import UNIMPAIRED
from wasp_cli.stages.base import Job

REFERENCES = "references"
"""The name under which a node reads what random commands and the unimpaired expert return."""


class SeverityStage:
    """See the module."""

    kind = "severity"
    config = SeverityConfig
    settings = ("action_repeat", "returns")
    needs: tuple[str, ...] = ("world_model", "policies")
    needs_informed = ("expert",)

    def run(self, job: Job) -> Mapping[str, Any]:
        """Drive the operator alone at a few severities, and choose; goes on from what was driven
        before an interruption.
        """
        from wasp_cli.learning import severity as learning
        from wasp_cli.learning.assistants import load_parts
        from wasp_cli.learning.device import training_device
        from wasp_cli.learning.informed import informed_policies, observed
        from wasp_cli.tasks.registry import TASKS

        config = cast(SeverityConfig, job.config)
        operator = job.axes["operator"]
        device = training_device()
        worlds = learning.Worlds(
            job.task,
            job.seed,
            config.episodes,
            job.settings["action_repeat"],
            load_parts(job.inputs, job.settings["returns"], device, motors=TASKS[job.task].motors),
            informed_policies(job.task, job.inputs, device),
            observed(job.task),
            job.threads,
        )

        # -- the node that all others read
        if operator == UNIMPAIRED:
            random = worlds.random()
            job.progress(0.5, f"{config.episodes} episodes of random commands")
            expert = worlds.drive(UNIMPAIRED, None)
            learning.write_references(job.out_dir, learning.References(random, expert))
            return {
                "expert_return": round(expert.mean_return, 2),
                "random_return": round(random.mean_return, 2),
                "expert_cost": round(expert.mean_cost, 1),
                "random_cost": round(random.mean_cost, 1),
            }

        # -- the search
        references = learning.read_references(job.inputs[REFERENCES])
        ladder = ladder_of(job.axes["ladder"], worlds.decision_seconds())
        most = len(ladder.tried) + 1

        def told(count: int) -> None:
            job.progress(count / most, f"severity {count} of at most {most}")

        drive = learning.Kept(job.work_dir, lambda value: worlds.drive(operator, value), told)
        found = learning.search(ladder, config.kept, references, drive)
        learning.write_found(job.out_dir, operator, config.kept, references, found)
        chosen = found.points[found.choice.severity]
        share = references.share(chosen)
        return {
            "severity": found.choice.severity,
            "kept": round(share, 3),  # not finite where there is nothing to keep a share of
            "return": round(chosen.mean_return, 2),
            "expert_return": round(references.expert.mean_return, 2),
            "random_return": round(references.random.mean_return, 2),
            "cost": round(chosen.mean_cost, 1),
            "tried": len(found.points),
            "within": found.choice.within,
            "operator": operator,
        }


def ladder_of(axis: Mapping[str, Any], decision_seconds: float) -> Any:
    """Return the `learning.severity.Ladder` of a node.

    Args:
        axis: what the plan knows of it: `tried`, `harmless`, `between` and `high`, as an operator's
            entry in the registry has them.
    """
    from wasp_cli.learning.severity import Ladder

    tried = tuple(axis["tried"])
    if axis["between"] == "checkpoints":
        return Ladder(tried, step=None)
    if axis["between"] == "any":
        return Ladder(tried, axis["harmless"])
    # Delays: as many decisions as fit below the longest delay, and one at least.
    seconds = [count * decision_seconds for count in tried]
    fitting = [delay for delay in seconds if delay <= axis["high"]]
    return Ladder(tuple(fitting or [axis["high"]]), step=decision_seconds)
