"""The pages: runs and their nodes, the table of cells, a cell with its episodes, two cells
beside each other on the same worlds.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from typing import Any

from markupsafe import Markup

from wasp_cli.cells.cell import RecordedCell
from wasp_cli.cells.read import odd_tables_refused
from wasp_cli.cells.runs import RunRecord, named_run, planned_runs, recorded_runs
from wasp_cli.console import duration
from wasp_cli.errors import ArtifactError, StoreError, UsageError, WaspError
from wasp_cli.methods.registry import METHODS
from wasp_cli.report.explain.episode import Episode
from wasp_cli.report.notes import invalid, notes_of
from wasp_cli.report.render import cell_address, open_command
from wasp_cli.report.summary import paired_difference
from wasp_cli.report.tables import who_title
from wasp_cli.report.tables.main import PAPER_COLUMNS, full_groups, in_words, main_table
from wasp_cli.run.logs import find_log
from wasp_cli.run.status import life, pace
from wasp_cli.run.watch import ENDS, RunState, events_of, state_of
from wasp_cli.store.artifact import stored_keys, stored_kinds
from wasp_cli.store.find import FoundCell
from wasp_cli.store.people import SESSION_FILE, TIMING_FILE, read_timing, timing_summary
from wasp_cli.store.plain import open_plain, printable
from wasp_cli.store.records import read_record
from wasp_cli.store.slim import without_steps
from wasp_cli.store.tables import read_episodes, read_steps
from wasp_cli.tasks.registry import TASKS
from wasp_cli.view import episode
from wasp_cli.view.cells import COLUMNS
from wasp_cli.view.films import problem_of
from wasp_cli.view.site import Site, words

# rows that are laid out at once; a browser takes seconds for thousands. The others are on the page,
# and come as one scrolls.
FIRST = 400
MOST = 1500  # cells whose numbers are read for the first page: seconds
FACTS = 200  # lines of what is known of a person's session, at most
NAMES = ("Task", "Method", "Operator", "Severity", "Seed")


def cells_page(site: Site) -> str:
    """Return the table of all cells; numbers that are not read yet follow (`numbers`)."""
    site.cells.refresh()
    known = site.cells.known() if site.links.live else site.cells.wait()
    nothing = [""] * (len(COLUMNS) + 2)
    rows: list[dict[str, Any]] = [
        {
            "key": cell.key,
            "href": site.links.cell(cell),
            "words": words(cell),
            "numbers": known.lines.get(cell.key, nothing),
        }
        for cell in site.cells.listed()
    ]
    choices = {
        name: sorted({row["words"][place] for row in rows} - {""}, key=_numeric)
        for place, name in enumerate(NAMES)
    }
    problems = site.cells.problems
    return site.render(
        "cells.html",
        "Cells",
        rows=rows,
        choices=choices,
        columns=COLUMNS,
        names=NAMES,
        left=known.left,
        problems=problems,
        first=FIRST,
    )


def numbers(site: Site) -> dict[str, Any]:
    """Return the numbers of the cells that are read by now, and how many are not."""
    known = site.cells.known()
    return {"left": known.left, "numbers": known.lines}


def cell_page(site: Site, text: str) -> str:
    """Return a cell with its episodes.

    Raises:
        StoreError: it has no rows.
        UsageError: the text names no cell, or several.
    """
    cell, artifact = site.one(text)
    if not artifact.path.is_file():
        raise StoreError(
            f"{cell.label} has no rows",
            "it is not computed yet, failed, or was removed; the page of its run says which",
        )
    known = site.cells.read([cell])
    _, *texts, problem = known.lines[cell.key]
    if cell.key in known.missing:
        problem = known.missing[cell.key].reason
    rows = []
    try:
        rows = _episode_rows(site, cell, artifact)
    except WaspError as error:
        problem = problem_of(error)
    settings = (cell.task, cell.operator, cell.value, cell.seed)
    git = artifact.setting("provenance", "git", "sha")
    return site.render(
        "cell.html",
        cell.label,
        cell=cell,
        rows=rows,
        problem=problem,
        columns=episode.COLUMNS,
        session=list(_session(site, artifact)),
        numbers=[
            (column.heading, text) for column, text in zip(COLUMNS, texts, strict=True) if text
        ],
        slim=without_steps(artifact.manifest),
        same=[
            other
            for other in site.cells.listed()
            if other.key != cell.key
            and (other.task, other.operator, other.value, other.seed) == settings
        ],
        notes=[note for note in site.notes() if note.key == cell.key],
        command=open_command(site.name, cell_address(site.cells.ref(cell))),
        facts=[
            ("key", cell.key),
            ("computed", artifact.date),
            ("commit", str(git)[:12] if isinstance(git, str) else ""),
            ("spec", cell.spec),
        ],
    )


def _episode_rows(site: Site, cell: RecordedCell, artifact: FoundCell) -> list[dict[str, Any]]:
    with odd_tables_refused(artifact.path):
        table = read_episodes([artifact.path]).to_pylist()
        with_steps = (
            set(read_steps(artifact.path)["episode"].unique().to_pylist())
            if without_steps(artifact.manifest)
            else None
        )
    notes = site.notes()
    marked = {number for key, number in invalid(notes) if key == cell.key}
    noted = {note.episode for note in notes if note.key == cell.key}
    return [
        {
            "number": row["episode"],
            "world": row["episode_seed"],
            "success": bool(row["success"]),
            "href": site.links.episode(cell, row["episode"])
            if with_steps is None or row["episode"] in with_steps
            else "",
            "texts": [column.number(row[column.key]) for column in episode.COLUMNS],
            "invalid": row["episode"] in marked,
            "noted": row["episode"] in noted,
        }
        for row in table
    ]


def _numeric(text: str) -> tuple[float, str]:
    with suppress(ValueError):
        return float(text.split(" ")[0]), text
    return math.inf, text


def _session(site: Site, artifact: FoundCell) -> Iterator[tuple[str, str]]:
    """Who drove when and how well in time, of a cell that a person drove; names and values, one
    a line.
    """
    if artifact.key is None:
        return
    try:
        record = read_record(site.layout.within(artifact.path.with_name(SESSION_FILE)))
        timing = site.layout.within(artifact.path.with_name(TIMING_FILE))
        if record and timing.exists():
            with odd_tables_refused(timing):
                record["timing"] = timing_summary(read_timing(timing))
    except (ArtifactError, StoreError) as error:
        yield "session", error.message
    else:
        yield from islice(_flat(record or {}), FACTS)


def _flat(value: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, str]]:
    for name, part in value.items():
        if isinstance(part, Mapping):
            yield from _flat(part, f"{before}{name}: ")
        elif isinstance(part, list) and part and all(isinstance(entry, Mapping) for entry in part):
            for place, entry in enumerate(part, 1):
                yield from _flat(entry, f"{before}{name} {place}: ")
        else:
            yield (
                f"{before}{name}",
                ", ".join(map(str, part)) if isinstance(part, list) else str(part),
            )


def beside_page(site: Site, a: str, b: str, world: int | None, step: int | None) -> str:
    """Return two cells beside each other; with a world, also their two episodes in it.

    Raises:
        UsageError: a text names no cell, or not both cells met the world.
    """
    if not a or not b:
        raise UsageError("two cells are needed", "/compare/cells?a=LABEL&b=LABEL")

    # The episodes of both by world, and the worlds that both met.
    pair = (site.one(a), site.one(b))
    tables = []
    for _, artifact in pair:
        with odd_tables_refused(artifact.path):
            tables.append(
                {row["episode_seed"]: row for row in read_episodes([artifact.path]).to_pylist()}
            )
    worlds = {seed: (row, tables[1][seed]) for seed, row in tables[0].items() if seed in tables[1]}

    # Their numbers, and the mean difference in the worlds of both.
    known = site.cells.read([cell for cell, _ in pair])
    first, second = (known.cell(cell.key) for cell, _ in pair)
    rows: list[tuple[str, str, str, str]] = []
    if first is not None and second is not None:
        for column in COLUMNS:
            one = column.number(float(first.pooled(column.key)[0]))
            other = column.number(float(second.pooled(column.key)[0]))
            apart = paired_difference(second, first, column.key)
            told = "" if apart is None else column.number(apart, sign=True)
            rows.append((column.heading, one, other, told))

    # The two episodes in one world, from the first decision at which they part.
    if world is not None and world not in worlds:
        raise UsageError(f"not both cells met the world {world}")
    met = () if world is None else worlds[world]
    episodes: list[Episode] = []
    problem = ""
    try:
        episodes = [
            episode.load(artifact, row["episode"])
            for (_, artifact), row in zip(pair, met, strict=False)
        ]
    except WaspError as error:  # where one does not read, neither is shown
        problem = problem_of(error)
    differs = first_difference(*episodes) if len(episodes) == 2 else None
    start = step if step is not None else differs
    return site.render(
        "beside.html",
        " and ".join(cell.label for cell, _ in pair),
        cells=[cell for cell, _ in pair],
        rows=rows,
        world=world,
        views=[
            episode.episode_view(site, cell, stored, start)
            for (cell, _), stored in zip(pair, episodes, strict=False)
        ],
        problem=problem,
        differs=differs,
        worlds=worlds,
        pair=(a, b),
    )


def first_difference(a: Episode, b: Episode) -> int | None:
    """Return the first decision at which two episodes were driven differently, or were rewarded
    so; None where there is none.
    """
    shared = min(a.decisions, b.decisions)
    apart = (a.numbers["reward"][:shared] != b.numbers["reward"][:shared]) | (
        a.costly[:shared] != b.costly[:shared]
    )
    if a.a.shape[1:] == b.a.shape[1:]:
        apart |= (a.a[:shared] != b.a[:shared]).any(1) | (a.a_h[:shared] != b.a_h[:shared]).any(1)
    if apart.any():
        return int(apart.argmax())
    return None if a.decisions == b.decisions else shared - 1


LISTED = 30  # runs on the first page; the newest ones
TAIL = 200_000  # bytes of a log that are shown: its end
# said of a node that is not in the store, since everything that needs it was there
UNNEEDED = "not needed"
STATES = ("done", "running", "failed", "blocked", "waiting", "cached", UNNEEDED)


def runs_of(site: Site) -> list[RunRecord]:
    """Return the runs of the folder, newest first; none where they do not read."""
    with suppress(StoreError):
        return planned_runs(site.layout)
    return []


def home_page(site: Site) -> str:
    """Return the first page: runs, main tables, reports, notes, and what is wrong."""
    runs = runs_of(site)
    states = [state_of(site.layout, run) for run in runs[:LISTED]]
    problems = list(site.cells.problems)
    notes = []
    try:
        notes = notes_of(site.layout)
    except StoreError as error:
        problems.append(error.message)
    return site.render(
        "home.html",
        "Results",
        states=[(state, life(state, datetime.now(UTC))) for state in states],
        more=max(len(runs) - LISTED, 0),
        kinds=[(kind, len(stored_keys(site.layout, kind))) for kind in stored_kinds(site.layout)],
        published=list(_published(site)),
        notes=notes[-50:][::-1],
        left_out=len(invalid(notes)),
        problems=problems,
        listed={cell.key: cell for cell in site.cells.listed()},
        tables=list(main_tables(site)),
        columns=PAPER_COLUMNS,
    )


def main_tables(site: Site) -> Iterator[dict[str, Any]]:
    """Yield of each recorded spec, the newest first: its main table, where its rows lead, the same
    in words, and its report.

    All its cells are read for it. Folders with more than MOST cells have the table in their reports
    alone.
    """
    listed: dict[str, list[RecordedCell]] = {}
    with suppress(StoreError):  # what is wrong is among the problems of the page
        for spec, run in reversed(recorded_runs(site.layout).runs.items()):
            with suppress(ArtifactError):
                # what is installed
                here = [cell for cell in run.cells if cell.method in METHODS and cell.task in TASKS]
                if here:
                    listed[spec] = here
    if not listed or sum(map(len, listed.values())) > MOST:
        return
    known = site.cells.wait(cell for cells in listed.values() for cell in cells)
    for spec, cells in listed.items():
        frame = known.frame(cells)
        if len(frame.cells):
            yield {
                "spec": spec,
                "table": main_table(frame),
                "said": in_words(frame),
                "report": site.links.shown_report(spec, site.layout),
                "rows": [
                    site.links.row(group.task, who_title(group.method, "full"))
                    for group in full_groups(frame)
                ],
            }


def reports(site: Site) -> Iterator[Path]:
    """Yield the folders of the reports that lie in the results folder."""
    for folder in (site.layout.root / "reports", site.layout.published / "reports"):
        with suppress(OSError, StoreError):
            yield from (
                report
                for report in sorted(site.layout.within(folder).iterdir())
                if report.is_dir() and not report.is_symlink()
            )


def _published(site: Site) -> Iterator[tuple[str, list[tuple[str, str]]]]:
    for report in reports(site):
        pages = [
            path for path in (report / "report.html", report / "report.md") if os.path.lexists(path)
        ]
        name = str(report if site.links.live else report.relative_to(site.layout.root))
        yield name, [(path.name, site.links.report(str(path))) for path in pages]


def run_page(site: Site, run_id: str) -> str:
    """Return a run and how far it is. Raises UnknownName where there is no such run."""
    run = named_run(runs_of(site), run_id)
    return site.render("run.html", f"Run of {run.spec}", run=run, now=run_now(site, run_id))


def run_now(site: Site, run_id: str) -> Markup:
    """Return how far a run is, as the part of its page that is renewed."""
    run = named_run(runs_of(site), run_id)
    state = state_of(site.layout, run)
    counts = {
        "done": state.done + state.shared,
        "running": state.running,
        "failed": len(state.failed),
    }
    moment = datetime.now(UTC)
    stages = stages_of(site, run, state)
    running = [
        (node, duration((moment - node.started).total_seconds()) if node.started else "")
        for node in state.active
        if not node.gone
    ]
    return Markup(
        site.render(
            "now.html",
            "",
            run=run,
            state=state,
            life=life(state, moment),
            pace=pace(state),
            counts=counts,
            stages=stages,
            states=[name for name in STATES if any(counts[name] for counts in stages.values())],
            running=running if state.state == "running" else [],
        )
    )


def stages_of(site: Site, run: RunRecord, state: RunState) -> dict[str, Counter[str]]:
    """Return by kind of node how many are in each of STATES."""
    ended = [event for event in events_of(site.layout, run.run_id) if event.get("event") in ENDS]
    ends = {
        str(event.get("key")): "done" if event["event"] == "shared" else event["event"]
        for event in ended
    }
    active = (
        {node.key for node in state.active if not node.gone} if state.state == "running" else set()
    )
    stages: dict[str, Counter[str]] = {}
    for node in run.nodes.values():
        before = "waiting" if node.runs else "cached"
        if node.state == "unneeded":
            before = UNNEEDED
        stages.setdefault(node.kind, Counter())[
            "running" if node.key in active else ends.get(node.key) or before
        ] += 1
    return stages


def log_text(site: Site, run: str, key: str) -> str:
    """Return the end of the log of a node, at most TAIL bytes of it, without what a terminal would
    have overwritten.

    Raises:
        UnknownName: there is no such run, or no such log.
        StoreError: the log cannot be read.
    """
    log = find_log(site.layout, [named_run(runs_of(site), run)], key)
    try:
        with open_plain(site.layout.within(log.path)) as file:
            file.seek(max(file.seek(0, 2) - TAIL, 0))
            text = file.read(TAIL).decode("utf-8", "replace")
    except OSError as error:
        raise StoreError(
            f"cannot read '{log.path}': {(error.strerror or str(error)).lower()}"
        ) from error
    return "\n".join(
        printable(line.rpartition("\r")[2]) for line in text.replace("\r\n", "\n").split("\n")
    )
