"""`wasp plan`: what a run would compute."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from wasp_cli.cli import options
from wasp_cli.cli.command import command
from wasp_cli.cli.options import print_json
from wasp_cli.cli.parameters import flag
from wasp_cli.console import err, out

if TYPE_CHECKING:
    from wasp_cli.plan.plan import Plan


@command("wasp plan specs/table1.yaml", "wasp plan specs/table1.yaml --json | jq '.nodes[0]'")
def plan(
    asked: options.SelectedSpec,
    jobs: options.JobsOption = None,
    every: Annotated[bool, flag("--all", "List every node with its state and reason.")] = False,
    json: options.JsonOption = False,
) -> None:
    """Show what a run would compute, why, and for how long."""
    from wasp_cli.plan.planned import planned
    from wasp_cli.run.cores import cores

    loaded = asked.load()
    laid_out = planned(loaded, asked.results, asked.select or (), asked.reuse, failed=asked.failed)
    print_plan(
        laid_out, loaded.spec.name, cores() if jobs is None else jobs, every=every, json=json
    )


def print_plan(
    plan: Plan,
    name: str,
    jobs: int,
    *,
    every: bool = False,
    json: bool = False,
    aside: bool = False,
) -> None:
    """Print a plan.

    Args:
        name: of the spec, for JSON.
        jobs: workers, for the estimate of the time.
        every: whether every node is listed.
        json: whether it is printed as JSON.
        aside: whether it goes to stderr, since a run follows.
    """
    from wasp_cli.plan.text import show
    from wasp_cli.run.cores import threads_here

    if json:
        print_json({"spec": name, **plan.as_json()})
    else:
        workers = max(jobs, 1)
        console = err() if aside else out()
        show(plan, console, workers, cores=min(workers, threads_here()), every=every)
