"""An episode for its page: film, gate timeline, the decisions worth a stop, and of each
decision its explanation and both branches.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from rich.console import Console
from rich.style import Style
from rich.text import Text

from wasp_cli.cells.cell import RecordedCell
from wasp_cli.cells.read import odd_tables_refused
from wasp_cli.errors import StoreError
from wasp_cli.metrics.necessity import ALONE, ASSISTED
from wasp_cli.report.explain.episode import Episode, read_episode
from wasp_cli.report.explain.text import decision_lines, episode_lines
from wasp_cli.report.explain.timeline import LOOKS, timeline
from wasp_cli.report.render import cell_address, open_command
from wasp_cli.report.tables import Column
from wasp_cli.store.branches import BRANCHES_FILE, Branches, read_branches
from wasp_cli.store.find import FoundCell
from wasp_cli.store.layout import MANIFEST, Layout
from wasp_cli.store.records import read_record
from wasp_cli.store.slim import without_steps
from wasp_cli.tasks.registry import TASKS
from wasp_cli.video.map import SEEN
from wasp_cli.video.replay import Criterion, Verdict, judge, plays_on
from wasp_cli.view.films import BRANCHES, FILM, REPLAY
from wasp_cli.view.site import Site

WIDTH = 74  # columns of an explanation
KEPT = 8  # episodes that are kept in memory: the next decision is mostly of the same one
COLUMNS = (
    Column("return", "Return", "up"),
    Column("cost", "Cost", "down", digits=0),
    Column("goals", "Goals", "up", digits=0),
    Column("int_rate", "Int.", "down"),
    Column("mag", "Mag.", "down"),
    Column("decisions", "Decisions", digits=0),
)
"""What is shown of an episode in numbers."""
# classes of a page by the colours of a terminal
COLOURS = {look.style: look.kind for look in LOOKS.values()} | {"red": "bad"}


def episode_page(
    site: Site,
    text: str,
    number: int,
    step: int | None = None,
    film: Mapping[str, Any] | None = None,
) -> str:
    """Return an episode; in a bundle with the explanation of every decision, and `film` says
    what is known of its film.
    """
    cell, artifact = site.one(text)
    stored = load(artifact, number)
    whole = not without_steps(artifact.manifest)
    return site.render(
        "episode.html",
        f"{cell.label}, episode {number}",
        view=episode_view(site, cell, stored, step, film),
        cell=cell,
        number=number,
        summary=as_html(episode_lines(stored, WIDTH, f"wasp explain {cell.key[:8]}")),
        notes=[
            note for note in site.notes() if note.key == cell.key and note.episode in (None, number)
        ],
        command=open_command(site.name, cell_address(site.cells.ref(cell), number)),
        before=site.links.episode(cell, number - 1) if whole and number > 0 else "",
        after=site.links.episode(cell, number + 1)
        if whole and number + 1 < stored.episodes
        else "",
    )


def episode_view(
    site: Site,
    cell: RecordedCell,
    stored: Episode,
    step: int | None = None,
    film: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return what the player of an episode shows, for the template `player.html`.

    Args:
        site: the folder.
        cell: of the episode.
        stored: the episode.
        step: the decision that is shown first; None: the first one.
        film: what is known of its film, as `Films.state`; None in the live viewer, which asks.
    """
    number = int(stored.row["episode"])
    live = site.links.live
    film = film or {}
    branches, problem = branches_of(site.layout, cell)
    first = 0 if step is None else min(max(step, 0), stored.decisions - 1)
    return {
        "label": cell.label,
        "number": number,
        "decisions": stored.decisions,
        "step": first,
        "lanes": timeline(stored),
        "stops": stops(stored),
        "branched": [] if branches is None else branches.t[branches.episode == number].tolist(),
        "seconds": stored.constants.decision_seconds or 0,
        "problem": problem,
        "seen": SEEN,
        "replay": "" if _is_drawn(stored) else _replay_command(site, cell, number),
        "part": step_part(site, cell, stored, first, branches),
        "explain": f"{site.links.episode(cell, number)}/explain" if live else "",
        "every": []
        if live
        else [step_part(site, cell, stored, t, branches) for t in range(stored.decisions)],
        "numbers": [(column.heading, column.number(stored.row[column.key])) for column in COLUMNS],
        "films": {kind: site.links.film(cell, number, kind) for kind in (FILM, REPLAY)},
        "frames": {
            name: film.get(name) for name in ("state", "ready", "frames", "every", "legend")
        },
    }


