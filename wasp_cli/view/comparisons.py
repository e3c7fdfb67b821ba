"""Two cells of a folder beside each other on the same worlds, and the first decision at which they differ."""

from __future__ import annotations

from typing import Any, NamedTuple

from wasp_cli.compare.paired import MEASURES, paired_episodes
from wasp_cli.errors import UsageError
from wasp_cli.notebook.cells import ListedCell
from wasp_cli.report.stats.frame import odd_tables_refused
from wasp_cli.report.tables.main import PAPER_COLUMNS
from wasp_cli.store.find import FoundCell
from wasp_cli.store.tables import read_episodes
from wasp_cli.view.episode import first_difference, readable
from wasp_cli.view.pages import episode_view
from wasp_cli.view.site import Site

Pair = tuple[tuple[ListedCell, FoundCell], tuple[ListedCell, FoundCell]]


class World(NamedTuple):
    """The same world in two cells."""

    seed: int
    episodes: tuple[int, int]
    numbers: tuple[tuple[float, float], tuple[float, float]]
    """return and cost of each"""


def beside_page(site: Site, a: str, b: str, world: int | None, step: int | None) -> str:
    """Return two cells beside each other: numbers, the worlds that both met, and one of these in both.

    Args:
        site: the folder.
        a: a cell.
        b: another one.
        world: the seed of a world that both met; None: none is shown.
        step: the decision that is shown first; None: the first that differs.

    Raises:
        WaspError: there is no such cell or world, or its rows do not read.
    """
    if not a or not b:
        raise UsageError("two cells are needed", "/compare/cells?a=LABEL&b=LABEL")
    pair = site.one(a), site.one(b)
    labels, worlds = [cell.label for cell, _ in pair], _worlds(pair)
    first, second = (site.cells.one(cell).numbers for cell, _ in pair)
    rows: list[tuple[str, str, str, str]] = []
    if first is not None and second is not None:
        differences = paired_episodes(first, second).differences
        for column in PAPER_COLUMNS:
            texts = [column.number(numbers.pooled[column.key]) for numbers in (first, second)]
            apart = column.number(differences[column.key].value, sign=True) if column.key in MEASURES else ""
            rows.append((column.heading, texts[0], texts[1], apart))
    views: list[dict[str, Any]] = []
    problem, differs = "", None
    if world is not None:
        views, problem, differs = _views(site, pair, worlds, world, step)
    return site.render(
        "beside.html", " and ".join(labels), labels=labels, rows=rows, world=world, views=views, problem=problem, differs=differs,
        worlds=[(met, site.links.beside(a, b, world=met.seed)) for met in worlds],
        hrefs=[site.links.cell(site.ref(cell)) for cell, _ in pair],
        first=None if differs is None else site.links.beside(a, b, world=world, step=differs),
    )  # fmt: skip


def _worlds(pair: Pair) -> list[World]:
    tables = []
    for _, found in pair:
        with odd_tables_refused(found.path):
            tables.append({row["episode_seed"]: row for row in read_episodes([found.path]).to_pylist()})
    rows = [(row, tables[1][seed]) for seed, row in tables[0].items() if seed in tables[1]]
    return [World(a["episode_seed"], (a["episode"], b["episode"]), ((a["return"], a["cost"]), (b["return"], b["cost"]))) for a, b in rows]


def _views(site: Site, pair: Pair, worlds: list[World], seed: int, step: int | None) -> tuple[list[dict[str, Any]], str, int | None]:
    """What the players of both episodes show, why one cannot be, and the first decision that differs."""
    world = next((met for met in worlds if met.seed == seed), None)
    if world is None:
        raise UsageError(f"not both cells met the world {seed}")
    read = [readable(found, number) for (_, found), number in zip(pair, world.episodes, strict=True)]
    problems = "; ".join(problem for _, problem in read if problem)
    episodes = [episode for episode, _ in read if episode is not None]
    differs = first_difference(episodes[0], episodes[1]) if len(episodes) == 2 else None
    start = step if step is not None else differs
    views = [
        episode_view(site, cell, found, episode, start)
        for (cell, found), (episode, _) in zip(pair, read, strict=True)
        if episode is not None
    ]
    return views, problems, differs
