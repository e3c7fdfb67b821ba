"""An episode for its page: the gate timeline, the decisions worth a stop, and of each decision its explanation and both branches."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from wasp_cli.errors import StoreError, WaspError
from wasp_cli.metrics.necessity import ALONE, ASSISTED
from wasp_cli.notebook.cells import ListedCell
from wasp_cli.report.explain.collect import decision_facts, summarize
from wasp_cli.report.explain.decision_text import decision_lines
from wasp_cli.report.explain.episode_text import episode_lines
from wasp_cli.report.explain.stored import Episode, read_episode
from wasp_cli.report.page.films import Lane, timeline
from wasp_cli.report.stats.frame import odd_tables_refused
from wasp_cli.store.branches import BRANCHES_FILE, Branches, read_branches
from wasp_cli.store.find import FoundCell
from wasp_cli.store.layout import Layout
from wasp_cli.video.replay_step import Criterion, judge
from wasp_cli.view.words import as_html

if TYPE_CHECKING:
    from markupsafe import Markup

WIDTH = 92
"""Columns of an explanation where the page does not say how many it has room for."""
NARROWEST, WIDEST = 40, 140
KEPT = 8
"""Episodes that are kept in memory: the next decision is mostly of the same one."""


class Branch(NamedTuple):
    """One branch of a decision."""

    name: str
    cost: list[bool]
    """[W]"""
    costly: int
    reward: float


@dataclass(frozen=True)
class BranchedDecision:
    """Both branches of a decision, and what the intervention was worth."""

    branches: tuple[Branch, Branch]
    lines: list[str]


def load(cell: FoundCell, number: int) -> Episode:
    """Read an episode, or take it from memory where its file is as it was.

    Raises:
        WaspError: there is none, or its rows cannot be read.
    """
    try:
        state = cell.path.stat()
    except OSError as error:
        raise StoreError(f"{cell.path} is not there: the cell is not computed yet, or was removed") from error
    return _load(_Place(cell), number, (state.st_mtime_ns, state.st_size))


class _Place:
    """A cell as a key of a cache: by its path."""

    def __init__(self, cell: FoundCell) -> None:
        self.cell = cell

    def __hash__(self) -> int:
        return hash(self.cell.path)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Place) and other.cell.path == self.cell.path


@lru_cache(KEPT)
def _load(place: _Place, number: int, stamp: tuple[int, int]) -> Episode:
    return read_episode(place.cell, number)


def lanes(stored: Episode) -> list[Lane]:
    """Return the rows of the timeline, as reports draw it."""
    return timeline(stored)


def stops(stored: Episode) -> list[int]:
    """Return the decisions at which an intervention or a cost begins."""
    found: set[int] = set()
    for here in (stored.intervened, stored.costly):
        found |= {int(t) for t in np.flatnonzero(here & ~np.concatenate([[False], here[:-1]]))}
    return sorted(found)


def explained(stored: Episode, step: int, width: int = WIDTH) -> Markup:
    """Return the words of `wasp explain` for a decision."""
    return as_html(decision_lines(decision_facts(stored, step), min(max(width, NARROWEST), WIDEST)))


def summary(stored: Episode, command: str, width: int = WIDTH) -> Markup:
    """Return the words of `wasp explain` for the episode."""
    return as_html(episode_lines(summarize(stored), width, command))


def branches_of(layout: Layout, cell: ListedCell) -> Branches | None:
    """Read the counterfactual branches of a cell; None where there are none.

    Raises:
        StoreError: they are damaged.
    """
    if cell.branches is None:
        return None
    path = layout.within(layout.artifact("counterfactual", cell.branches) / BRANCHES_FILE)
    if not path.is_file():
        return None
    state = path.stat()
    return _branches(str(path), (state.st_mtime_ns, state.st_size))


@lru_cache(KEPT)
def _branches(path: str, stamp: tuple[int, int]) -> Branches:
    from pathlib import Path

    with odd_tables_refused(Path(path)):
        return read_branches(Path(path))


def branched(stored: Episode, found: Branches | None) -> list[int]:
    """Return the decisions of an episode that were branched."""
    return [] if found is None else found.t[found.episode == int(stored.row["episode"])].tolist()


def both(stored: Episode, found: Branches | None, step: int) -> BranchedDecision | None:
    """Return both branches of a decision; None where it was not branched."""
    if found is None:
        return None
    (rows,) = np.nonzero((found.episode == int(stored.row["episode"])) & (found.t == step))
    if not len(rows):
        return None
    row, names = int(rows[0]), {ASSISTED: "as executed", ALONE: "command alone"}
    traces: dict[str, dict[str, list[Any]]] = {
        name: {"cost": (found.cost[name][row] > 0).tolist(), "cost_env": [], "reward": found.reward[name][row].tolist()} for name in names
    }
    criterion = Criterion(found.cell.window, found.cell.tau_R, "the counterfactual branches of the cell")
    verdict = judge(stored, step, criterion, traces)
    first, second = (
        Branch(words, traces[name]["cost"], sum(traces[name]["cost"]), sum(traces[name]["reward"])) for name, words in names.items()
    )
    return BranchedDecision((first, second), verdict.lines())


def first_difference(a: Episode, b: Episode) -> int | None:
    """Return the first decision at which two episodes were driven differently, or were rewarded so; None where there is none."""
    shared = min(a.decisions, b.decisions)
    apart = np.zeros(shared, bool)
    if a.a.shape[1:] == b.a.shape[1:]:
        apart |= (a.a[:shared] != b.a[:shared]).any(1) | (a.a_h[:shared] != b.a_h[:shared]).any(1)
    apart |= a.numbers["reward"][:shared] != b.numbers["reward"][:shared]
    apart |= a.costly[:shared] != b.costly[:shared]
    if apart.any():
        return int(np.flatnonzero(apart)[0])
    return None if a.decisions == b.decisions else shared - 1


def readable(cell: FoundCell, number: int) -> tuple[Episode | None, str]:
    """Return an episode, or why it does not read."""
    try:
        return load(cell, number), ""
    except WaspError as error:
        return None, error.message + (f" ({error.hint})" if error.hint else "")
