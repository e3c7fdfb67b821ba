"""The pages of cells: the table of all of them, one cell with its episodes, one episode with its film, timeline and explanation."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from itertools import islice
from typing import TYPE_CHECKING, Any, NamedTuple

from wasp_cli.errors import ArtifactError, StoreError, WaspError
from wasp_cli.notebook.cells import ListedCell
from wasp_cli.report.address import cell_address, open_command
from wasp_cli.report.explain.stored import Episode
from wasp_cli.report.notes import Note, invalid
from wasp_cli.report.stats.frame import odd_tables_refused
from wasp_cli.report.tables.table import Column
from wasp_cli.store.artifact import read_record
from wasp_cli.store.find import FoundCell
from wasp_cli.store.people import SESSION_FILE
from wasp_cli.store.slim import without_steps
from wasp_cli.store.tables import read_episodes, read_steps
from wasp_cli.view.cells import COLUMNS, problem_of, words
from wasp_cli.view.episode import (
    BranchedDecision,
    both,
    branched,
    branches_of,
    explained,
    lanes,
    load,
    stops,
    summary,
)
from wasp_cli.view.films import BRANCHES, FILM, REPLAY
from wasp_cli.view.site import Site

if TYPE_CHECKING:
    from markupsafe import Markup

FIRST = 400
"""Rows that are laid out at once; a browser takes seconds for thousands. The others are on the page, and come as one scrolls."""
NAMES = ("Task", "Method", "Operator", "Severity", "Seed")
EPISODE_COLUMNS = (
    Column("return", "Return", "up"), Column("cost", "Cost", "down", digits=0), Column("goals", "Goals", "up", digits=0),
    Column("int_rate", "Int.", "down"), Column("mag", "Mag.", "down"), Column("decisions", "Decisions", digits=0),
)  # fmt: skip


class Row(NamedTuple):
    """A line of the table of cells."""

    key: str
    href: str
    words: tuple[str, ...]
    """one for each of NAMES"""
    episodes: str
    texts: list[str]
    """one for each of COLUMNS; nothing while there are no numbers"""
    state: str
    """what is odd about it"""
    pending: bool


def cells_page(site: Site) -> str:
    """Return the table of all cells; numbers that are not read yet follow (`numbers`)."""
    listed = site.cells.listed()
    site.cells.refresh()
    shown, left = (site.cells.wait(), 0) if not site.links.live else site.cells.numbers()
    marked = {key for key, _ in invalid(site.notes())}
    rows = []
    for cell in listed:
        known = shown.get(cell.key)
        if known is None:
            rows.append(Row(cell.key, site.links.cell(site.ref(cell)), tuple(words(cell)), "", [], "", True))
            continue
        state = "" if not known.reason else "damaged" if known.damaged else known.reason
        state = state or ("has invalid episodes" if cell.key in marked else "")
        episodes = str(known.episodes) if known.episodes else ""
        rows.append(Row(cell.key, site.links.cell(site.ref(cell)), tuple(words(cell)), episodes, known.texts, state, False))
    choices = {name: sorted({row.words[place] for row in rows} - {""}, key=_numeric) for place, name in enumerate(NAMES)}
    return site.render(
        "cells.html",
        "Cells",
        rows=rows,
        choices=choices,
        columns=COLUMNS,
        names=NAMES,
        left=left,
        problems=site.cells.problems,
        first=FIRST,
    )


def numbers(site: Site, after: int = 0) -> dict[str, Any]:
    """Return the numbers of cells that are read by now, but for the first so many; how many are known, and how many are not."""
    shown, left = site.cells.numbers()
    values = {
        key: [str(each.episodes or ""), *(each.texts or [""] * len(COLUMNS)), "damaged" if each.damaged else each.reason]
        for key, each in islice(shown.items(), after, None)
    }
    return {"left": left, "known": len(shown), "numbers": values}


def cell_page(site: Site, text: str) -> str:
    """Return a cell: its numbers, its episodes, what is beside it.

    Raises:
        WaspError: there is no such cell.
    """
    listed, _ = site.cells.find(text)
    if len(listed) > 1:
        return site.render("several.html", text, text=text, cells=[(cell, site.links.cell(cell.key)) for cell in listed])
    cell, found = site.one(text)
    if not found.path.is_file():
        raise StoreError(f"{cell.label} has no rows", "it is not computed yet, failed, or was removed; the page of its run says which")
    shown = site.cells.one(cell)
    problem, rows = shown.reason, []
    try:
        rows = _episode_rows(site, cell, found)
    except WaspError as error:
        problem = problem_of(error)
    numbers = [] if shown.numbers is None else [
        (column.heading, column.number(shown.numbers.pooled[column.key])) for column in COLUMNS
    ]  # fmt: skip
    return site.render(
        "cell.html", cell.label, cell=cell, found=found, numbers=numbers, rows=rows, problem=problem, columns=EPISODE_COLUMNS,
        beside=_beside(site, cell), session=_session(site, found), notes=_notes(site, cell.key), facts=_facts(cell, found),
        slim=without_steps(found.manifest), place=cell_address(site.ref(cell)),
        command=open_command(site.name, cell_address(site.ref(cell))),
    )  # fmt: skip


def episode_page(site: Site, text: str, number: int, step: int | None) -> str:
    """Return an episode; `step` is the decision that is shown first.

    Raises:
        WaspError: there is no such cell or episode.
    """
    cell, found = site.one(text)
    stored = load(found, number)
    view = episode_view(site, cell, found, stored, step)
    place = cell_address(site.ref(cell), number)
    return site.render(
        "episode.html", f"{cell.label}, episode {number}", view=view, cell=cell, number=number, place=place,
        summary=summary(stored, f"wasp explain {cell.key[:8]}"), notes=_notes(site, cell.key, number),
        around=_around(site, cell, stored), command=open_command(site.name, place),
    )  # fmt: skip


def episode_view(site: Site, cell: ListedCell, found: FoundCell, stored: Episode, step: int | None = None) -> dict[str, Any]:
    """Gather what the part of a page about one episode shows (`templates/player.html`)."""
    from wasp_cli.video.map import SEEN

    ref, number = site.ref(cell), int(stored.row["episode"])
    try:
        branches, problem = branches_of(site.layout, cell), ""
    except StoreError as error:
        branches, problem = None, error.message
    first = 0 if step is None else min(max(step, 0), stored.decisions - 1)
    # A cell that is published in part plays too, where its models are; a static page would have to hold that film.
    kinds = [FILM] if without_steps(found.manifest) and not site.links.live else [FILM, REPLAY]
    every: list[Markup] = []
    if not site.links.live:
        every = [step_part(site, cell, stored, t) for t in range(stored.decisions)]
    return {
        "label": cell.label, "key": cell.key, "number": number, "decisions": stored.decisions, "step": first, "lanes": lanes(stored),
        "stops": stops(stored), "branched": branched(stored, branches), "seconds": stored.constants.decision_seconds or 0,
        "explain": site.links.step(ref, number), "films": {kind: site.links.film(cell.key, number, kind) for kind in kinds},
        "part": step_part(site, cell, stored, first), "every": every, "problem": problem, "seen": SEEN,
        "numbers": [(column.heading, column.number(_float(stored.row[column.key]))) for column in EPISODE_COLUMNS],
    }  # fmt: skip


def step_part(site: Site, cell: ListedCell, stored: Episode, step: int, width: int | None = None) -> Markup:
    """Return the explanation of a decision, with both branches where they were computed.

    Raises:
        UsageError: there is no such decision.
    """
    from markupsafe import Markup

    stored.require(step)
    pair: BranchedDecision | None = None
    with suppress(StoreError):  # the page has said it
        pair = both(stored, branches_of(site.layout, cell), step)
    film = "" if without_steps(stored.cell.manifest) or not site.links.live or pair is None else _branch_film(site, cell, stored, step)
    words = explained(stored, step) if width is None else explained(stored, step, width)
    return Markup(site.render("step.html", "", words=words, pair=pair, step=step, film=film))


def _branch_film(site: Site, cell: ListedCell, stored: Episode, step: int) -> str:
    return f"{site.links.film(cell.key, int(stored.row['episode']), BRANCHES)}?step={step}"


def _episode_rows(site: Site, cell: ListedCell, found: FoundCell) -> list[dict[str, Any]]:
    with odd_tables_refused(found.path):
        table = read_episodes([found.path]).to_pylist()
        with_steps = _with_steps(found)
    marked = {episode: note for (key, episode), note in invalid(site.notes()).items() if key == cell.key}
    noted = {note.episode for note in site.notes() if note.key == cell.key}
    ref = site.ref(cell)
    return [
        {
            "number": row["episode"], "world": row["episode_seed"], "success": bool(row["success"]),
            "href": site.links.episode(ref, row["episode"]), "steps": with_steps is None or row["episode"] in with_steps,
            "texts": [column.number(_float(row[column.key])) for column in EPISODE_COLUMNS],
            "values": [_float(row[column.key]) for column in EPISODE_COLUMNS],
            "invalid": row["episode"] in marked, "noted": row["episode"] in noted,
        }
        for row in table
    ]  # fmt: skip


def _with_steps(found: FoundCell) -> set[int] | None:
    """The episodes whose steps are here; None where it is all of them."""
    return set(read_steps(found.path)["episode"].unique().to_pylist()) if without_steps(found.manifest) else None


def _float(value: Any) -> float:
    return float("nan") if value is None else float(value)


def _numeric(text: str) -> tuple[float, str]:
    try:
        return float(text.split(" ")[0]), text
    except ValueError:
        return math.inf, text


def _beside(site: Site, cell: ListedCell) -> list[tuple[str, str, str]]:
    """The same worlds and mistakes under other assistants: label, address, and both beside each other."""
    same = [
        other
        for other in site.cells.listed()
        if other.key != cell.key
        and (other.task, other.operator, other.value, other.seed) == (cell.task, cell.operator, cell.value, cell.seed)
    ]
    return [(each.label, site.links.cell(site.ref(each)), site.links.beside(cell.key, each.key)) for each in same]


def _around(site: Site, cell: ListedCell, stored: Episode) -> dict[str, str]:
    """The episodes before and after, and the cell."""
    ref, number = site.ref(cell), int(stored.row["episode"])
    places = {"up": site.links.cell(ref), "before": "", "after": ""}
    if number > 0 and not without_steps(stored.cell.manifest):
        places["before"] = site.links.episode(ref, number - 1)
    if number + 1 < stored.episodes and not without_steps(stored.cell.manifest):
        places["after"] = site.links.episode(ref, number + 1)
    return places


def _facts(cell: ListedCell, found: FoundCell) -> list[tuple[str, str]]:
    git = found.setting("provenance", "git", "sha")
    return [
        ("key", cell.key), ("computed", found.date), ("commit", str(git)[:12] if isinstance(git, str) else ""), ("spec", cell.spec or ""),
    ]  # fmt: skip


def _session(site: Site, found: FoundCell) -> list[tuple[str, str]]:
    """Who drove when and how well in time, of a cell that a person drove; names and values, one a line."""
    if found.key is None:
        return []
    try:
        record = read_record(site.layout.within(found.path.with_name(SESSION_FILE)))
    except (ArtifactError, StoreError) as error:
        return [("session", error.message)]
    return [] if record is None else list(_flat(record))


def _flat(value: Mapping[str, Any], before: str = "") -> list[tuple[str, str]]:
    found: list[tuple[str, str]] = []
    for name, part in value.items():
        if isinstance(part, Mapping):
            found += _flat(part, f"{before}{name}: ")
        elif isinstance(part, list) and part and all(isinstance(each, Mapping) for each in part):
            for place, each in enumerate(part, 1):
                found += _flat(each, f"{before}{name} {place}: ")
        else:
            found.append((f"{before}{name}", ", ".join(map(str, part)) if isinstance(part, list) else str(part)))
    return found[:200]


def _notes(site: Site, key: str, episode: int | None = None) -> list[Note]:
    """Those of a cell, or of one of its episodes."""
    return [note for note in site.notes() if note.key == key and (episode is None or note.episode in (None, episode))]
