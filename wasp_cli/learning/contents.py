"""What a dataset holds: per behaviour and in all, as numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from wasp_cli.learning.shards import Recording, cost_sources, read_shards

COLUMNS = (
    "reward",
    "cost",
    "cost_env",
    "sources",
    "goals",
    "terminal",
    "first",
    "episode",
    "behaviour",
)
"""The columns that the table is made from."""
ALL = "all"

Contents = Mapping[str, Mapping[str, Any]]


def contents(recording: Recording, sources: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Describe a recording per behaviour and in all (`all`).

    Keys of a row: `episodes`, `steps` (decision steps), `share` of the episodes, and per episode
    `return_per_episode`, `goals_per_episode`, `cost_per_episode` (env steps that cost); `with_goal`
    and `terminal` are shares of the episodes that reached a goal and that ended by the task's own
    rule; `costly_share` and `sources` are shares of the decision steps with any cost and with each
    cost source.
    """
    table = {}
    for name in [ALL, *sorted(set(recording.behaviour.tolist()))]:
        rows = recording if name == ALL else recording.rows(recording.behaviour == name)
        episodes = int(rows.first.sum())
        steps = len(rows.first) - episodes
        table[name] = {
            "episodes": episodes,
            "steps": steps,
            "share": episodes / float(recording.first.sum()),
            "return_per_episode": float(rows.reward.sum()) / episodes,
            "goals_per_episode": float(rows.goals.sum()) / episodes,
            "cost_per_episode": float(rows.cost_env.sum()) / episodes,
            "with_goal": len(set(rows.episode[rows.goals > 0].tolist())) / episodes,
            "terminal": float(rows.terminal.sum()) / episodes,
            "costly_share": float(rows.cost.sum()) / max(1, steps),
            "sources": {
                kind: int((rows.sources[:, i] > 0).sum()) / max(1, steps)
                for i, kind in enumerate(sources)
            },
        }
    return table


def contents_of(folder: Path) -> dict[str, dict[str, Any]]:
    """Summarise the contents of a dataset artifact, without reading its images."""
    return contents(read_shards(folder, COLUMNS), cost_sources(folder))


def unseen_sources(table: Contents) -> list[str]:
    """Name the cost sources that never cost."""
    return [kind for kind, share in table[ALL]["sources"].items() if share == 0.0]


def most_costly(table: Contents) -> str | None:
    """Name the behaviour with the most costly decisions; None where nothing cost."""
    costly = {
        name: row["costly_share"] * row["steps"] for name, row in table.items() if name != ALL
    }
    most = max(costly, key=costly.__getitem__, default=None)
    return most if most is not None and costly[most] > 0 else None
