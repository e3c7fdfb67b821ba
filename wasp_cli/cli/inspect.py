"""The commands about single nodes and episodes: `wasp status`, `logs`, `show`, `explain` and `replay`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from wasp_cli.cli.options import (
    EpisodeOption,
    JsonOption,
    NodeArgument,
    ResultsArgument,
    ResultsOption,
    RunOption,
    StoredCellArgument,
    expected_errors,
    flag,
    option,
    print_json,
    results_folder,
)

if TYPE_CHECKING:
    from wasp_cli.store.find import FoundCell

NODES, EPISODES = "Runs and nodes", "Episodes"
WIDTH = 140
"""Columns of `wasp explain` where the output is no terminal."""

inspect_app = typer.Typer()


@inspect_app.command(
    rich_help_panel=NODES,
    epilog="[bold]wasp status[/]   ·   [bold]watch -n 5 wasp status results/[/]   ·   [bold]wasp status --json | jq '.[0]'[/]",
)
@expected_errors
def status(
    folder: ResultsArgument = None, run: RunOption = None, results: ResultsOption = Path("results"), json: JsonOption = False
) -> None:
    """Show active runs, or the latest: progress, failures, time left.

    It reads what a run writes to the results folder, so it also works from another terminal, and after a run was killed.
    """
    from wasp_cli.console import out
    from wasp_cli.errors import StoreError
    from wasp_cli.plan.recorded import named_run, planned_runs
    from wasp_cli.run.record import results_of
    from wasp_cli.run.show import as_json, show_status
    from wasp_cli.run.watch import shown_runs, state_of

    layout = results_of(results_folder(folder, results))
    runs = planned_runs(layout)
    if not runs:
        raise StoreError(f"no results in '{layout.root}': it holds no runs", "wasp run SPEC --results DIR writes there")
    states = shown_runs(layout, runs) if run is None else [state_of(layout, named_run(runs, run))]
    if json:
        print_json(as_json(states))
    else:
        show_status(states, out())


@inspect_app.command(rich_help_panel=NODES, epilog="[bold]wasp pause[/]   ·   [bold]wasp pause results --run 1a2b[/]")
@expected_errors
def pause(folder: ResultsArgument = None, run: RunOption = None, results: ResultsOption = Path("results")) -> None:
    """Let active runs begin nothing new. Running nodes finish; wasp resume goes on."""
    from wasp_cli.console import say
    from wasp_cli.plan.recorded import planned_runs
    from wasp_cli.run import control
    from wasp_cli.run.record import results_of

    layout = results_of(results_folder(folder, results))
    for each in control.live_runs(layout, planned_runs(layout), run):
        control.pause(layout, each)
        say(f"{each.spec}: paused; running nodes finish (run {each.run_id})")


@inspect_app.command(rich_help_panel=NODES, epilog="[bold]wasp resume[/]   ·   [bold]wasp resume results --run 1a2b[/]")
@expected_errors
def resume(folder: ResultsArgument = None, run: RunOption = None, results: ResultsOption = Path("results")) -> None:
    """Let paused runs go on. A run that is over is continued by wasp run."""
    from wasp_cli.console import say
    from wasp_cli.plan.recorded import planned_runs
    from wasp_cli.run import control
    from wasp_cli.run.record import results_of

    layout = results_of(results_folder(folder, results))
    for each in control.live_runs(layout, planned_runs(layout), run):
        was = control.resume(layout, each)
        say(f"{each.spec}: {'goes on' if was else 'was not paused'} (run {each.run_id})")


@inspect_app.command(
    rich_help_panel=NODES,
    epilog="[bold]wasp cancel 'goal1 s1 wasp laggy=0.7'[/]   ·   [bold]wasp cancel 'goal1 s1 heldout' --run quickstart[/]\n\n"
    "Exit codes: 0 done, 1 the results cannot be read, 2 no such node runs or waits.",
)
@expected_errors
def cancel(node: NodeArgument, run: RunOption = None, results: ResultsOption = Path("results")) -> None:
    """Take a node back from an active run, and what needs it. Everything else goes on; the next run computes it."""
    from wasp_cli.console import say
    from wasp_cli.plan.recorded import planned_runs
    from wasp_cli.run import control
    from wasp_cli.run.record import results_of

    layout = results_of(results)
    for taken in control.cancel(layout, control.live_runs(layout, planned_runs(layout), run), node):
        count = len(taken.dependents)
        also = f", and {count} that {'need' if count > 1 else 'needs'} it" if count else ""
        say(f"{taken.node.label} is taken back{also} (run {taken.run.run_id})")


@inspect_app.command(
    rich_help_panel=NODES,
    epilog="[bold]wasp logs 'goal1 s1 heldout'[/]   ·   [bold]tail -f \"$(wasp logs 'goal1 s1 heldout' --path)\"[/]\n\n"
    "Exit codes: 0 done, 1 the results cannot be read, 2 no such node.",
)
@expected_errors
def logs(
    node: NodeArgument,
    run: RunOption = None,
    results: ResultsOption = Path("results"),
    path: Annotated[bool, flag("--path", help="Print the path of the log, not the log.")] = False,
) -> None:
    """Print the log of a node that a run computed: when it began and ended, what it printed, why it failed."""
    import sys

    from wasp_cli.plan.recorded import named_run, planned_runs
    from wasp_cli.run.record import results_of
    from wasp_cli.run.show import find_log, write_log

    layout = results_of(results)
    runs = planned_runs(layout)
    log = find_log(layout, runs if run is None else [named_run(runs, run)], node)
    if path:
        print(log.path)
    else:
        write_log(log, sys.stdout)


@inspect_app.command(
    rich_help_panel=NODES,
    epilog="[bold]wasp show 'goal1 s1 world_model'[/]   ·   [bold]wasp show 'goal1 s1 world_model' --json | jq .provenance.git[/]\n\n"
    "Exit codes: 0 done, 1 the manifest cannot be read, 2 no such node.",
)
@expected_errors
def show(node: NodeArgument, run: RunOption = None, results: ResultsOption = Path("results"), json: JsonOption = False) -> None:
    """Show a node: its numbers, configuration, inputs, files, provenance, and last failure."""
    from dataclasses import asdict

    from wasp_cli.console import say
    from wasp_cli.plan.recorded import keys_of
    from wasp_cli.report.node import node_facts, node_lines
    from wasp_cli.run.record import results_of
    from wasp_cli.store.find import find_node

    layout = results_of(results)
    facts = node_facts(layout, find_node(layout, node, keys_of(layout, run)))
    if json:
        print_json(asdict(facts))
        return
    say(*node_lines(facts))


@inspect_app.command(
    rich_help_panel=EPISODES,
    epilog="[bold]wasp explain 'goal1 s1 wasp laggy=0.7' --episode 3[/]   ·   "
    "[bold]wasp explain 'goal1 s1 wasp laggy=0.7' --episode 3 --step 57[/]\n\n"
    "Exit codes: 0 done, 1 the rows cannot be read, 2 no such cell, episode or step.",
)
@expected_errors
def explain(
    cell: StoredCellArgument,
    episode: EpisodeOption,
    step: Annotated[
        int | None, option("--step", "-s", metavar="T", help="One decision, with its plan. (default: a summary of the episode)")
    ] = None,
    run: RunOption = None,
    results: ResultsOption = Path("results"),
    json: JsonOption = False,
) -> None:
    """Explain what an assistant did, in an episode or at one decision.

    Shows which gate fired and by how much, what was planned, and what then happened. Only stored rows are read.
    """
    import shlex

    from wasp_cli.console import out, say
    from wasp_cli.plan.recorded import keys_of
    from wasp_cli.report.explain.collect import decision_facts, summarize
    from wasp_cli.report.explain.decision_text import decision_lines
    from wasp_cli.report.explain.episode_text import episode_lines
    from wasp_cli.report.explain.facts import EpisodeSummary, as_json
    from wasp_cli.report.explain.stored import read_episode
    from wasp_cli.store.find import find_cell
    from wasp_cli.store.layout import Layout

    layout = Layout(results)
    stored = read_episode(find_cell(layout, cell, keys_of(layout, run)), episode)
    facts = summarize(stored) if step is None else decision_facts(stored, step)
    if json:
        print_json(as_json(facts))
        return
    width = out().width if out().is_terminal else WIDTH
    again = "wasp explain " + shlex.quote(stored.cell.key[:8] if stored.cell.key else str(stored.cell.path))
    if results != Path("results"):
        again += f" --results {shlex.quote(str(results))}"
    lines = episode_lines(facts, width, again) if isinstance(facts, EpisodeSummary) else decision_lines(facts, width)
    say(*lines)
    _say_place(results, stored.cell, episode, step)


@inspect_app.command(
    rich_help_panel=EPISODES,
    epilog="[bold]wasp replay 'goal1 s1 wasp laggy=0.7' --episode 0[/]   ·   "
    "[bold]wasp replay 'goal1 s1 ida laggy=0.7' -e 3 --every 2 --out a.webp[/]\n\n"
    "Exit codes: 0 done, 1 the episode cannot be replayed, 2 no such cell, episode or step, or an unsupported file format.",
)
@expected_errors
def replay(
    cell: StoredCellArgument,
    episode: EpisodeOption,
    step: Annotated[
        int | None,
        option(
            "--step", "-s", metavar="T", help="One decision: with the executed action, and with the command. (default: the whole episode)"
        ),
    ] = None,
    out: Annotated[
        Path | None,
        option(
            "--out",
            "-o",
            metavar="FILE",
            help="A .gif, .apng or .webp; a .png is animated too, but a still with --step. (default: a GIF here)",
        ),
    ] = None,
    every: Annotated[int | None, option("--every", min=1, metavar="N", help="Decisions per frame. (default: at most 125 frames)")] = None,
    run: RunOption = None,
    results: ResultsOption = Path("results"),
    json: Annotated[bool, flag("--json", help="With --step: print the numbers as JSON.")] = False,
) -> None:
    """Show an episode as a video: map, cameras, imagined futures, gates.

    The cell is replayed with its own models, bit for bit. A replay that differs from the recording is an error. With --step, the task
    goes on twice from one decision: once with the executed action, once with the command. Then both follow the operator.
    The first episode of a published cell is played with the published models, in half precision: what happens is the same, what is
    imagined nearly.

    This runs the task. For a gymnasium environment it imports the module that the cell names: only do so if you trust it.
    """
    from wasp_cli.console import following, say
    from wasp_cli.errors import UsageError
    from wasp_cli.plan.recorded import keys_of
    from wasp_cli.store.find import find_cell
    from wasp_cli.store.layout import Layout
    from wasp_cli.store.slim import without_steps
    from wasp_cli.video.replay import replay as written
    from wasp_cli.video.replay_step import replay_step

    if json and step is None:
        raise UsageError("--json needs --step", "for the numbers of an episode: wasp explain CELL --episode E --json")
    if every is not None and step is not None:
        raise UsageError("--every cannot be used with --step", "the video of one decision has a frame for every decision")
    layout = Layout(results.absolute())
    stored = find_cell(layout, cell, keys_of(layout, run))
    with following("replay") as progress:
        if step is None:
            path, made = written(layout, stored, episode, out, every, progress)
        else:
            path, verdict = replay_step(layout, stored, episode, step, out, progress)
    if step is None:
        say(f"{path}: {made.frames} frames")
        if without_steps(stored.manifest):
            say("what happens is as recorded; what is imagined comes from models in half precision, nearly those of the cell")
    elif json:
        print_json(verdict.as_json() | {"cell": stored.label, "key": stored.key, "file": str(path)})
    else:
        say(*verdict.lines(), str(path))
    if not json:
        _say_place(results, stored, episode, step)


def _say_place(results: Path, cell: FoundCell, episode: int, step: int | None) -> None:
    """Say which command shows a place in a browser; not of a file that lies outside of the results."""
    from wasp_cli.console import plain
    from wasp_cli.report.address import cell_address, open_command
    from wasp_cli.store.layout import Layout

    if cell.key is not None and cell.path.absolute().parent.parent == Layout(results.absolute()).kind("evaluate"):
        plain(f"in a browser: {open_command(results, cell_address(cell.key[:8], episode, step))}")
