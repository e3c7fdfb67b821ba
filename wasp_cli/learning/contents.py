"""The contents of a dataset as numbers, per behaviour and in all."""

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
"""The columns of a recording that are read."""
ALL = "all"  # the row of all behaviours

Contents = Mapping[str, Mapping[str, Any]]
"""By behaviour, the numbers of `contents`."""


def contents(recording: Recording, sources: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return the contents of a recording, a row per behaviour and one of all.

    Args:
        recording: the columns of `COLUMNS`.
        sources: names of the cost sources.

    Returns:
        Rows with `episodes`, `steps` (decision steps), `share` of the episodes;
        `return_per_episode`, `goals_per_episode`, `cost_per_episode` (env steps that cost);
        `with_goal` and `terminal`, the shares of the episodes that reached a goal and that ended by
        the task's own rule; `costly_share` and `sources`, the shares of the decision steps with any
        cost and with each cost source.
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
    """Return the contents of a dataset artifact. Its images are not read."""
    return contents(read_shards(folder, COLUMNS), cost_sources(folder))


def unseen_sources(table: Contents) -> list[str]:
    """Return the names of the cost sources that never cost."""
    return [kind for kind, share in table[ALL]["sources"].items() if share == 0.0]


def most_costly(table: Contents) -> str | None:
    """Return the name of the behaviour with the most costly decisions; None where nothing cost."""
    costly = {
        name: row["costly_share"] * row["steps"] for name, row in table.items() if name != ALL
    }
    if not costly:
        return None
    most = max(costly, key=costly.__getitem__)
    return most if costly[most] > 0 else None
