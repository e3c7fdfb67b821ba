"""What the predictions of an assistant with a model were worth: its branched interventions, beside
what was predicted for them.

Every intervention whose plan is stored (`store.tables.STEP`) and that was branched (the stage
`counterfactual`) counts once. The task gate fires for return, and the safety gate against cost: so
return gained is computed over interventions that the safety gate did not cause, and cost saved over
those that the task gate did not cause. `metrics.gains` defines how predictions and branches are
compared.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from wasp_cli.cells.read import odd_tables_refused
from wasp_cli.cells.table import Floats
from wasp_cli.errors import ArtifactError, StoreError
from wasp_cli.metrics.episode import GATE_SAFETY, GATE_TASK
from wasp_cli.metrics.gains import (
    Flatness,
    GainBin,
    discounted,
    flatness,
    gain_bins,
    holds_from,
    mean_interval,
)
from wasp_cli.metrics.gains import Interval as Limits
from wasp_cli.metrics.necessity import ALONE, ASSISTED
from wasp_cli.plan.grid import COUNTERFACTUAL
from wasp_cli.report.stats import Frame, Group
from wasp_cli.report.summary import Interval
from wasp_cli.report.tables.comparison import judged_groups
from wasp_cli.store.artifact import read_manifest
from wasp_cli.store.branches import BRANCHES_FILE, Branches, read_branches
from wasp_cli.store.find import KIND
from wasp_cli.store.layout import Layout
from wasp_cli.store.parquet import opened_table
from wasp_cli.store.tables import STEPS_FILE, STEPS_KEY, VERSION, columns_of

PLANNED = ("plan_return", "alone_return", "plan_cost", "alone_cost")
COLUMNS = ("episode", "t", *PLANNED)


@dataclass(frozen=True)
class Quantity:
    """What a gate fires for, and the other gate, whose interventions do not count for it."""

    key: str
    title: str
    not_of: int


QUANTITIES = (
    Quantity("gain", "return gained", GATE_SAFETY),
    Quantity("saved", "cost saved", GATE_TASK),
)


@dataclass(frozen=True, eq=False)
class Foreseen:
    """N branched interventions with their predictions; returns and costs are discounted."""

    predicted: Mapping[str, Floats]  # [N] by key of QUANTITIES
    realised: Mapping[str, Floats]  # [N]
    gate: NDArray[np.int64]  # [N]
    world: Floats  # [N] seed of the world of the episode
    branched: int  # interventions that were branched, with a stored prediction or without

    @classmethod
    def joined(cls, cells: Sequence[Foreseen]) -> Foreseen:
        """Return the interventions of several cells as those of one."""

        def together(parts: Sequence[Mapping[str, Floats]]) -> dict[str, Floats]:
            return {
                each.key: np.concatenate([part[each.key] for part in parts]) for each in QUANTITIES
            }

        return cls(
            together([cell.predicted for cell in cells]),
            together([cell.realised for cell in cells]),
            np.concatenate([cell.gate for cell in cells]),
            np.concatenate([cell.world for cell in cells]),
            sum(cell.branched for cell in cells),
        )


@dataclass(frozen=True, eq=False)
class Foresight:
    """The branched interventions with predictions in a report."""

    cells: Mapping[str, Foreseen]  # by key of the cell
    unread: tuple[str, ...] = ()  # what is damaged, each as a sentence


@dataclass(frozen=True, eq=False)
class Trust:
    """What the predictions of one quantity were worth, of one row of a table."""

    group: Group
    quantity: Quantity
    predicted: float  # mean
    realised: float  # mean
    interval: Interval | None  # of the realised mean
    worlds: int
    size: int  # interventions
    bins: tuple[GainBin, ...]
    flat: Flatness
    holds: float | None  # the predicted gain from which on predictions hold

    def over_worlds(self, limits: Limits) -> Interval | None:
        """Return limits as an interval of a table; None where there are none."""
        if math.isnan(limits.low):
            return None
        return Interval(limits.low, limits.high, "world", self.worlds)


def foresight_of(layout: Layout, frame: Frame) -> Foresight:
    """Read the branched interventions of a report whose predictions are stored.

    Methods without a model have none. Published cells have only the steps of their first episodes,
    and so the predictions of these.

    Args:
        layout: of the results folder.
        frame: the cells, with their branches in `judged`.
    """
    cells: dict[str, Foreseen] = {}
    unread: list[str] = []
    for place, cell in enumerate(frame.cells):
        if cell.key not in frame.judged or cell.branches is None:
            continue
        worlds = frame.cells.worlds[frame.cells.rows_of(place)]
        try:
            interventions = _foreseen(layout, cell.key, cell.branches, worlds)
        except (ArtifactError, StoreError) as error:
            unread.append(error.message)
            continue
        if interventions is not None:
            cells[cell.key] = interventions
    return Foresight(cells, tuple(unread))


def _foreseen(layout: Layout, evaluation: str, branches: str, worlds: Floats) -> Foreseen | None:
    """The branched interventions of a cell; None where no plan is stored."""
    steps = _predictions(layout, evaluation)
    if steps is None:
        return None
    path = layout.within(layout.artifact(COUNTERFACTUAL, branches) / BRANCHES_FILE)
    with odd_tables_refused(path):
        stored = read_branches(path)
        returns = read_manifest(layout, KIND, evaluation)["settings"]["returns"]
        return _joined(steps, stored, returns, worlds)


def _predictions(layout: Layout, key: str) -> pa.Table | None:
    """The columns COLUMNS of the steps at which something was planned; None without any."""
    path: Path = layout.within(layout.artifact(KIND, key) / STEPS_FILE)
    if not path.is_file():
        return None
    with opened_table(path, STEPS_KEY, VERSION, "the steps of a cell") as file:
        version = int(file.schema_arrow.metadata[STEPS_KEY])
        table = columns_of(file, COLUMNS, version)
    if table.column_names != list(COLUMNS):
        return None
    planned = table.drop_null()
    return planned if len(planned) else None


def _joined(
    steps: pa.Table, stored: Branches, returns: Mapping[str, float], worlds: Floats
) -> Foreseen:
    """The branches at whose decisions `steps` have a prediction."""
    decisions = zip(steps["episode"].to_pylist(), steps["t"].to_pylist(), strict=True)
    place = {decision: row for row, decision in enumerate(decisions)}
    branched = zip(stored.episode.tolist(), stored.t.tolist(), strict=True)
    rows = np.array([place.get(decision, -1) for decision in branched], np.int64)
    here = np.flatnonzero(rows >= 0)
    numbers = {name: np.asarray(steps[name], np.float64)[rows[here]] for name in PLANNED}
    reward = stored.reward
    cost = stored.cost
    gained = discounted(reward[ASSISTED] - reward[ALONE], returns["gamma_r"])
    saved = discounted(cost[ALONE] - cost[ASSISTED], returns["gamma_c"])
    return Foreseen(
        {
            "gain": numbers["plan_return"] - numbers["alone_return"],
            "saved": numbers["alone_cost"] - numbers["plan_cost"],
        },
        {"gain": gained[here], "saved": saved[here]},
        stored.gate[here],
        worlds[stored.episode[here]],
        len(rows),
    )


def trusted_groups(frame: Frame, foresight: Foresight) -> Iterator[Trust]:
    """Yield what the predictions of every row with branches were worth: return gained, then cost
    saved. Rows without a stored prediction are left out.
    """
    for group in judged_groups(frame):
        keys = [cell.key for cell in group.cells]
        known = [foresight.cells[key] for key in keys if key in foresight.cells]
        if not known:
            continue
        cells = Foreseen.joined(known)
        for quantity in QUANTITIES:
            counted = cells.gate != quantity.not_of
            if counted.any():
                yield _trust(group, quantity, cells, counted)


def _trust(group: Group, quantity: Quantity, cells: Foreseen, counted: NDArray[np.bool_]) -> Trust:
    predicted = cells.predicted[quantity.key][counted]
    realised = cells.realised[quantity.key][counted]
    world = cells.world[counted]
    worlds = len(np.unique(world))
    limits = mean_interval(realised, world)
    return Trust(
        group,
        quantity,
        float(predicted.mean()),
        float(realised.mean()),
        None if math.isnan(limits.low) else Interval(*limits, "world", worlds),
        worlds,
        len(predicted),
        tuple(gain_bins(predicted, realised, world)),
        flatness(predicted, realised, world),
        holds_from(predicted, realised, world),
    )
