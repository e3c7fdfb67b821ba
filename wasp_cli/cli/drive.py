"""`wasp drive`: a person at the controls."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from wasp_cli.cli import completion as complete
from wasp_cli.cli.options import (
    JobsOption,
    JsonOption,
    PresetOption,
    ResultsArgument,
    ResultsOption,
    SetOption,
    TaskOption,
    expected_errors,
    flag,
    option,
    print_json,
    results_folder,
)

if TYPE_CHECKING:
    from wasp_cli.drive.session import Session

drive_app = typer.Typer()


@drive_app.command(
    rich_help_panel="People",
    epilog="[bold]wasp drive goal1 --method wasp[/]   ·   [bold]wasp drive goal1 --check[/]   ·   "
    "[bold]wasp drive specs/study.yaml --participant 7[/]\n\n"
    "Exit codes: 0 done, 1 results cannot be written, or with --check: decisions are late, 2 usage, 3 invalid spec, 130 interrupted.",
)
@expected_errors
def drive(
    what: Annotated[
        str, typer.Argument(metavar="TASK|SPEC", help="A task, or a spec with people among its operators.", show_default=False)
    ],
    method: Annotated[
        str | None,
        option("--method", "-m", metavar="NAME", help="The assistant; none: alone. (default: wasp)", autocompletion=complete.methods),
    ] = None,
    participant: Annotated[int | None, option("--participant", min=0, metavar="N", help="Number of the participant. (default: 0)")] = None,
    episodes: Annotated[int | None, option("--episodes", min=1, metavar="N", help="Episodes to drive. (default: 5)")] = None,
    number: Annotated[
        int | None, option("--session", min=0, metavar="N", help="Number of the session: its worlds. (default: the next one)")
    ] = None,
    speed: Annotated[
        float | None, option("--speed", min=0.05, max=4.0, metavar="X", help="Simulated seconds per second. (default: 1)")
    ] = None,
    hide: Annotated[
        list[str] | None,
        option("--hide", metavar="NAME", help="Do not show: cameras, map, cost, goals, gate or imagined (repeatable)."),
    ] = None,
    port: Annotated[int, typer.Option("--port", min=0, max=65535, metavar="N", help="Port on 127.0.0.1; 0: any free one.")] = 0,
    browser: Annotated[bool, flag("--no-browser", help="Only print the address.")] = False,
    check: Annotated[bool, flag("--check", help="Measure with a scripted driver whether decisions are in time; record nothing.")] = False,
    simulate: Annotated[
        bool, flag("--simulate", help="Let scripted drivers drive, through the real socket: of a spec all participants, or the one named.")
    ] = False,
    orders: Annotated[bool, flag("--orders", help="Only show who drives what in which order.")] = False,
    withdraw: Annotated[bool, flag("--withdraw", help="Delete everything that the participant drove.")] = False,
    preset: PresetOption = None,
    results: ResultsOption = Path("results"),
    jobs: JobsOption = None,
    set_: SetOption = None,
    json: JsonOption = False,
) -> None:
    """Drive a task in a browser, with an assistant or alone.

    The page is served on this machine alone, under an address with a token; through an SSH tunnel it works from elsewhere. What is driven
    is a cell like any other: wasp report, explain, replay and compare show it.
    """
    from wasp_cli.errors import UsageError

    try:
        import starlette  # noqa: F401
        import uvicorn  # noqa: F401
        import websockets  # noqa: F401
    except ImportError as error:
        raise UsageError(f"driving needs packages that are not here: {error}", "pip install 'wasp-cli[drive]'") from error
    from wasp_cli.drive.command import Wanted, drive_session, withdrawn
    from wasp_cli.drive.script import Habits

    wanted = Wanted(
        what, method, participant, episodes, number, speed, tuple(hide or ()), preset, tuple(set_ or ()), results, jobs, simulate,
    )  # fmt: skip
    if withdraw:
        withdrawn(wanted)
    elif orders:
        from wasp_cli.console import out

        out().print(wanted.orders())
    elif check:
        _check(wanted.prepared(recorded=False), json)
    else:
        summaries = []
        for each in wanted.everyone() if simulate else [wanted]:
            session = each.prepared()
            habits = Habits(each.participant or 0) if simulate else None
            try:
                summaries.append(drive_session(session, port, open_browser=not browser, scripted=habits))
            finally:
                each.record(session)
        if json:
            print_json(summaries if len(summaries) > 1 else summaries[0])
        elif len(summaries) > 1:
            _report(wanted.results, wanted.loaded().spec.name)


def _report(results: Path, spec: str) -> None:
    """Print what `wasp report` prints of a spec."""
    from wasp_cli.cli.report import show_report
    from wasp_cli.report.provenance import last_runs
    from wasp_cli.run.record import read_run, results_of

    layout = results_of(results)
    recorded = read_run(layout, last_runs(layout)[0][spec])
    show_report(
        layout,
        recorded.spec,
        recorded.cells,
        recorded.parts,
        recorded.branched,
        None,
        recorded.unknown,
        recorded.absent,
        films=False,
        trained=False,
    )


@drive_app.command(
    rich_help_panel="People",
    epilog="[bold]wasp clone results/ --participant 7[/]"
    "\n\nExit codes: 0 done, 1 results cannot be read or written, 2 usage, 3 invalid setting, 130 interrupted.",
)
@expected_errors
def clone(
    folder: ResultsArgument = None,
    participant: Annotated[int | None, option("--participant", min=0, metavar="N", help="Number of the participant.")] = None,
    task: TaskOption = None,
    preset: PresetOption = None,
    results: ResultsOption = Path("results"),
    jobs: JobsOption = None,
    set_: SetOption = None,
    json: JsonOption = False,
) -> None:
    """Fit a policy to what a participant commanded: an operator variant.

    Every fourth episode is held out and judges it. Afterwards any spec has `operators: {cloned: {p7: 7}}`.
    """
    from wasp_cli.console import out, say
    from wasp_cli.drive.block import ALONE
    from wasp_cli.drive.clone import clone_participant, quality_table
    from wasp_cli.drive.session import driven_tasks, shipped
    from wasp_cli.errors import UsageError
    from wasp_cli.operators.registry import CLONED
    from wasp_cli.run.session import RunOptions, cores

    if participant is None:
        raise UsageError("whose commands?", "name the participant with --participant N")
    root = results_folder(folder, results)
    found = []
    for name in task or driven_tasks(root, participant):
        drives = f"operators={{{CLONED}: {{p{participant}: {participant}}}}}"
        loaded = shipped(name, [ALONE], participant, [0], preset, [drives, *(set_ or ())])
        found.append(clone_participant(loaded, root, participant, RunOptions(cores() if jobs is None else jobs)))
        if not json:
            out().print(quality_table(found[-1]))
            say(f"{found[-1]['label']} ({found[-1]['key']})")
    if json:
        print_json(found)


def _check(session: Session, json: bool) -> None:
    from wasp_cli.console import out, say
    from wasp_cli.drive.check import as_json, checked_blocks
    from wasp_cli.drive.command import timing_table

    found = checked_blocks(session)
    if json:
        print_json([as_json(timing) for timing in found])
    else:
        out().print(timing_table(found))
        for timing in found:
            say(timing.where_gates_fired)
        slow = min(timing.recommended for timing in found)
        late = [timing for timing in found if not timing.in_time]
        say("decisions are in time" if not late else f"too many decisions are late; --speed {slow:g} would keep them in time")
    if any(not timing.in_time for timing in found):
        raise typer.Exit(1)
