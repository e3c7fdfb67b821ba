"""The commands about runs, nodes and episodes: `wasp status`, `logs`, `show`, `explain`,
`replay`, `view` and `note`.
"""

from __future__ import annotations

import shlex
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from wasp_cli.cli import options
from wasp_cli.cli.options import (
    argument,
    command,
    directory,
    flag,
    option,
    print_json,
    require_extra,
)
from wasp_cli.console import following, out, plain, say
from wasp_cli.errors import StoreError, UsageError
from wasp_cli.store.layout import Layout

if TYPE_CHECKING:
    from wasp_cli.report.notes import Mark
    from wasp_cli.store.find import FoundCell

WIDTH = 140


@command("wasp status", "watch -n 5 wasp status results/", "wasp status --json | jq '.[0]'")
def status(
    results: options.Folder, run: options.RunOption = None, json: options.JsonOption = False
) -> None:
    """Show active runs, or the latest: progress, time left.

    It reads what a run writes to the results folder, so it also works from another terminal, and
    after a run was killed.
    """
    from wasp_cli.cells.runs import named_run, planned_runs, results_of
    from wasp_cli.run.show import as_json, show_status
    from wasp_cli.run.watch import shown_runs, state_of

    layout = results_of(results.path)
    runs = planned_runs(layout)
    if not runs:
        hint = "wasp run SPEC --results DIR writes there, and copies published results"
        raise StoreError(f"no results in '{layout.root}': it holds no runs", hint)
    states = shown_runs(layout, runs) if run is None else [state_of(layout, named_run(runs, run))]
    if json:
        print_json(as_json(states))
    else:
        show_status(states, out())


@command(
    "wasp logs 'goal1 s1 wasp laggy=0.7'",
    "tail -f \"$(wasp logs 'goal1 s1 wasp laggy=0.7' --path)\"",
    codes="0 done, 1 the results cannot be read, 2 no such node",
)
def logs(
    node: options.NodeArgument,
    place: options.Whereabouts,
    path: Annotated[bool, flag("--path", "Print the path of the log, not the log.")] = False,
) -> None:
    """Print the log of a node.

    When it began and ended, what it printed, why it failed.
    """
    from wasp_cli.cells.runs import named_run, planned_runs, results_of
    from wasp_cli.run.show import find_log, write_log

    layout = results_of(place.results)
    runs = planned_runs(layout)
    if place.run is not None:  # the logs of a sweep's values lie in the sweep
        named = named_run(planned_runs(layout, values=True), place.run)
        runs = [
            replace(run, plans=named.plans)
            for run in runs
            if named.run_id in (run.run_id, *run.values)
        ]
    log = find_log(layout, runs, node)
    if path:
        print(log.path)
    else:
        write_log(log, sys.stdout)


@command(
    "wasp show 'goal1 s1 world_model'",
    "wasp show 'goal1 s1 world_model' --json | jq .provenance.git",
    codes="0 done, 1 the manifest cannot be read, 2 no such node",
)
def show(
    node: options.NodeArgument, place: options.Whereabouts, json: options.JsonOption = False
) -> None:
    """Show a node: numbers, inputs, provenance, last failure."""
    from wasp_cli.cells.runs import keys_of
    from wasp_cli.report.node import node_facts, node_lines
    from wasp_cli.store.find import find_node

    layout = Layout(place.results)
    facts = node_facts(layout, find_node(layout, node, keys_of(layout, place.run, node)))
    if json:
        print_json(facts)
    else:
        say(*node_lines(facts))


@command(
    "wasp explain 'goal1 s1 wasp laggy=0.7' --episode 3",
    "wasp explain 'goal1 s1 wasp laggy=0.7' --episode 3 --step 57",
    codes="0 done, 1 the rows cannot be read, 2 no such cell, episode or step",
)
def explain(
    cell: options.StoredCellArgument,
    episode: options.EpisodeOption,
    place: options.Whereabouts,
    step: Annotated[
        int | None,
        option(
            "T", "One decision, with its plan. (default: a summary of the episode)", "--step", "-s"
        ),
    ] = None,
    json: options.JsonOption = False,
) -> None:
    """Explain what an assistant did, and why.

    In an episode, or at one decision: which gate fired and by how much, what was planned, and what
    then happened. Only stored rows are read.
    """
    from wasp_cli.cells.runs import keys_of
    from wasp_cli.report.explain import read_episode
    from wasp_cli.report.explain.facts import decision_json, episode_json
    from wasp_cli.report.explain.text import decision_lines, episode_lines
    from wasp_cli.store.find import find_cell

    layout = Layout(place.results)
    stored = read_episode(find_cell(layout, cell, keys_of(layout, place.run, cell)), episode)
    if json:
        print_json(episode_json(stored) if step is None else decision_json(stored, step))
        return
    width = out().width if out().is_terminal else WIDTH
    again = "wasp explain " + shlex.quote(
        stored.cell.key[:8] if stored.cell.key else str(stored.cell.path)
    )
    if place.results != options.RESULTS:
        again += f" --results {shlex.quote(str(place.results))}"
    say(
        *(
            episode_lines(stored, width, again)
            if step is None
            else decision_lines(stored, step, width)
        )
    )
    _say_address(place.results, stored.cell, episode, step)


