"""The commands that compute: `wasp run`, `plan`, `ablate`, `sweep` and `operators`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from wasp_cli.cli import completion as complete
from wasp_cli.cli.options import (
    BackendOption,
    DryRunOption,
    FailedOption,
    JobsOption,
    JsonOption,
    LimitOption,
    MethodOption,
    PresetOption,
    ResultsOption,
    RetriesOption,
    ReuseOption,
    SchedulerOption,
    SelectOption,
    SetOption,
    SpecArgument,
    TaskOption,
    TimeoutOption,
    expected_errors,
    flag,
    option,
    print_json,
)
from wasp_cli.cli.report import show_report

if TYPE_CHECKING:
    from wasp_cli.plan.plan import Plan
    from wasp_cli.report.stats.frame import Missing
    from wasp_cli.run.session import RunOptions, Selection
    from wasp_cli.spec.load import Loaded
    from wasp_cli.spec.model import Spec
    from wasp_cli.store.layout import Layout

PANEL = "Run"

run_app = typer.Typer()


@run_app.command(
    rich_help_panel=PANEL,
    epilog="[bold]wasp run specs/quickstart.yaml[/]   ·   [bold]wasp run specs/table1.yaml --task goal1 -j 8 --set episodes=10[/]\n\n"
    "Exit codes: 0 done, 1 some cells failed, 2 usage, 3 invalid spec, 130 interrupted.",
)
@expected_errors
def run(
    spec: SpecArgument,
    jobs: JobsOption = None,
    results: ResultsOption = Path("results"),
    task: TaskOption = None,
    method: MethodOption = None,
    preset: PresetOption = None,
    select: SelectOption = None,
    limit: LimitOption = None,
    failed: FailedOption = False,
    reuse: ReuseOption = None,
    dry_run: DryRunOption = False,
    detach: Annotated[
        bool, flag("--detach", help="Go on without this terminal. One line of JSON says where; wasp status shows progress.")
    ] = False,
    timeout: TimeoutOption = None,
    retries: RetriesOption = 0,
    backend: BackendOption = "loky",
    scheduler: SchedulerOption = None,
    set_: SetOption = None,
) -> None:
    """Run a spec and print its tables.

    Only what is missing in the results folder is computed; failed nodes run again. The first Ctrl-C lets running nodes finish, the
    second stops at once. Finished nodes are kept either way.
    """
    from wasp_cli.run.session import Selection, limited, restricted
    from wasp_cli.spec.derived import sized
    from wasp_cli.spec.load import load

    loaded = limited(restricted(load(spec, sized(preset, set_)), task, method), limit)
    selection = Selection(select or (), failed)
    options = run_options(jobs, timeout, retries, backend, scheduler)
    if dry_run:
        show_plan(loaded.spec, results, selection, options.jobs, reuse)
    elif detach:
        run_detached()
    else:
        run_and_report(loaded, results, options, selection, reuse)


@run_app.command(
    rich_help_panel=PANEL, epilog="[bold]wasp plan specs/table1.yaml[/]   ·   [bold]wasp plan specs/table1.yaml --json | jq '.nodes[0]'[/]"
)
@expected_errors
def plan(
    spec: SpecArgument,
    jobs: JobsOption = None,
    results: ResultsOption = Path("results"),
    task: TaskOption = None,
    method: MethodOption = None,
    preset: PresetOption = None,
    select: SelectOption = None,
    limit: LimitOption = None,
    failed: FailedOption = False,
    reuse: ReuseOption = None,
    every: Annotated[bool, flag("--all", help="List every node with its state and reason.")] = False,
    set_: SetOption = None,
    json: JsonOption = False,
) -> None:
    """Show what a run would compute, why, and for how long."""
    from wasp_cli.run.session import Selection, cores, limited, restricted
    from wasp_cli.spec.derived import sized
    from wasp_cli.spec.load import load

    loaded = limited(restricted(load(spec, sized(preset, set_)), task, method), limit)
    show_plan(loaded.spec, results, Selection(select or (), failed), cores() if jobs is None else jobs, reuse, every=every, json=json)


@run_app.command(rich_help_panel=PANEL, epilog="[bold]wasp ablate --variant no-case2 --task goal1 --preset smoke --set 'seeds=[0]'[/]")
@expected_errors
def ablate(
    variant: Annotated[
        str, option("--variant", metavar="NAME", help="The ablation, for example no-case2.", autocompletion=complete.variants)
    ],
    task: TaskOption = None,
    spec: Annotated[
        Path, typer.Option("--spec", metavar="SPEC", help="The spec with operators, seeds and budgets.", autocompletion=complete.specs)
    ] = Path("specs/table2.yaml"),
    preset: PresetOption = None,
    jobs: JobsOption = None,
    results: ResultsOption = Path("results"),
    reuse: ReuseOption = None,
    dry_run: DryRunOption = False,
    timeout: TimeoutOption = None,
    retries: RetriesOption = 0,
    backend: BackendOption = "loky",
    scheduler: SchedulerOption = None,
    set_: SetOption = None,
) -> None:
    """Compare a method with one of its ablations, and with the operators alone.

    Operators, seeds and episodes are those of the spec. With many of them this takes long: --dry-run says how long, --set changes them.
    """
    from wasp_cli.run.session import WHOLE
    from wasp_cli.spec.derived import ablation

    options = run_options(jobs, timeout, retries, backend, scheduler)
    loaded = ablation(spec, variant, task, preset, set_ or ())
    show_plan(loaded.spec, results, WHOLE, options.jobs, reuse, aside=not dry_run)
    if not dry_run:
        run_and_report(loaded, results, options, reuse=reuse)


@run_app.command(
    rich_help_panel=PANEL,
    epilog="[bold]wasp sweep specs/quickstart.yaml --vary diffusion.ratio=0,0.2,0.4,0.6 --set 'seeds=[7]'[/]   ·   "
    "[bold]wasp sweep specs/quickstart.yaml --vary wasp.tau_c=0.3,0.5,1 --json[/]\n\n"
    "Exit codes: 0 done, 1 some cells failed, 2 usage, 3 the spec is invalid with one of the values, 130 interrupted.",
)
@expected_errors
def sweep(
    spec: SpecArgument,
    vary: Annotated[
        list[str],
        option(
            "--vary",
            metavar="KEY=V1,V2,...",
            help="The setting and its values, each written as for --set.",
            autocompletion=complete.settings,
        ),
    ],
    task: TaskOption = None,
    method: Annotated[
        list[str] | None,
        option(
            "--method",
            "-m",
            metavar="NAME",
            help="Only this method of the spec (repeatable). (default: Human-only and the method of the setting, or all methods)",
            autocompletion=complete.methods,
        ),
    ] = None,
    preset: PresetOption = None,
    jobs: JobsOption = None,
    results: ResultsOption = Path("results"),
    reuse: ReuseOption = None,
    dry_run: DryRunOption = False,
    timeout: TimeoutOption = None,
    retries: RetriesOption = 0,
    backend: BackendOption = "loky",
    scheduler: SchedulerOption = None,
    set_: SetOption = None,
    json: JsonOption = False,
) -> None:
    """Run a spec with several values of one setting and compare them.

    What does not depend on the setting is computed once. Results that are in the results folder already are used.
    """
    from wasp_cli.console import out, say
    from wasp_cli.errors import UsageError
    from wasp_cli.plan.plan import cells_with_keys
    from wasp_cli.report.sweep import report_sweep
    from wasp_cli.run.record import reported
    from wasp_cli.run.session import on_tasks, planned_sweep, run_sweep
    from wasp_cli.spec.derived import read_sweep, sized
    from wasp_cli.store.layout import Layout

    if len(vary) > 1:
        raise UsageError("--vary is given twice; a sweep varies one setting", "run one sweep for each, or set the other with --set")
    wanted = on_tasks(read_sweep(spec, vary[0], method or (), sized(preset, set_)), task)
    options = run_options(jobs, timeout, retries, backend, scheduler)
    if dry_run:
        print_plan(planned_sweep(wanted, Layout(results.absolute()), reuse), wanted.name, options.jobs, json=json)
        return
    done = run_sweep(wanted, results, options, reuse)
    layout = done.session.layout
    # Also after failures: the other values are worth seeing, and the report names what is not there.
    report = report_sweep(layout.root, wanted, [cells_with_keys(grid) for grid in done.grids])
    page, *_ = report.write(layout.reports(wanted.name))
    reported(layout, done.session.run_id)
    if json:
        print_json({**report.as_json(), "report": str(page)})
    else:
        report.terminal(out())
        say(f"report: {page} (tables as text and LaTeX, and curves, are in the same folder)")
    done.session.require_complete()
    require_cells(report.missing, layout)


@run_app.command(
    rich_help_panel=PANEL,
    epilog="[bold]wasp operators specs/severity.yaml --task goal1[/]   ·   "
    "[bold]wasp operators specs/quickstart.yaml --set 'operators={laggy: {mild: 0.5, moderate: 0.7}}'[/]\n\n"
    "Exit codes: 0 no operator is rejected, 1 an operator is rejected or some cells failed, 2 usage, 3 invalid spec, 130 interrupted.",
)
@expected_errors
def operators(
    spec: SpecArgument,
    jobs: JobsOption = None,
    results: ResultsOption = Path("results"),
    task: TaskOption = None,
    preset: PresetOption = None,
    timeout: TimeoutOption = None,
    retries: RetriesOption = 0,
    backend: BackendOption = "loky",
    scheduler: SchedulerOption = None,
    set_: SetOption = None,
    json: JsonOption = False,
) -> None:
    """Measure the simulated operators without assistance and check their severities.

    An operator is accepted if its return falls with every severity, and its moderate severity loses at least a quarter of the expert's
    return. Missing cells are computed; `wasp run` with the same spec uses them.
    """
    from wasp_cli.console import out, say
    from wasp_cli.plan.plan import cells_with_keys
    from wasp_cli.report.render.files import make_own, write_pages
    from wasp_cli.report.render.text import terminal
    from wasp_cli.report.stats.severity_check import read_checks, require_accepted, verdict_lines
    from wasp_cli.report.summarize import wanted_cells
    from wasp_cli.report.tables.severity_check import as_json, check_table, judged
    from wasp_cli.run.record import reported
    from wasp_cli.run.session import restricted, run_spec
    from wasp_cli.spec.derived import operators_alone, sized

    loaded = restricted(operators_alone(spec, sized(preset, set_)), task)
    session = run_spec(loaded, results, run_options(jobs, timeout, retries, backend, scheduler), aside=True)
    # Also after failures: what is there is worth seeing.
    wanted, _ = wanted_cells(session.layout, loaded.spec, cells_with_keys(session.plan.grid))
    checks, frame = read_checks(loaded.spec, wanted)
    table = check_table(checks, frame)
    folder = session.layout.reports(loaded.spec.name)
    make_own(folder)
    files = write_pages(folder, {}, [judged(table, checks)])
    reported(session.layout, session.run_id)
    if json:
        print_json(as_json(loaded.spec.name, checks, frame))
    else:
        out().print(terminal(table, out().width))
        say("", *verdict_lines(checks), f"table: {', '.join(map(str, files))}")
    session.require_complete()
    require_cells(frame.missing, session.layout)
    require_accepted(checks)


def run_options(jobs: int | None, timeout: float | None, retries: int, backend: str, scheduler: str | None) -> RunOptions:
    """Collect what was typed about how a run is carried out.

    Raises:
        UnknownName: no such backend.
    """
    from wasp_cli.errors import UnknownName
    from wasp_cli.run.pool import BACKENDS
    from wasp_cli.run.session import RunOptions, cores

    if backend not in BACKENDS:  # also told where nothing is going to run
        raise UnknownName("backend", backend, BACKENDS)
    return RunOptions(cores() if jobs is None else jobs, timeout, retries, backend, scheduler, reports=True)


def show_plan(
    spec: Spec,
    results: Path,
    selection: Selection,
    jobs: int,
    reuse: str | None,
    *,
    every: bool = False,
    json: bool = False,
    aside: bool = False,
) -> None:
    """Print the plan of a spec against a results folder; `aside`, to stderr, where the run itself follows."""
    from wasp_cli.plan.plan import plan_against
    from wasp_cli.plan.reuse import lay_out_over
    from wasp_cli.plan.select import select
    from wasp_cli.store.layout import Layout

    layout = Layout(results.absolute())
    grid = lay_out_over(spec, layout, reuse)
    laid_out = plan_against(grid, layout, wanted=select(grid, selection.select), failed_only=selection.failed)
    print_plan(laid_out, spec.name, jobs, every=every, json=json, aside=aside)


def print_plan(plan: Plan, name: str, jobs: int, *, every: bool = False, json: bool = False, aside: bool = False) -> None:
    """Print a plan, as JSON under a name; `aside`, to stderr."""
    from wasp_cli.console import err, out
    from wasp_cli.plan.show import show

    if json:
        print_json({"spec": name, **plan.as_json()})
    else:
        show(plan, err() if aside else out(), max(jobs, 1), every=every)


def run_detached() -> None:
    """Start this command again without a terminal, and print where its run is."""
    import json
    import sys

    from wasp_cli.run.detach import detached

    said, code, printed = detached([argument for argument in sys.argv[1:] if argument != "--detach"])
    if said is None:
        sys.stderr.write(printed)
        raise typer.Exit(code or 1)
    print(json.dumps(said))


def run_and_report(
    loaded: Loaded, results: Path, options: RunOptions, selection: Selection | None = None, reuse: str | None = None
) -> None:
    """Run a spec, then write and print its report.

    Raises:
        CellsFailed: a selected cell failed, or has no readable rows.
    """
    from wasp_cli.plan.plan import branched_with_keys, cells_with_keys, parts_with_keys
    from wasp_cli.run.record import reported
    from wasp_cli.run.session import WHOLE, run_spec
    from wasp_cli.spec.paper import load_paper

    paper = load_paper()  # a mistake in it is told before anything runs
    session = run_spec(loaded, results, options, selection or WHOLE, reuse)
    # Also after failures: what is there is worth seeing, and the report names what is not.
    grid, wanted = session.plan.grid, session.plan.wanted
    report = show_report(session.layout, loaded.spec, cells_with_keys(grid), parts_with_keys(grid), branched_with_keys(grid), paper)
    reported(session.layout, session.run_id)
    session.require_complete()
    require_cells([cell for cell in report.missing if wanted is None or cell.key in wanted], session.layout)


def require_cells(missing: Sequence[Missing], layout: Layout) -> None:
    """Raise CellsFailed when a cell has no readable rows, though its node ended well.

    Args:
        missing: the cells without rows.
        layout: the results folder of the run; damaged cells are invalidated there, so that the next run computes them.
    """
    from wasp_cli.errors import CellsFailed
    from wasp_cli.store.artifact import invalidate

    if missing:
        for cell in missing:
            if cell.damaged:
                invalidate(layout, cell.kind, cell.key, cell.reason)
        named = "\n".join(f"  {cell.label}: {cell.reason}" for cell in missing[:10])
        more = f"\n  and {len(missing) - 10} more" if len(missing) > 10 else ""
        what = f"{len(missing)} cell{'s' if len(missing) > 1 else ''} cannot be read"
        raise CellsFailed(f"{what}:\n{named}{more}", "run again: damaged cells are computed again")
