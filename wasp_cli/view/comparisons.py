"""Two cells beside each other on the same worlds, and where two results folders differ."""

from __future__ import annotations

import threading
from typing import Any, NamedTuple

from wasp_cli.compare.paired import MEASURES, paired_episodes
from wasp_cli.compare.pairs import pairs
from wasp_cli.compare.runs import Compared, compare
from wasp_cli.compare.text import headline, remarks
from wasp_cli.compare.text import tables as compared_tables
from wasp_cli.errors import UsageError, WaspError
from wasp_cli.notebook.cells import ListedCell
from wasp_cli.report.render.files import html
from wasp_cli.report.stats.frame import odd_tables_refused
from wasp_cli.report.tables.main import PAPER_COLUMNS
from wasp_cli.store.find import FoundCell
from wasp_cli.store.tables import read_episodes
from wasp_cli.view.episode import first_difference, readable
from wasp_cli.view.pages import episode_view
from wasp_cli.view.site import Site

SECOND = "with:"
"""Before a cell of the second folder."""


class World(NamedTuple):
    """The same world in two cells."""

    seed: int
    episodes: tuple[int, int]
    numbers: tuple[tuple[float, float], tuple[float, float]]
    """return and cost of each"""


class Chosen(NamedTuple):
    """A cell of either folder."""

    site: Site
    text: str
    """as an address names it"""
    cell: ListedCell
    found: FoundCell


def chosen(site: Site, text: str) -> Chosen:
    """Return a cell of this folder, or behind SECOND one of the other.

    Raises:
        UsageError: none is named, or there is no other folder.
        WaspError: there is no such cell.
    """
    if not text:
        raise UsageError("two cells are needed", "/compare/cells?a=LABEL&b=LABEL")
    where, wanted = (site.other, text.removeprefix(SECOND)) if text.startswith(SECOND) else (site, text)
    if where is None:
        raise UsageError("there is no second folder", "wasp view A --with B")
    cell, found = where.one(wanted)
    return Chosen(where, text, cell, found)


def cells_page(site: Site, a: str, b: str, world: int | None, step: int | None) -> str:
    """Return two cells beside each other: numbers, the worlds that both met, and one of these in both.

    Args:
        site: the folder.
        a: a cell.
        b: another one; with SECOND before it of the second folder.
        world: the seed of a world that both met; None: none is shown.
        step: the decision that is shown first; None: the first that differs.

    Raises:
        WaspError: there is no such cell or world, or its rows do not read.
    """
    both = chosen(site, a), chosen(site, b)
    worlds = _worlds(both)
    shown = [each.site.cells.one(each.cell).numbers for each in both]
    rows: list[tuple[str, str, str, str]] = []
    if shown[0] is not None and shown[1] is not None:
        differences = paired_episodes(shown[0], shown[1]).differences
        for column in PAPER_COLUMNS:
            texts = [column.number(each.pooled[column.key]) for each in shown if each is not None]
            apart = column.number(differences[column.key].value, sign=True) if column.key in MEASURES else ""
            rows.append((column.heading, texts[0], texts[1], apart))
    views: list[dict[str, Any]] = []
    problem, differs = "", None
    if world is not None:
        views, problem, differs = _views(both, worlds, world, step)
    return site.render(
        "beside.html", f"{both[0].cell.label} and {both[1].cell.label}", both=both, rows=rows, world=world, views=views, problem=problem,
        differs=differs, worlds=[(each, site.links.beside(a, b, world=each.seed)) for each in worlds],
        hrefs=[each.site.links.cell(each.site.ref(each.cell)) for each in both],
        first=None if differs is None else site.links.beside(a, b, world=world, step=differs),
    )  # fmt: skip


def _worlds(both: tuple[Chosen, Chosen]) -> list[World]:
    rows = []
    for each in both:
        with odd_tables_refused(each.found.path):
            rows.append({row["episode_seed"]: row for row in read_episodes([each.found.path]).to_pylist()})
    return [
        World(
            seed, (rows[0][seed]["episode"], rows[1][seed]["episode"]),
            ((rows[0][seed]["return"], rows[0][seed]["cost"]), (rows[1][seed]["return"], rows[1][seed]["cost"])),
        )
        for seed in rows[0] if seed in rows[1]
    ]  # fmt: skip


def _views(both: tuple[Chosen, Chosen], worlds: list[World], world: int, step: int | None) -> tuple[list[dict[str, Any]], str, int | None]:
    """What the players of both episodes show, why one cannot be, and the first decision that differs."""
    found = next((each for each in worlds if each.seed == world), None)
    if found is None:
        raise UsageError(f"not both cells met the world {world}")
    read = [readable(each.found, number) for each, number in zip(both, found.episodes, strict=True)]
    problems = "; ".join(problem for _, problem in read if problem)
    episodes = [episode for episode, _ in read if episode is not None]
    differs = first_difference(episodes[0], episodes[1]) if len(episodes) == 2 else None
    start = step if step is not None else differs
    views = [
        episode_view(each.site, each.cell, each.found, episode, start)
        for each, (episode, _) in zip(both, read, strict=True)
        if episode is not None
    ]
    return views, problems, differs


class Comparisons:
    """The comparison of both folders, made once in the background: it reads every cell of both."""

    def __init__(self, site: Site) -> None:
        self._site = site
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._found: list[Compared] | None = None
        self._problem: WaspError | None = None

    def get(self, wait: float) -> list[Compared] | None:
        """Return the comparison, None while it is being made; waits for it so many seconds.

        Raises:
            WaspError: there is nothing to compare.
        """
        with self._lock:
            if self._thread is None:
                self._thread = threading.Thread(target=self._compare, daemon=True, name="compare")
                self._thread.start()
        self._thread.join(wait)
        if self._problem is not None:
            raise self._problem
        return self._found

    def _compare(self) -> None:
        try:
            other = self._site.other
            if other is None:
                raise UsageError("there is no second folder", "wasp view A --with B")
            self._found = [compare(*pair) for pair in pairs(self._site.layout.root, other.layout.root)]
        except WaspError as error:
            self._problem = error


def stores_page(site: Site, comparisons: Comparisons, wait: float = 20.0) -> str:
    """Return where this folder and the second one differ, with links to the cells that do.

    Raises:
        WaspError: there is no second folder, or nothing that ran in both.
    """
    from markupsafe import Markup

    found = comparisons.get(wait)
    parts = []
    for each in found or ():
        differing = [
            (cell, site.links.beside(cell.keys[0] or "", SECOND + (cell.keys[1] or "")))
            for cell in sorted(each.having("differs"), key=lambda cell: min(cell.p.values(), default=1.0))
        ]
        # `html` has escaped every text of a table.
        tables = [Markup(html(table)) for table in compared_tables(each)]
        parts.append(
            {
                "name": each.first.spec.name,
                "headline": headline(each),
                "lines": list(remarks(each))[2:],
                "cells": differing,
                "tables": tables,
            }
        )
    return site.render("stores.html", "Two results folders", parts=parts, ready=found is not None, other=site.other)