@command(
    "wasp replay 'goal1 s1 wasp laggy=0.7' --episode 0",
    "wasp replay 'goal1 s1 ida laggy=0.7' -e 3 --every 2 --out a.webp",
    codes="0 done, 1 the episode cannot be replayed, 2 no such cell, episode or step, or an "
    "unsupported file format",
)
def replay(
    cell: options.StoredCellArgument,
    episode: options.EpisodeOption,
    place: options.Whereabouts,
    step: Annotated[
        int | None,
        option(
            "T",
            "One decision, with the executed action and with the command. (default: the "
            "whole episode)",
            "--step",
            "-s",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        option(
            "FILE",
            "A .gif, .apng, .webp or .png (with --step: a still). (default: a GIF here)",
            "--out",
            "-o",
        ),
    ] = None,
    every: Annotated[
        int | None, option("N", "Decisions per frame. (default: at most 125 frames)", min=1)
    ] = None,
    json: Annotated[bool, flag("--json", "With --step: print the numbers as JSON.")] = False,
) -> None:
    """Show an episode, or one decision, as a video.

    With map, cameras, imagined futures and gates. The cell is replayed with its own models, bit for
    bit; a replay that differs from the recording is an error. With --step, the task goes on twice
    from one decision: once with the executed action, once with the command. Then both follow the
    operator. The first episode of a published cell is played alone: what happens is the same, and
    what is imagined to rounding.

    This runs the task. For a gymnasium environment it imports the module that the cell names: only
    do so if you trust it.
    """
    from wasp_cli.cells.runs import keys_of
    from wasp_cli.store.find import find_cell
    from wasp_cli.store.slim import without_steps
    from wasp_cli.video.replay import replay as written
    from wasp_cli.video.replay import replay_step

    if json and step is None:
        raise UsageError(
            "--json needs --step",
            "for the numbers of an episode: wasp explain CELL --episode E --json",
        )
    if every is not None and step is not None:
        raise UsageError(
            "--every cannot be used with --step",
            "the video of one decision has a frame for every decision",
        )
    layout = Layout(place.results.absolute())
    stored = find_cell(layout, cell, keys_of(layout, place.run, cell))
    with following("replay") as progress:
        if step is None:
            path, made = written(layout, stored, episode, out, every, progress)
        else:
            path, verdict = replay_step(layout, stored, episode, step, out, progress)
    if step is None:
        say(f"{path}: {made.frames} frames")
        if without_steps(stored.manifest):
            say(
                "what happens is as recorded; the episode is played alone, so that what is "
                "imagined may round differently"
            )
    elif json:
        print_json(asdict(verdict) | {"cell": stored.label, "key": stored.key, "file": str(path)})
    else:
        say(*verdict.lines(), str(path))
    if not json:
        _say_address(place.results, stored, episode, step)


def _say_address(results: Path, cell: FoundCell, episode: int, step: int | None) -> None:
    """Say which command shows a place in a browser; not of a file that lies outside of the
    results.
    """
    from wasp_cli.report.render import cell_address, open_command

    if cell.key is not None and cell.path.absolute().parent.parent == Layout(
        results.absolute()
    ).kind("evaluate"):
        plain(f"in a browser: {open_command(results, cell_address(cell.key[:8], episode, step))}")


@command(
    "wasp view results/",
    "wasp view results/ --page '/cell/goal1 s1 wasp laggy=0.7/episode/3?step=100'",
    codes="0 done, 1 the results cannot be read, 2 usage, or packages of the extra 'web' are "
    "missing",
)
def view(
    results: options.Folder,
    page: Annotated[
        str,
        option("PLACE", "The page that opens: an address as pages and commands print it."),
    ] = "/",
    # the word that `--page` had before, and that commands printed
    open_: Annotated[
        str | None, option("PLACE", "The same as --page.", "--open", hidden=True)
    ] = None,
    port: options.PortOption = 0,
    browser: options.BrowserOption = True,
    bundle: Annotated[
        Path | None,
        directory("Write the pages to a folder that works from any host, and serve nothing."),
    ] = None,
    cell: Annotated[
        list[str] | None,
        option(
            "CELL",
            "With --bundle: a cell whose episodes have pages (repeatable). (default: all cells)",
        ),
    ] = None,
    episodes: Annotated[
        str | None, option("N,N,...", "With --bundle: which of their episodes. (default: 0)")
    ] = None,
) -> None:
    """Walk through results in a browser.

    Cells, episodes, decisions and why; runs as they go on. The pages are served on this machine
    alone, under an address with a token; through an SSH tunnel they work from elsewhere. Nothing of
    the results is executed or changed.
    """
    require_extra("web", "starlette", "uvicorn")
    from wasp_cli.view.server import bundle as write_bundle
    from wasp_cli.view.server import serve
    from wasp_cli.view.site import site_of

    if open_ is not None and page != "/":
        raise UsageError("--page and --open are one option", "leave out --open")
    place = page if open_ is None else open_
    if bundle is not None:
        if port or place != "/":
            raise UsageError(
                "--port and --page are for a server, and --bundle starts none", "leave them out"
            )
        write_bundle(site_of(results.path, films=False), bundle, cell or [], episodes or "0")
        return
    if cell or episodes:
        raise UsageError(
            "--cell and --episodes go with --bundle",
            "wasp view results/ --bundle DIR --cell LABEL --episodes 0,3",
        )
    serve(site_of(results.path), port, place, open_browser=browser)


@command(
    "wasp note 'goal1 s1 wasp laggy=0.7' --episode 3 --invalid 'the robot starts within a hazard'",
    "wasp note 'goal1 s1 wasp laggy=0.7' 'worth a look'",
    "wasp note 'goal1 s1 wasp laggy=0.7' -e 3 --valid ''",
    codes="0 done, 1 the note cannot be written, 2 no such cell or episode",
)
def note(
    cell: Annotated[
        str, argument("CELL", "A label ('goal1 s1 wasp laggy=0.7'), or the beginning of a key.")
    ],
    text: Annotated[str, argument("TEXT", "What there is to say.")],
    place: options.Whereabouts,
    episode: Annotated[
        int | None, option("E", "One episode. (default: the whole cell)", "--episode", "-e", min=0)
    ] = None,
    invalid: Annotated[bool, flag("--invalid", "Reports leave it out, and say so.")] = False,
    valid: Annotated[bool, flag("--valid", "Take an earlier --invalid back.")] = False,
    author: Annotated[
        str | None, option("NAME", "Who says so. (default: the user of this machine)")
    ] = None,
) -> None:
    """Note something about a cell or an episode.

    Or mark it as invalid. Notes are kept in notes.jsonl beside the store; no result changes.
    Reports show them, leave out what is invalid, and name it.
    """
    from wasp_cli.cells.runs import keys_of
    from wasp_cli.report.notes import Note, add_note, one_line
    from wasp_cli.store.find import find_cell
    from wasp_cli.store.tables import read_episodes

    if invalid and valid:
        raise UsageError("--invalid and --valid exclude each other", "name one of them")
    layout = Layout(place.results)
    stored = find_cell(layout, cell, keys_of(layout, place.run, cell))
    if (
        stored.key is None
        or stored.path.absolute().parent.parent != layout.kind("evaluate").absolute()
    ):
        raise UsageError(
            f"'{cell}' is no cell of '{place.results}'",
            "a note is of a cell in the store: name it by its label or its key",
        )
    if episode is not None:
        numbers = read_episodes([stored.path])["episode"].to_pylist()
        if episode not in numbers:
            raise UsageError(
                f"there is no episode {episode}",
                f"this cell has the episodes {min(numbers)} to {max(numbers)}",
            )
    mark: Mark = "invalid" if invalid else "valid" if valid else ""
    say(
        one_line(
            add_note(
                layout,
                Note(stored.key, stored.label or stored.key, episode, text, mark, author or ""),
            )
        )
    )
