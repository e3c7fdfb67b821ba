"""Draws `architecture.svg`: the rooms in their layers, and the two ways through them. `python
docs/pictures/architecture.py` writes it.
"""

from __future__ import annotations

from html import escape
from pathlib import Path

LAYERS: tuple[tuple[tuple[str, str], ...], ...] = (
    (("cli", "commands, options"),),
    (
        ("drive", "people at the controls"),
        ("view", "walking through results"),
        ("export", "other formats"),
    ),
    (("notebook", "results and models in one line"), ("web", "a local server")),
    (("video", "films, replays"), ("compare", "two runs"), ("leaderboard", "submissions")),
    (("run", "workers, progress"), ("report", "tables, figures, claims, page")),
    (("cells", "runs, cells, episodes"),),
    (("plan", "grid, keys, reuse"),),
    (("spec", "YAML, presets, validation"),),
    (("stages", "node kinds; they leave numbers"),),
    (("learning", "training, closed loop"), ("store", "artifacts, rows")),
    (("methods", "assistants: WASP, IDA, ..."),),
    (("operators", "impaired operators"),),
    (("models", "networks: RSSM, policies, critics"),),
    (("tasks", "worlds, cameras"), ("metrics", "what counts")),
)
"""Rooms and what they hold, from above; a room imports only what stands below it (the layers
contract in pyproject.toml).
"""
KEYED = frozenset(
    {"stages", "learning", "store", "methods", "operators", "models", "tasks", "metrics"}
)
"""Rooms whose source may be in a key."""
SPEC_TO_TABLE = (
    ("spec", "reads and validates the YAML"),
    ("plan", "lays out nodes, gives each its key"),
    ("store", "is asked which keys are there"),
    ("run", "hands the others to workers"),
    ("stages", "train, evaluate, leave files"),
    ("cells", "reads the rows into one table"),
    ("report", "prints tables, figures, claims"),
)
DECISION = (
    ("tasks", "camera images of the world"),
    ("models", "the filter: images to a latent"),
    ("operators", "the command, impaired"),
    ("methods", "the assistant may correct it"),
    ("tasks", "execute the action: reward, cost"),
    ("metrics", "return, cost, interventions"),
)

LEFT, TOP, ROOMS, ROW, GAP = 24, 54, 520, 38, 8
WIDTH, HEIGHT = 960, TOP + len(LAYERS) * (ROW + GAP) + 16
INK, GREY, PAPER = "#1b1f24", "#59636e", "#fbfaf7"
FREE, FREE_EDGE, KEY, KEY_EDGE = "#e6eef7", "#7d9cbd", "#fdeccf", "#c99a45"
ONE, TWO = "#0072B2", "#B0416B"
RADIUS = 9


def text(
    x: float,
    y: float,
    words: str,
    size: int,
    colour: str = INK,
    weight: int = 400,
    anchor: str = "start",
) -> str:
    """A line of text with its baseline at (x, y) px."""
    style = f'font-size="{size}" fill="{colour}" font-weight="{weight}" text-anchor="{anchor}"'
    return f'<text x="{x:g}" y="{y:g}" {style}>{escape(words)}</text>'


def mark(x: float, y: float, number: int, colour: str) -> str:
    """A numbered disc around (x, y) px."""
    return f'<circle cx="{x:g}" cy="{y:g}" r="{RADIUS}" fill="{colour}"/>' + text(
        x, y + 4, str(number), 11, "#ffffff", 700, "middle"
    )


def room(x: float, y: float, width: float, name: str, holds: str) -> list[str]:
    """A room, with the numbers of the steps that it takes part in."""
    fill, edge = (KEY, KEY_EDGE) if name in KEYED else (FREE, FREE_EDGE)
    parts = [
        f'<rect x="{x:g}" y="{y:g}" width="{width:g}" height="{ROW}" rx="5" fill="{fill}" '
        f'stroke="{edge}"/>'
    ]
    parts.append(text(x + 10, y + 17, name, 14, INK, 700))
    parts.append(text(x + 10, y + 31, holds, 11, GREY))
    steps = [(number, ONE) for number, (where, _) in enumerate(SPEC_TO_TABLE, 1) if where == name]
    steps += [(number, TWO) for number, (where, _) in enumerate(DECISION, 1) if where == name]
    for place, (number, colour) in enumerate(reversed(steps)):
        parts.append(mark(x + width - 15 - 22 * place, y + 15, number, colour))
    return parts


def steps(
    x: float, y: float, title: str, colour: str, route: tuple[tuple[str, str], ...]
) -> list[str]:
    """A way as a numbered list."""
    parts = [text(x, y, title, 15, colour, 700)]
    for number, (where, what) in enumerate(route, 1):
        line = y + 4 + 26 * number
        parts += [
            mark(x + RADIUS, line - 4, number, colour),
            text(x + 28, line, where, 13, INK, 700),
            text(x + 112, line, what, 13),
        ]
    return parts


def draw() -> str:
    """The picture as SVG, on paper of its own: the same on a light and on a dark page."""
    parts = [
        f'<rect x="0.5" y="0.5" width="{WIDTH - 1}" height="{HEIGHT - 1}" rx="8" '
        f'fill="{PAPER}" stroke="#d0d7de"/>'
    ]
    parts.append(
        text(LEFT, 36, "Rooms of wasp_cli: each imports only what stands below it", 15, INK, 700)
    )
    for number, layer in enumerate(LAYERS):
        width = (ROOMS - GAP * (len(layer) - 1)) / len(layer)
        for place, (name, holds) in enumerate(layer):
            parts += room(
                LEFT + place * (width + GAP), TOP + number * (ROW + GAP), width, name, holds
            )
    x = LEFT + ROOMS + 40
    parts += steps(x, 76, "From a spec to a table", ONE, SPEC_TO_TABLE)
    parts += steps(x, 286, "From an observation to an action", TWO, DECISION)
    for line, (fill, edge, words) in enumerate(
        (
            (FREE, FREE_EDGE, "in no key: a change re-runs nothing"),
            (KEY, KEY_EDGE, "may be in a key: a change re-runs what imports it"),
        )
    ):
        y = 502 + 24 * line
        parts.append(
            f'<rect x="{x}" y="{y}" width="18" height="14" rx="3" fill="{fill}" stroke="{edge}"/>'
        )
        parts.append(text(x + 28, y + 12, words, 12))
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" '
        f'width="{WIDTH}" height="{HEIGHT}" '
    )
    head += (
        "font-family=\"-apple-system, 'Segoe UI', 'DejaVu Sans', Helvetica, Arial, sans-serif\">"
    )
    return (
        "\n".join(
            [
                head,
                "<title>The rooms of wasp_cli and the ways through them</title>",
                *parts,
                "</svg>",
            ]
        )
        + "\n"
    )


if __name__ == "__main__":
    Path(__file__).with_suffix(".svg").write_text(draw(), encoding="utf-8")
