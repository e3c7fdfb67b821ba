"""The command line: each command parses, makes one call and returns an exit code. Heavy imports are inside the commands."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from wasp_cli import __version__
from wasp_cli.cli import completion as complete
from wasp_cli.cli.bench import bench_app
from wasp_cli.cli.compare import compare_app
from wasp_cli.cli.explain import explain_app
from wasp_cli.cli.operators import operators_app
from wasp_cli.cli.options import (
    BackendOption,
    FailedOption,
    JobsOption,
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
    folder_of,
    print_json,
    require_cells,
    way_of,
)
from wasp_cli.cli.publish import publish_app
from wasp_cli.cli.replay import replay_app
from wasp_cli.cli.spec import spec_app
from wasp_cli.cli.status import status_app
from wasp_cli.cli.store import store_app
from wasp_cli.cli.sweep import sweep_app

if TYPE_CHECKING:
    from wasp_cli.plan.cell import Cell
    from wasp_cli.plan.part import Part
    from wasp_cli.report.document import Report
    from wasp_cli.report.page.films import Draw
    from wasp_cli.run.session import Selection, Way
    from wasp_cli.spec.load import Loaded
    from wasp_cli.spec.model import Spec
    from wasp_cli.spec.paper import Paper
    from wasp_cli.store.layout import Layout

app = typer.Typer(
    name="wasp",
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    help="Run experiments of shared autonomy: train, evaluate under impaired operators, compare assistants.\n\n"
    "A spec (a YAML file in specs/) says what to run; results/ keeps what came out, and nothing is computed twice.",
    epilog="Start here:  [bold]wasp run specs/quickstart.yaml[/]   ·   then:  [bold]wasp report results/[/]",
)


def _version(wanted: bool) -> None:
    if wanted:
        print(f"wasp {__version__}")
        raise typer.Exit


@app.callback()
def main_options(
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of expected errors too (or set WASP_DEBUG=1).")] = False,
    version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")] = False,
) -> None:
    """Options of every command."""
    if debug:
        os.environ["WASP_DEBUG"] = "1"


@app.command(
    epilog="[bold]wasp run specs/quickstart.yaml[/]   ·   [bold]wasp run specs/table1.yaml --task goal1 -j 8 --set episodes=10[/]\n\n"
    "Exit codes: 0 done, 1 some cells failed, 2 usage, 3 invalid spec, 130 interrupted."
)
@expected_errors
def run(
    spec: SpecArgument,
    jobs: JobsOption = None,
    results: ResultsOption = Path("results"),
    task: TaskOption = None,
    select: SelectOption = None,
    failed: FailedOption = False,
    reuse: ReuseOption = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Show the plan, as wasp plan does, and run nothing.")] = False,
    timeout: TimeoutOption = None,
    retries: RetriesOption = 0,
    backend: BackendOption = "loky",
    scheduler: SchedulerOption = None,
    set_: SetOption = None,
) -> None:
    """Compute what is missing of a spec, then print its tables.

    What is in the results folder already is used as it is; what failed runs again. The first Ctrl-C lets finish what runs, the second
    ends it; what is finished is kept either way.
    """
    from wasp_cli.run.session import Selection, restricted
    from wasp_cli.spec.load import load

    loaded, selection = restricted(load(spec, set_ or ()), task), Selection(select or (), failed)
    way = way_of(jobs, timeout, retries, backend, scheduler)
    if dry_run:
        _show_plan(loaded.spec, results, selection, way.jobs, reuse)
    else:
        _run_and_report(loaded, results, way, selection, reuse)


@app.command(epilog="[bold]wasp plan specs/table1.yaml[/]   ·   [bold]wasp plan specs/table1.yaml --json | jq '.nodes[0]'[/]")
@expected_errors
def plan(
    spec: SpecArgument,
    jobs: JobsOption = None,
    results: ResultsOption = Path("results"),
    task: TaskOption = None,
    select: SelectOption = None,
    failed: FailedOption = False,
    reuse: ReuseOption = None,
    every: Annotated[bool, typer.Option("--all", help="List every node with its state and reason.")] = False,
    set_: SetOption = None,
    json: Annotated[bool, typer.Option("--json", help="Every cell and node with its key, state and reason.")] = False,
) -> None:
    """Show what a run would compute and why, and how long it will take; run nothing."""
    from wasp_cli.run.session import Selection, cores, restricted
    from wasp_cli.spec.load import load

    loaded = restricted(load(spec, set_ or ()), task)
    _show_plan(loaded.spec, results, Selection(select or (), failed), cores() if jobs is None else jobs, reuse, every=every, json=json)


@app.command(
    epilog="[bold]wasp report results/[/]   ·   [bold]wasp report results/ --spec table1 --strict[/]\n\n"
    "Exit codes: 0 done, 1 part of the results cannot be read (with --strict also: something is missing), 2 usage, 3 invalid paper."
)
@expected_errors
def report(
    folder: Annotated[Path, typer.Argument(metavar="DIR", parser=folder_of, help="A results folder.")] = Path("results"),
    spec: Annotated[
        str | None, typer.Option("--spec", metavar="NAME", help="Only the spec of this name. (default: all that ran)", show_default=False)
    ] = None,
    paper: Annotated[
        Path | None,
        typer.Option("--paper", metavar="FILE", help="Another paper's numbers and claims. (default: specs/paper.yaml)", show_default=False),
    ] = None,
    strict: Annotated[bool, typer.Option("--strict", help="End with 1 when cells, or branches of them, are missing.")] = False,
    films: Annotated[bool, typer.Option("--films/--no-films", help="Films of one episode of each task under every method.")] = True,
    trained: Annotated[bool, typer.Option("--trained/--no-trained", help="Pictures of each trained part, in the folder trained/.")] = True,
) -> None:
    """Print the tables of what has run, and write them, the figures and one HTML page, from the results folder alone."""
    from wasp_cli.errors import ArtifactError, CellsFailed, StoreError, UnknownName, WaspError
    from wasp_cli.report.document import missing_words
    from wasp_cli.report.provenance import last_runs
    from wasp_cli.run.record import read_run, results_of
    from wasp_cli.spec.paper import load_paper

    claimed, layout = load_paper(paper), results_of(folder)
    runs, damaged = last_runs(layout)
    if not runs and not damaged:
        raise StoreError(f"no results in '{folder}': it holds no runs", "wasp run SPEC --results DIR writes there")
    if spec is not None and runs and spec not in runs:
        raise UnknownName("spec in these results", spec, runs)
    gaps: list[str] = []
    missing: list[str] = []
    for name, run_id in runs.items():
        if spec in (None, name):
            try:
                recorded = read_run(layout, run_id)
                shown = _show_report(
                    layout, recorded.spec, recorded.cells, recorded.parts, recorded.branched, claimed, films=films, trained=trained
                )
                damaged += shown.damaged
                gaps += [f"{name}: {missing_words(shown.frame)}"] if shown.missing else []
                missing += [f"{name}: {cell.label}: {cell.reason}" for cell in shown.missing]
            except WaspError as error:  # the other specs are still worth seeing
                damaged.append(error.message)
    if damaged:
        found = "\n".join(f"  {text}" for text in dict.fromkeys(damaged))
        raise ArtifactError(f"part of the results cannot be read:\n{found}", "run the spec again: what is whole is kept")
    if strict and missing:
        more = f"\n  and {len(missing) - 10} more" if len(missing) > 10 else ""
        raise CellsFailed("\n  ".join([f"{'; '.join(gaps)}:", *missing[:10]]) + more, "run the spec again")


@app.command(epilog="[bold]wasp ablate --variant no-case2 --task goal1 --preset smoke[/]")
@expected_errors
def ablate(
    variant: Annotated[
        str,
        typer.Option(
            "--variant", metavar="NAME", help="The ablation, for example no-case2.", show_default=False, autocompletion=complete.variants
        ),
    ],
    task: Annotated[
        str | None,
        typer.Option(
            "--task", "-t", metavar="TASK", help="On this task. (default: the spec's)", show_default=False, autocompletion=complete.tasks
        ),
    ] = None,
    spec: Annotated[
        Path, typer.Option("--spec", metavar="SPEC", help="For operators, seeds and budgets.", autocompletion=complete.specs)
    ] = Path("specs/table2.yaml"),
    preset: Annotated[
        str | None,
        typer.Option(
            "--preset", metavar="NAME", help="Other sizes and budgets than the spec's.", show_default=False, autocompletion=complete.presets
        ),
    ] = None,
    jobs: JobsOption = None,
    results: ResultsOption = Path("results"),
    reuse: ReuseOption = None,
    timeout: TimeoutOption = None,
    retries: RetriesOption = 0,
    backend: BackendOption = "loky",
    scheduler: SchedulerOption = None,
    set_: SetOption = None,
) -> None:
    """Run a method without one of its parts, and the whole method beside it."""
    from wasp_cli.spec.ablation import ablation

    way = way_of(jobs, timeout, retries, backend, scheduler)
    _run_and_report(ablation(spec, variant, task, preset, set_ or ()), results, way, reuse=reuse)


tasks_app = typer.Typer(
    invoke_without_command=True,
    help="List the tasks, or show one.",
    epilog="[bold]wasp tasks[/]   ·   [bold]wasp tasks show goal1 --seed 3[/]   ·   [bold]wasp tasks --json | jq '.[].gym_id'[/]",
)
app.add_typer(tasks_app, name="tasks")
app.add_typer(bench_app, name="bench")
app.add_typer(compare_app)
app.add_typer(explain_app)
app.add_typer(operators_app)
app.add_typer(publish_app)
app.add_typer(replay_app)
app.add_typer(spec_app)
app.add_typer(status_app)
app.add_typer(store_app)
app.add_typer(sweep_app)


@tasks_app.callback()
@expected_errors
def tasks(
    context: typer.Context,
    json: Annotated[bool, typer.Option("--json", help="The list for machines.")] = False,
) -> None:
    """List the tasks with their spaces, cost sources and limits; or show one (wasp tasks show)."""
    if context.invoked_subcommand is not None:
        if json:
            from wasp_cli.errors import UsageError

            raise UsageError("--json is for the list of tasks, and a task is shown as a picture", "wasp tasks --json")
        return
    from dataclasses import asdict

    from wasp_cli.console import out
    from wasp_cli.report.tables.tasks import task_table
    from wasp_cli.tasks.describe import describe

    found = describe()
    if json:
        print_json([asdict(task) for task in found])
        return
    out().print(task_table(found))
    out().print("Any gymnasium id is a task too: docs/own_task.md", markup=False, soft_wrap=True)


@tasks_app.command(
    "show",
    epilog="[bold]wasp tasks show goal1 --seed 3 --out map.png[/]   ·   [bold]wasp tasks show my_pkg:MyEnv-v0[/]\n\n"
    "Exit codes: 0 done, 1 the environment or the file does not work, 2 usage.",
)
@expected_errors
def show_task(
    task: Annotated[
        str,
        typer.Argument(
            metavar="ID", help="A task (goal1), or a gymnasium id (my_pkg:MyEnv-v0).", show_default=False, autocompletion=complete.tasks
        ),
    ],
    seed: Annotated[int, typer.Option("--seed", min=0, max=2**32 - 1, metavar="N", help="Names the layout.")] = 0,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="PNG", help="The picture. (default: <task>_seed<N>.png)", show_default=False)
    ] = None,
    steps: Annotated[
        int, typer.Option("--steps", min=0, metavar="N", help="Also show the first N decision steps; at most an episode.")
    ] = 0,
) -> None:
    """Draw a layout: the map from above and both camera images."""
    from wasp_cli import console
    from wasp_cli.tasks.sheet import draw_sheet

    path = draw_sheet(task, seed, steps, out)
    console.out().print(str(path), markup=False, soft_wrap=True)


@app.command()
@expected_errors
def doctor(results: ResultsOption = Path("results")) -> None:
    """Say what this machine has: Python, libraries, cores, memory, GPU, a writable results folder."""
    from wasp_cli.cli.doctor import examine, require, show

    findings = examine(results)
    show(findings)
    require(findings)


def _show_plan(
    spec: Spec, results: Path, selection: Selection, jobs: int, reuse: str | None, *, every: bool = False, json: bool = False
) -> None:
    from wasp_cli.console import out
    from wasp_cli.plan.plan import plan_against
    from wasp_cli.plan.reuse import lay_out_over
    from wasp_cli.plan.select import select
    from wasp_cli.plan.show import show
    from wasp_cli.store.layout import Layout

    layout = Layout(results.absolute())
    grid = lay_out_over(spec, layout, reuse)
    laid_out = plan_against(grid, layout, wanted=select(grid, selection.select), failed_only=selection.failed)
    if json:
        print_json({"spec": spec.name, **laid_out.as_json()})
    else:
        show(laid_out, out(), max(jobs, 1), every=every)


def _run_and_report(loaded: Loaded, results: Path, way: Way, selection: Selection | None = None, reuse: str | None = None) -> None:
    from wasp_cli.plan.plan import branched_with_keys, cells_with_keys, parts_with_keys
    from wasp_cli.run.session import WHOLE, run_spec
    from wasp_cli.spec.paper import load_paper

    paper = load_paper()  # a mistake in it is told before anything runs
    session = run_spec(loaded, results, way, selection or WHOLE, reuse)
    # Also after failures: what is there is worth seeing, and the report names what is not.
    grid, wanted = session.plan.grid, session.plan.wanted
    report = _show_report(session.layout, loaded.spec, cells_with_keys(grid), parts_with_keys(grid), branched_with_keys(grid), paper)
    session.require_complete()
    require_cells([cell for cell in report.missing if wanted is None or cell.key in wanted], session.layout)


def _show_report(
    layout: Layout,
    spec: Spec,
    cells: list[tuple[Cell, str]],
    parts: list[tuple[Part, str]],
    branched: list[tuple[Cell, str]],
    paper: Paper,
    *,
    films: bool = False,
    trained: bool = False,
) -> Report:
    from wasp_cli.console import err, out
    from wasp_cli.report.summarize import report_run

    report = report_run(layout.root, spec, cells, parts, paper, branched)
    # Written first: a terminal that goes away costs no file.
    with err().status("report") as status:
        draw = _film_drawing() if films else None
        _, page, *_ = report.write(layout.reports(spec.name), draw, lambda text: status.update(f"drawing {text}"), evidence=trained)
    report.terminal(out())
    beside = "tables as Markdown, CSV and LaTeX, figures as PNG and SVG are beside it"
    left_out = [name for name, there in (("films of episodes", films), ("pictures of the trained parts", trained)) if not there]
    further = f"; wasp report adds {' and '.join(left_out)}" if left_out else ""
    out().print(f"report: {page} ({beside}{further})", markup=False, soft_wrap=True)
    out().print(f"rows and artifacts: {layout.root / 'store'}", markup=False, soft_wrap=True)
    return report


def _film_drawing() -> Draw:
    from wasp_cli.video.film import sprite_of  # needs MuJoCo

    return sprite_of


def main() -> None:
    """The console script."""
    app()
