"""The films of a report: on each task one episode under every method, side by side, each with the
timeline of its gates.

Which episode: of the first operator at its severity `moderate` (or its first one) and the first
seed, the one whose cost under Human-only is the median, so that neither the best nor the worst one
is picked. Worlds and the operator's mistakes are the same for all methods.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from wasp_cli.cells.cell import RecordedCell
from wasp_cli.cells.read import rows_of
from wasp_cli.cells.table import EPISODE, CellTable
from wasp_cli.errors import WaspError
from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import UNIMPAIRED
from wasp_cli.report.explain import LOOKS, Episode, read_episode, timeline
from wasp_cli.report.render import rendered
from wasp_cli.report.stats import Frame
from wasp_cli.report.tables import operator_title
from wasp_cli.store.artifact import read_manifest
from wasp_cli.store.find import KIND, FoundCell
from wasp_cli.store.layout import Layout
from wasp_cli.store.slim import without_steps
from wasp_cli.tasks.registry import TASKS

if TYPE_CHECKING:
    from markupsafe import Markup

MODERATE = "moderate"  # name of the severity whose episode is shown
FRAMES, SIZE = 90, 176  # frames of a film at most (about), and their side in px


class Sprite(NamedTuple):
    data: bytes
    mime: str
    columns: int
    size: int  # side of a frame in px
    # how many decisions had been made at each frame: 0, every, 2 every, ..., T
    decisions: list[int]
    things: tuple[tuple[str, str], ...] = ()  # what its map shows, each with its colour `#rrggbb`


# draws an episode: `video.film.sprite_of`, which needs MuJoCo and is handed over by who has it
Draw = Callable[..., Sprite]


@dataclass(frozen=True, eq=False)
class MethodFilm:
    method: str
    episode: Episode
    sprite: Sprite | None
    every: int  # decisions between two frames
    problem: str = ""  # why there are no frames


@dataclass(frozen=True)
class TaskFilms:
    task: str
    operator: str
    value: float | None
    seed: int
    number: int  # of the episode
    how: str  # it was chosen, for people
    films: tuple[MethodFilm, ...]

    @property
    def decisions(self) -> int:
        return max(film.episode.decisions for film in self.films)


def films_of(
    layout: Layout,
    frame: Frame,
    draw: Draw,
    tell: Callable[[str], None],
) -> Iterator[TaskFilms]:
    """Yield the films of every task of which a map can be drawn; `tell` is told what is being
    drawn.
    """
    for task in dict.fromkeys(cell.task for cell in frame.cells):
        # Nothing else is drawn: its environment would be imported, and the results may be
        # untrusted.
        if task not in TASKS:
            continue
        films = _of_task(layout, task, frame.cells, draw, tell)
        if films is not None:
            yield films


def _of_task(
    layout: Layout,
    task: str,
    cells: CellTable,
    draw: Draw,
    tell: Callable[[str], None],
) -> TaskFilms | None:
    full = cells.where(lambda cell: cell.task == task and cell.variant == "full")
    impaired = [
        cell for cell in full if METHODS[cell.method].impaired and cell.operator != UNIMPAIRED
    ]
    if not impaired:
        return None

    # One condition: the first operator, at the moderate severity if there is one.
    operator = impaired[0].operator
    first = impaired[0]
    for cell in impaired:
        if cell.operator == operator and cell.severity == MODERATE:
            first = cell
            break
    condition = (operator, first.value, first.seed)
    chosen = [cell for cell in impaired if (cell.operator, cell.value, cell.seed) == condition]
    chosen += [cell for cell in full if cell.operator == UNIMPAIRED and cell.seed == first.seed]

    # One episode: the first one whose cost is the (upper) median.
    alone = next((cell for cell in chosen if cell.method == "human"), None)
    reference = cells.where(lambda cell: cell == (alone or first))
    costs = reference.episodes("cost")
    place = np.flatnonzero(costs == np.sort(costs)[len(costs) // 2])[0]
    number = int(reference.episodes(EPISODE)[place])
    how = (
        "the one whose cost is the median under Human-only"
        if alone is not None
        else "the one of median cost"
    )
    if any(_is_slim(layout, cell.key) for cell in chosen):
        number, how = 0, "the first, since what is published has the steps of no other"
    films = []
    for cell in chosen:
        tell(f"{task}: {METHODS[cell.method].title}")
        film = _film(layout, cell, number, draw)
        if film is not None:
            films.append(film)
    if not films:
        return None
    return TaskFilms(task, operator, first.value, first.seed, number, how, tuple(films))


def _is_slim(layout: Layout, key: str) -> bool:
    try:
        return without_steps(read_manifest(layout, KIND, key))
    except WaspError:
        return False


def _film(layout: Layout, cell: RecordedCell, number: int, draw: Draw) -> MethodFilm | None:
    try:
        manifest = read_manifest(layout, KIND, cell.key)
        episode = read_episode(FoundCell(rows_of(layout, cell), cell.key, manifest), number)
    except WaspError:
        return None
    every = max(1, math.ceil(episode.decisions / FRAMES))
    repeat = episode.constants.action_repeat
    # an untrusted decision might last for hours here
    if repeat is None or repeat > TASKS[cell.task].env_steps:
        return MethodFilm(
            cell.method,
            episode,
            None,
            every,
            "its manifest does not say how long a decision is",
        )
    seed, rewards = int(episode.row["episode_seed"]), episode.numbers["reward"]
    try:
        sprite = draw(cell.task, repeat, seed, episode.a, episode.a_h, rewards, every, SIZE)
    except WaspError as error:
        return MethodFilm(cell.method, episode, None, every, error.message)
    return MethodFilm(cell.method, episode, sprite, every)


def film_page(films: TaskFilms) -> Markup:
    operator = operator_title(films.operator) + ("" if films.value is None else f" {films.value:g}")
    told = (
        f"Episode {films.number} of seed {films.seed} under the operator {operator}: {films.how}. "
        "Every method meets the same world and the same mistakes; the Expert is the "
        "unimpaired operator."
    )
    seconds = films.films[0].episode.constants.decision_seconds
    shown = "" if seconds is None or not math.isfinite(seconds) else f"{seconds:g}"
    things = next((film.sprite.things for film in films.films if film.sprite is not None), ())
    return rendered(
        "films.html",
        films=films,
        things=things,
        told=told,
        seconds=shown,
        methods=METHODS,
        timeline=timeline,
        looks=LOOKS.values(),
    )
