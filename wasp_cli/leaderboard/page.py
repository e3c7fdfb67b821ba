"""The leaderboard as Markdown."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from wasp_cli.leaderboard.board import CLASSES, Board
from wasp_cli.leaderboard.lines import Line, Shipped, ahead
from wasp_cli.report.bootstrap import Estimate
from wasp_cli.tasks.registry import TASKS

COLUMNS = (
    "Class",
    "Assistant",
    "Return",
    "Cost",
    "Cost/1000",
    "Int. eff.",
    "Int.",
    "By",
    "When",
    "wasp",
)
NUMBERS = ("Return", "Cost", "Cost/1000", "Int. eff.", "Int.")


def page_of(shipped: Shipped, submitted: Sequence[Line], board: Board, folder: Path) -> str:
    """Return the page.

    Args:
        shipped: the assistants that come with the package.
        submitted: the lines of submissions.
        board: what all of them met.
        folder: where the page will lie, for its links.
    """
    lines = [*shipped.lines, *submitted]
    parts = ["# Leaderboard", *_introduction(board)]
    for task in board.spec.tasks:
        parts += [
            f"## {TASKS[task].title}",
            _table([each for each in lines if each.task == task], folder),
        ]
    if shipped.partial:
        parts.append(
            f"Not listed, since only a part of the cells is published: "
            f"{', '.join(shipped.partial)}."
        )
    return "\n\n".join(parts) + "\n"


def _introduction(board: Board) -> list[str]:
    spec = board.spec
    operators = ", ".join(
        f"{operator} {value:g}"
        for operator, severities in spec.operators.items()
        for value in severities.values()
    )
    seeds = ", ".join(map(str, spec.seeds))
    trainings = seeds if spec.training_seed is None else str(spec.training_seed)
    classes = ", ".join(f"{bound:g}" for bound in CLASSES)
    return [
        "`wasp leaderboard` writes this page from the published rows and the folders in "
        "`leaderboard/`. [The rules](docs/leaderboard.md) say how to get here.",
        f"All assistants meet the same worlds with the same mistakes: models of training "
        f"{trainings}, operators {operators}, evaluation seeds {seeds} with "
        f"{spec.episodes} episodes. A number is the mean over these cells, in brackets its 95 % "
        f"interval over worlds.",
        f"**Class** is the first of {classes} that the effective intervention rate (*Int. eff.*: "
        "the share of decisions at which the executed action is another force than the command) "
        "does not exceed. **Bold** are those than which nobody of the same class, or of one that "
        "intervenes less, has more return and less cost. *Return* and *Cost* are those of an "
        "episode, *Cost/1000* counts per 1000 env steps.",
    ]


def _table(lines: Sequence[Line], folder: Path) -> str:
    ranked = sorted(lines, key=_rank)
    numeric = ["---:" if name in NUMBERS else "---" for name in COLUMNS]
    rows = [_cells(line, lines, folder) for line in ranked]
    return "\n".join(f"| {' | '.join(row)} |" for row in [COLUMNS, numeric, *rows])


def _rank(line: Line) -> tuple[bool, float, float]:
    """By class, then the highest return first; references last."""
    bound = line.bound
    return bound is None, bound or 0.0, -line.numbers.returned.value


def _cells(line: Line, others: Sequence[Line], folder: Path) -> list[str]:
    numbers = line.numbers
    title = escaped(line.title)
    if line.folder is not None:
        place = os.path.relpath(line.folder.absolute(), folder.absolute()).replace(os.sep, "/")
        title = f"[{title}]({place.replace(' ', '%20')})"
    if ahead(line, others):
        title = f"**{title}**"
    bound = line.bound
    return [
        "reference" if bound is None else f"{bound:g}",
        title,
        shown(numbers.returned, 1),
        shown(numbers.cost, 1),
        shown(numbers.cost_rate, 1, 1000.0),
        "" if numbers.effective is None else shown(numbers.effective, 2),
        "" if numbers.intervened is None else shown(numbers.intervened, 2),
        escaped(line.by),
        line.when,
        escaped(line.wasp),
    ]


def shown(estimate: Estimate, digits: int, scale: float = 1.0) -> str:
    """Write a number with its interval, where it has one."""
    value = f"{scale * estimate.value:.{digits}f}"
    interval = estimate.interval
    if interval is None:
        return value
    return f"{value} [{scale * interval.low:.{digits}f}, {scale * interval.high:.{digits}f}]"


def escaped(text: str) -> str:
    """Return a text that somebody else wrote as it stands in a cell of a Markdown table."""
    one_line = " ".join(text.split())
    for character in "\\|[]<>*_`":
        one_line = one_line.replace(character, f"\\{character}")
    return one_line
