"""The pages of cells: the table of all of them, one cell with its episodes, two cells beside each other on the same worlds."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from itertools import islice
from typing import Any

from wasp_cli.compare.paired import MEASURES, paired_episodes
from wasp_cli.errors import ArtifactError, StoreError, UsageError, WaspError
from wasp_cli.notebook.cells import ListedCell
from wasp_cli.report.address import cell_address, open_command
from wasp_cli.report.explain.stored import Episode
from wasp_cli.report.notes import invalid
from wasp_cli.report.stats.frame import odd_tables_refused
from wasp_cli.store.artifact import read_record
from wasp_cli.store.find import FoundCell
from wasp_cli.store.people import SESSION_FILE
from wasp_cli.store.slim import without_steps
from wasp_cli.store.tables import read_episodes, read_steps
from wasp_cli.view import episode
from wasp_cli.view.cells import COLUMNS, words
from wasp_cli.view.films import problem_of
from wasp_cli.view.site import Site

FIRST = 400
"""Rows that are laid out at once; a browser takes seconds for thousands. The others are on the page, and come as one scrolls."""
FACTS = 200  # lines of what is known of a person's session, at most
NAMES = ("Task", "Method", "Operator", "Severity", "Seed")
Pair = tuple[tuple[ListedCell, FoundCell], tuple[ListedCell, FoundCell]]


def cells_page(site: Site) -> str:
    """Return the table of all cells; numbers that are not read yet follow (`numbers`)."""
    site.cells.refresh()
    known, left = site.cells.numbers() if site.links.live else (site.cells.wait(), 0)
    unread = [""] * (len(COLUMNS) + 2)
    rows: list[dict[str, Any]] = [
        {
            "key": cell.key, "href": site.links.cell(cell), "words": words(cell),
            "numbers": known[cell.key].row if cell.key in known else unread,
        }
        for cell in site.cells.listed()
    ]  # fmt: skip
    choices = {name: sorted({row["words"][place] for row in rows} - {""}, key=_numeric) for place, name in enumerate(NAMES)}
    problems = site.cells.problems
    return site.render(
        "cells.html", "Cells", rows=rows, choices=choices, columns=COLUMNS, names=NAMES, left=left, problems=problems, first=FIRST
    )


def numbers(site: Site, after: int = 0) -> dict[str, Any]:
    """Return the numbers of cells that are read by now, but for the first so many; how many are known, and how many are not."""
    known, left = site.cells.numbers()
    return {"left": left, "known": len(known), "numbers": {key: shown.row for key, shown in islice(known.items(), after, None)}}


def cell_page(site: Site, text: str) -> str:
    """Return a cell: its numbers, its episodes, what is beside it."""
    listed, _ = site.cells.find(text)
    if len(listed) > 1:
        return site.render("several.html", text, text=text, cells=listed)
    cell, artifact = site.one(text)
    if not artifact.path.is_file():
        raise StoreError(f"{cell.label} has no rows", "it is not computed yet, failed, or was removed; the page of its run says which")
    shown = site.cells.one(cell)
    problem, rows = shown.reason, []
    try:
        rows = _episode_rows(site, cell, artifact)
    except WaspError as error:
        problem = problem_of(error)
    settings = (cell.task, cell.operator, cell.value, cell.seed)
    git = artifact.setting("provenance", "git", "sha")
    return site.render(
        "cell.html", cell.label, cell=cell, rows=rows, problem=problem, columns=episode.COLUMNS, session=list(_session(site, artifact)),
        numbers=[(column.heading, text) for column, text in zip(COLUMNS, shown.texts, strict=False)], slim=without_steps(artifact.manifest),
        same=[
            other for other in site.cells.listed()
            if other.key != cell.key and (other.task, other.operator, other.value, other.seed) == settings
        ],
        notes=[note for note in site.notes() if note.key == cell.key], command=open_command(site.name, cell_address(site.cells.ref(cell))),
        facts=[
            ("key", cell.key), ("computed", artifact.date), ("commit", str(git)[:12] if isinstance(git, str) else ""), ("spec", cell.spec),
        ],
    )  # fmt: skip


def _episode_rows(site: Site, cell: ListedCell, artifact: FoundCell) -> list[dict[str, Any]]:
    with odd_tables_refused(artifact.path):
        table = read_episodes([artifact.path]).to_pylist()
        with_steps = set(read_steps(artifact.path)["episode"].unique().to_pylist()) if without_steps(artifact.manifest) else None
    notes = site.notes()
    marked = {number for key, number in invalid(notes) if key == cell.key}
    noted = {note.episode for note in notes if note.key == cell.key}
    return [
        {
            "number": row["episode"], "world": row["episode_seed"], "success": bool(row["success"]),
            "href": site.links.episode(cell, row["episode"]) if with_steps is None or row["episode"] in with_steps else "",
            "texts": [column.number(row[column.key]) for column in episode.COLUMNS],
            "invalid": row["episode"] in marked, "noted": row["episode"] in noted,
        }
        for row in table
    ]  # fmt: skip


def _numeric(text: str) -> tuple[float, str]:
    try:
        return float(text.split(" ")[0]), text
    except ValueError:
        return math.inf, text


def _session(site: Site, artifact: FoundCell) -> Iterator[tuple[str, str]]:
    """Who drove when and how well in time, of a cell that a person drove; names and values, one a line."""
    if artifact.key is None:
        return
    try:
        record = read_record(site.layout.within(artifact.path.with_name(SESSION_FILE)))
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
            yield f"{before}{name}", ", ".join(map(str, part)) if isinstance(part, list) else str(part)


def beside_page(site: Site, a: str, b: str, world: int | None, step: int | None) -> str:
    """Return two cells beside each other: numbers, the worlds that both met, and one of these in both, from the first difference on."""
    if not a or not b:
        raise UsageError("two cells are needed", "/compare/cells?a=LABEL&b=LABEL")
    pair = site.one(a), site.one(b)
    worlds = _worlds(pair)
    first, second = (site.cells.one(cell).numbers for cell, _ in pair)
    rows: list[tuple[str, str, str, str]] = []
    if first is not None and second is not None:
        differences = paired_episodes(first, second).differences
        for column in COLUMNS:
            texts = [column.number(numbers.pooled[column.key]) for numbers in (first, second)]
            apart = column.number(differences[column.key].value, sign=True) if column.key in MEASURES else ""
            rows.append((column.heading, texts[0], texts[1], apart))
    if world is not None and world not in worlds:
        raise UsageError(f"not both cells met the world {world}")
    met = () if world is None else worlds[world]
    episodes: list[Episode] = []
    problem = ""
    try:
        episodes = [episode.load(artifact, row["episode"]) for (_, artifact), row in zip(pair, met, strict=False)]
    except WaspError as error:  # where one does not read, neither is shown
        problem = problem_of(error)
    differs = first_difference(*episodes) if len(episodes) == 2 else None
    start = step if step is not None else differs
    return site.render(
        "beside.html", " and ".join(cell.label for cell, _ in pair), cells=[cell for cell, _ in pair], rows=rows, world=world,
        views=[episode.episode_view(site, cell, stored, start) for (cell, _), stored in zip(pair, episodes, strict=False)],
        problem=problem, differs=differs, worlds=worlds, pair=(a, b),
    )  # fmt: skip


def _worlds(pair: Pair) -> dict[int, tuple[dict[str, Any], dict[str, Any]]]:
    """The episodes of both cells in each world that both met, by its seed."""
    tables = []
    for _, artifact in pair:
        with odd_tables_refused(artifact.path):
            tables.append({row["episode_seed"]: row for row in read_episodes([artifact.path]).to_pylist()})
    return {seed: (row, tables[1][seed]) for seed, row in tables[0].items() if seed in tables[1]}


def first_difference(a: Episode, b: Episode) -> int | None:
    """Return the first decision at which two episodes were driven differently, or were rewarded so; None where there is none."""
    shared = min(a.decisions, b.decisions)
    apart = (a.numbers["reward"][:shared] != b.numbers["reward"][:shared]) | (a.costly[:shared] != b.costly[:shared])
    if a.a.shape[1:] == b.a.shape[1:]:
        apart |= (a.a[:shared] != b.a[:shared]).any(1) | (a.a_h[:shared] != b.a_h[:shared]).any(1)
    if apart.any():
        return int(apart.argmax())
    return None if a.decisions == b.decisions else shared - 1
