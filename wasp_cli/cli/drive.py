"""`wasp drive`: a person at the controls."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from wasp_cli.cli import options
from wasp_cli.cli.command import command
from wasp_cli.cli.completion import method_names
from wasp_cli.cli.options import print_json, require_extra
from wasp_cli.cli.parameters import argument, flag, option
from wasp_cli.cli.report import show_report
from wasp_cli.console import out, say
from wasp_cli.errors import UsageError

if TYPE_CHECKING:
    from wasp_cli.drive.session import Session


@command(
    "wasp drive goal1 --method wasp",
    "wasp drive goal1 --check",
    "wasp drive specs/study.yaml --participant 7",
    codes="0 done, 1 results cannot be written, or with --check: decisions are late, 2 usage, 3 "
    "invalid spec, 130 interrupted",
)
def drive(
    what: Annotated[
        str, argument("TASK|SPEC", "A task, or a spec with people among its operators.")
    ],
    method: Annotated[
        str | None,
        option(
            "NAME",
            "The assistant; none: alone. (default: wasp)",
            "--method",
            "-m",
            among=method_names,
        ),
    ] = None,
    participant: Annotated[
        int | None, option("N", "Number of the participant. (default: 0)", min=0)
    ] = None,
    episodes: Annotated[
        int | None, option("N", "Episodes to drive. (default: 5, or what a spec says)", min=1)
    ] = None,
    number: Annotated[
        int | None,
        option(
            "N", "Number of the session: its worlds. (default: the next one)", "--session", min=0
        ),
    ] = None,
    speed: Annotated[
        float | None, option("X", "Simulated seconds per second. (default: 1)", min=0.05, max=4.0)
    ] = None,
    hide: Annotated[
        list[str] | None,
        option("NAME", "Do not show: cameras, map, cost, goals, gate or imagined (repeatable)."),
    ] = None,
    port: options.PortOption = 0,
    browser: options.BrowserOption = True,
    check: Annotated[
        bool,
        flag(
            "--check",
            "Measure with a scripted driver whether decisions are in time; record nothing.",
        ),
    ] = False,
    simulate: Annotated[
        bool,
        flag(
            "--simulate",
            "Let scripted drivers drive, through the real socket: of a spec all "
            "participants, or the one named.",
        ),
    ] = False,
    orders: Annotated[bool, flag("--orders", "Only show who drives what in which order.")] = False,
    withdraw: Annotated[
        bool,
        flag(
            "--withdraw", "Delete what the participant drove on this task, or on those of the spec."
        ),
    ] = False,
    preset: options.PresetOption = None,
    results: options.ResultsOption = options.RESULTS,
    jobs: options.JobsOption = None,
    set_: options.SetOption = None,
    json: options.JsonOption = False,
) -> None:
    """Drive a task in a browser, with an assistant or alone.

    The page is served on this machine alone, under an address with a token; through an SSH tunnel
    it works from elsewhere. What is driven is a cell like any other: wasp report, explain, replay
    and compare show it. Only with --preset models of a task are trained.
    """
    require_extra("drive", "starlette", "uvicorn", "websockets")
    from wasp_cli.drive.check import Habits
    from wasp_cli.drive.command import Wanted, drive_session, withdrawn

    hidden = tuple(hide or ())
    settings = tuple(set_ or ())
    wanted = Wanted(
        what,
        method,
        participant,
        episodes,
        number,
        speed,
        hidden,
        preset,
        settings,
        results,
        jobs,
        simulate,
    )
    if json and (orders or withdraw):
        raise UsageError("--json goes with neither --orders nor --withdraw", "leave it out")

    # One of four: show the orders, delete data, measure this machine, or drive.
    if orders:
        out().print(wanted.orders())
    elif withdraw:
        if method is not None or number is not None:
            raise UsageError(
                "--withdraw deletes all that the participant drove there",
                "leave out --method and --session",
            )
        withdrawn(wanted)
    elif check:
        _check(wanted.prepared(recorded=False), json)
    else:
        summaries = []
        for driver in wanted.everyone() if simulate else [wanted]:
            session = driver.prepared()
            habits = Habits(driver.participant or 0) if simulate else None
            try:
                summaries.append(
                    drive_session(session, port, open_browser=browser, scripted=habits)
                )
            finally:
                driver.record(session)
        if json:
            print_json(summaries if len(summaries) > 1 else summaries[0])
        elif len(summaries) > 1:
            from wasp_cli.cells.asked import asked_of
            from wasp_cli.cells.runs import last_runs, results_of

            runs = last_runs(results_of(results)).runs
            show_report(asked_of(runs[wanted.loaded().spec.name]), None)


@command(
    "wasp clone results/ --participant 7",
    codes="0 done, 1 results cannot be read or written, 2 usage, 3 invalid setting, 130 "
    "interrupted",
)
def clone(
    asked: options.Sized,
    folder: options.ResultsArgument = None,
    participant: Annotated[int | None, option("N", "Number of the participant.", min=0)] = None,
    jobs: options.JobsOption = None,
    json: options.JsonOption = False,
) -> None:
    """Fit a policy to what a participant commanded.

    It is an operator variant: afterwards any spec has `operators: {cloned: {p7: 7}}`. Every fourth
    episode is held out and judges it.
    """
    from wasp_cli.drive.block import ALONE
    from wasp_cli.drive.clone import clone_participant, quality_table
    from wasp_cli.drive.participants import driven_tasks
    from wasp_cli.drive.prepare import shipped
    from wasp_cli.operators.registry import CLONED
    from wasp_cli.run.cores import cores
    from wasp_cli.run.session import RunOptions

    if participant is None:
        raise UsageError("whose commands?", "name the participant with --participant N")
    results = options.Folder(folder=folder, results=asked.results).path
    clones = []
    for name in asked.task or driven_tasks(results, participant):
        drives = f"operators={{{CLONED}: {{p{participant}: {participant}}}}}"
        loaded = shipped(
            name, [ALONE], participant, [0], asked.preset, [drives, *(asked.set_ or ())]
        )
        cloned = clone_participant(
            loaded, results, participant, RunOptions(cores() if jobs is None else jobs)
        )
        clones.append(cloned)
        if not json:
            out().print(quality_table(cloned))
            say(f"{cloned['label']} ({cloned['key']})")
    if json:
        print_json(clones)


def _check(session: Session, json: bool) -> None:
    """Measure whether decisions are in time, and print it; ends with 1 if they are not."""
    from wasp_cli.drive.check import TOLERATED_PACE, as_json, checked_blocks, timing_table

    timings = checked_blocks(session)
    late = any(not timing.in_time for timing in timings)
    if json:
        print_json([as_json(timing) for timing in timings])
    else:
        out().print(timing_table(timings))
        say(*(timing.where_gates_fired for timing in timings))
        slow = min(timing.recommended for timing in timings)
        pace = max(timing.pace for timing in timings)
        if not late:
            say("decisions are in time")
        elif pace > TOLERATED_PACE:
            say(
                f"the world slows down, {pace:.1f} times; --speed {slow:g} would keep decisions in "
                "time"
            )
        else:
            say(f"too many decisions are late; --speed {slow:g} would keep them in time")
    if late:
        raise typer.Exit(1)
