"""The commands that compute: `wasp run`, `plan`, `ablate` and `sweep`."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from wasp_cli.cli import options
from wasp_cli.cli.options import (
    command,
    flag,
    option,
    print_json,
    setting_names,
    spec_names,
    variant_names,
)
from wasp_cli.cli.report import NotWritten, show_report
from wasp_cli.console import err, out, plain, say
from wasp_cli.errors import CellsFailed, StoreError, UsageError, first
from wasp_cli.store.layout import Layout

if TYPE_CHECKING:
    from wasp_cli.cells.read import Missing
    from wasp_cli.plan.plan import Plan
    from wasp_cli.run.session import RunOptions
    from wasp_cli.spec.load import Loaded


@command(
    "wasp run specs/quickstart.yaml",
    "wasp run specs/table1.yaml --task goal1 -j 8 --set episodes=10",
    codes="0 done, 1 some cells failed or a stage fell short (--strict), 2 usage, 3 invalid spec, "
    "130 interrupted",
)
def run(asked: options.SelectedSpec, work: options.Work) -> None:
    """Run a spec and print its tables.

    Only what is missing in the results folder is computed; failed nodes run again. The first Ctrl-C
    lets running nodes finish, the second stops at once. Finished nodes are kept either way.
    """
    from wasp_cli.run.session import planned

    loaded, how = asked.load(), work.options()
    if work.dry_run:
        plan = planned(loaded, asked.results, asked.select or (), asked.reuse, failed=asked.failed)
        print_plan(plan, loaded.spec.name, how.jobs)
    else:
        run_and_report(
            loaded, asked.results, how, asked.select or (), asked.reuse, failed=asked.failed
        )


@command("wasp plan specs/table1.yaml", "wasp plan specs/table1.yaml --json | jq '.nodes[0]'")
def plan(
    asked: options.SelectedSpec,
    jobs: options.JobsOption = None,
    every: Annotated[bool, flag("--all", "List every node with its state and reason.")] = False,
    json: options.JsonOption = False,
) -> None:
    """Show what a run would compute, why, and for how long."""
    from wasp_cli.run.cores import cores
    from wasp_cli.run.session import planned

    loaded = asked.load()
    laid_out = planned(loaded, asked.results, asked.select or (), asked.reuse, failed=asked.failed)
    print_plan(
        laid_out, loaded.spec.name, cores() if jobs is None else jobs, every=every, json=json
    )


@command("wasp ablate --variant no-case2 --task goal1 --preset smoke --set 'seeds=[0]'")
def ablate(
    variant: Annotated[
        str, option("NAME", "The ablation, for example no-case2.", among=variant_names)
    ],
    asked: options.Sized,
    work: options.Work,
    spec: Annotated[
        Path, option("SPEC", "Gives operators, seeds and budgets.", among=spec_names)
    ] = Path("specs/table2.yaml"),
    reuse: options.ReuseOption = None,
) -> None:
    """Compare a method with one of its ablations.

    Both stand beside the operators alone. Operators, seeds and episodes are those of the spec. With
    many of them this takes long:
    --dry-run says how long, --set changes them.
    """
    from wasp_cli.run.session import planned
    from wasp_cli.spec.load import ablation

    how = work.options()
    loaded = ablation(spec, variant, asked.task, asked.preset, asked.set_ or ())
    print_plan(
        planned(loaded, asked.results, reuse=reuse),
        loaded.spec.name,
        how.jobs,
        aside=not work.dry_run,
    )
    if not work.dry_run:
        run_and_report(loaded, asked.results, how, reuse=reuse)


@command(
    "wasp sweep specs/quickstart.yaml --vary diffusion.ratio=0,0.2,0.4,0.6",
    "wasp sweep specs/quickstart.yaml --vary wasp.tau_c=0.3,0.5,1 --json",
    codes="0 done, 1 some cells failed, 2 usage, 3 the spec is invalid with one of the values, "
    "130 interrupted",
)
def sweep(
    asked: options.SizedSpec,
    vary: Annotated[
        list[str],
        option(
            "KEY=V1,V2,...",
            "The setting and its values, each written as for --set.",
            among=setting_names,
        ),
    ],
    work: options.Work,
    method: options.MethodOption = None,
    reuse: options.ReuseOption = None,
    json: options.JsonOption = False,
) -> None:
    """Run a spec with several values of one setting.

    What does not depend on the setting is computed once. Results that are in the results folder
    already are used. Without --method, Human-only and the method of the setting run, or all methods
    where it is no method's.
    """
    from wasp_cli.cells.asked import asked_of_grid
    from wasp_cli.report.sweep import report_sweep
    from wasp_cli.run.session import planned_sweep, run_sweep
    from wasp_cli.spec.load import read_sweep

    if len(vary) > 1:
        raise UsageError(
            "--vary is given twice; a sweep varies one setting",
            "run one sweep for each, or set the other with --set",
        )
    varied = read_sweep(asked.spec, vary[0], method or (), asked.settings, asked.task)
    how = work.options()
    if work.dry_run:
        print_plan(
            planned_sweep(varied, Layout(asked.results.absolute()), reuse),
            varied.name,
            how.jobs,
            json=json,
        )
        return
    session, grids = run_sweep(varied, asked.results, how, reuse)
    layout = session.layout
    # Also after failures: the other values are worth seeing, and the report names what is not
    # there.
    values = [
        asked_of_grid(layout, session.run_id, point.loaded.spec, grid)
        for point, grid in zip(varied.points, grids, strict=True)
    ]
    report = report_sweep(varied, values)
    try:
        page, *_ = report.write(layout.reports(varied.name))
    except (OSError, StoreError) as error:
        session.require_complete(f"the report cannot be written: {error}")
        raise
    layout.reporting(session.run_id).unlink(missing_ok=True)
    if json:
        print_json({**report.as_json(), "report": str(page)})
    else:
        report.terminal(out())
        say(f"report: {page} (its table is in the same folder as CSV, LaTeX and HTML)")
    session.require_complete()
    require_cells(report.missing, layout)


def print_plan(
    plan: Plan,
    name: str,
    jobs: int,
    *,
    every: bool = False,
    json: bool = False,
    aside: bool = False,
) -> None:
    """Print a plan, as JSON under a name; `aside`, to stderr, where the run itself follows."""
    from wasp_cli.plan.plan import show
    from wasp_cli.run.cores import threads_here

    if json:
        print_json({"spec": name, **plan.as_json()})
    else:
        workers = max(jobs, 1)
        console = err() if aside else out()
        show(plan, console, workers, cores=min(workers, threads_here()), every=every)


def run_and_report(
    loaded: Loaded,
    results: Path,
    how: RunOptions,
    select: Sequence[str] = (),
    reuse: str | None = None,
    *,
    failed: bool = False,
) -> None:
    from wasp_cli.cells.asked import asked_of_grid
    from wasp_cli.run.session import run_spec
    from wasp_cli.spec.paper import load_paper

    paper = load_paper()  # a mistake in it is told before anything runs
    session = run_spec(loaded, results, how, select, reuse, failed=failed)
    # Also after failures: what is there is worth seeing, and the report names what is not.
    grid, selected = session.plan.grid, session.plan.wanted
    asked = asked_of_grid(session.layout, session.run_id, loaded.spec, grid)
    try:
        report = show_report(asked, paper, redraw=False)
    except NotWritten as error:
        session.require_complete(error.message)
        raise
    session.layout.reporting(session.run_id).unlink(missing_ok=True)
    say_next(results, [(cell.method, node.label, node.key) for cell, node in grid.cells])
    session.require_complete()
    require_cells(
        [cell for cell in report.missing if selected is None or cell.key in selected],
        session.layout,
    )


def say_next(results: Path, cells: Sequence[tuple[str, str, str]]) -> None:
    """Say what may follow a run of cells: method, label and key of each."""
    from wasp_cli.store.tables import cell_file, read_steps
    from wasp_cli.tasks.registry import TASKS

    option = "" if results == Path("results") else f" --results {shlex.quote(str(results))}"
    plain(f"next: wasp view{option}   (every number leads to its episodes and decisions)")
    for _, label, key in sorted(cells, key=lambda cell: cell[0] != "wasp"):
        with suppress(StoreError):  # what failed has no steps, nor have some published cells
            if read_steps(cell_file(Layout(results).artifact("evaluate", key))).num_rows:
                plain(
                    f"      wasp explain {shlex.quote(label)} --episode 0{option}   (what "
                    "the assistant did, and why)"
                )
                break
    adds = "pictures of the trained parts"
    # a report imports no environment of somebody else's, and so films none
    if any(label.partition(" ")[0] in TASKS for _, label, _ in cells):
        adds = f"films of episodes and {adds}"
    plain(f"      wasp report {shlex.quote(str(results))}   (adds {adds})")


def require_cells(missing: Sequence[Missing], layout: Layout) -> None:
    """Raise CellsFailed when cells have no readable rows; the next run computes those again that
    have other bytes than were stored.

    A file that could not be read just now stays in use, and so does what a person drove.
    """
    from wasp_cli.store.artifact import corruption, invalidate
    from wasp_cli.store.layout import SESSION_FILE

    if missing := [cell for cell in missing if not cell.invalid]:
        for cell in missing:
            driven = cell.damaged and (layout.artifact(cell.kind, cell.key) / SESSION_FILE).exists()
            if cell.damaged and not driven and corruption(layout, cell.kind, cell.key) is not None:
                invalidate(layout, cell.kind, cell.key, cell.reason)
        what = f"{len(missing)} cell{'s' if len(missing) > 1 else ''} cannot be read:"
        lines = [what, *first([f"  {cell.label}: {cell.reason}" for cell in missing], 10)]
        raise CellsFailed(
            "\n".join(lines),
            "run again: cells that have other bytes than were stored are computed again",
        )