def _is_drawn(stored: Episode) -> bool:
    """Whether films are drawn here: drawing a task of others would run a module that the results
    name.
    """
    return str(stored.row["task"]) in TASKS


def _replay_command(site: Site, cell: RecordedCell, number: int) -> str:
    """What films an episode in a terminal."""
    place = ["--results", str(site.layout.root)]
    return shlex.join(["wasp", "replay", cell.label, "--episode", str(number), *place])


def step_part(
    site: Site, cell: RecordedCell, stored: Episode, step: int, branches: Branches | None
) -> Markup:
    """Return one decision as HTML: its explanation, and of a branched one the verdict.

    Raises:
        UsageError: the episode has no such decision.
    """
    stored.require(step)
    verdict = verdict_of(stored, branches, step)
    drawn = (
        verdict is not None
        and site.links.live
        and _is_drawn(stored)
        and plays_on(stored.cell)
        and not without_steps(stored.cell.manifest)
    )
    film = (
        f"{site.links.film(cell, int(stored.row['episode']), BRANCHES)}?step={step}"
        if drawn
        else ""
    )
    return Markup(
        site.render(
            "step.html",
            "",
            words=as_html(decision_lines(stored, step, WIDTH)),
            verdict=verdict,
            film=film,
        )
    )


def load(cell: FoundCell, number: int) -> Episode:
    """Read an episode; the last KEPT ones are kept as long as their file stays as it is.

    Raises:
        StoreError: the cell has no rows, or they are damaged.
        UsageError: it has no such episode.
    """
    try:
        state = cell.path.stat()
        return _load(cell.path, cell.key, number, (state.st_mtime_ns, state.st_size))
    except FileNotFoundError as error:
        raise StoreError(
            f"{cell.path} is not there: the cell is not computed yet, or was removed"
        ) from error


@lru_cache(KEPT)
def _load(path: Path, key: str | None, number: int, stamp: tuple[int, int]) -> Episode:
    return read_episode(FoundCell(path, key, read_record(path.with_name(MANIFEST)) or {}), number)


def stops(stored: Episode) -> list[int]:
    """Return the decisions at which an intervention or a cost begins."""
    interventions, costs = (
        marks & ~np.concatenate([[False], marks[:-1]])
        for marks in (stored.intervened, stored.costly)
    )
    return [int(t) for t in np.flatnonzero(interventions | costs)]


def branches_of(layout: Layout, cell: RecordedCell) -> tuple[Branches | None, str]:
    """Return the branches of a cell where it has some, and what is wrong with them."""
    try:
        path = (
            layout.within(layout.artifact("counterfactual", cell.branches) / BRANCHES_FILE)
            if cell.branches
            else None
        )
        if path is None or not path.is_file():
            return None, ""
        with odd_tables_refused(path):
            return read_branches(path), ""
    except StoreError as error:
        return None, error.message


def verdict_of(stored: Episode, branches: Branches | None, step: int) -> Verdict | None:
    """Return what both branches of a decision say; None where it was not branched."""
    if branches is None:
        return None
    rows = np.flatnonzero(
        (branches.episode == int(stored.row["episode"])) & (branches.t == step)
    ).tolist()
    if not rows:
        return None
    traces: dict[str, dict[str, list[Any]]] = {
        name: {
            "cost": (branches.cost[name][rows[0]] > 0).tolist(),
            "reward": branches.reward[name][rows[0]].tolist(),
        }
        for name in (ASSISTED, ALONE)
    }
    return judge(
        stored,
        step,
        Criterion(
            branches.cell.window, branches.cell.tau_R, "the counterfactual branches of the cell"
        ),
        traces,
    )


def as_html(lines: Iterable[Text]) -> Markup:
    """Return lines of a terminal as HTML, with their colours as classes."""
    console = Console()
    span = Markup('<span class="{}">{}</span>')

    def piece(text: str, style: Style | None) -> str:
        look = style or Style.null()
        colour = COLOURS.get(look.color.name, "") if look.color is not None else ""
        classes = " ".join(
            filter(None, ("b" if look.bold else "", "dim" if look.dim else "", colour))
        )
        return span.format(classes, text) if classes else text

    return Markup("\n").join(
        Markup("").join(piece(part.text, part.style) for part in line.render(console))
        for line in lines
    )
