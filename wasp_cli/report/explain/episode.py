"""A stored episode, with what the manifest says of its method.

Letters: T decisions of the episode, A actions, L residual steps, I iterations of the planner.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wasp_cli.cells.read import odd_tables_refused
from wasp_cli.cells.table import Floats
from wasp_cli.errors import StoreError, UsageError
from wasp_cli.methods.registry import METHODS, Signal
from wasp_cli.metrics.episode import (
    GATE_LATE,
    GATE_METHOD,
    GATE_NONE,
    GATE_SAFETY,
    GATE_TASK,
    INTERVENED,
)
from wasp_cli.plan.node import cell_label
from wasp_cli.store.find import FoundCell
from wasp_cli.store.plain import printable
from wasp_cli.store.slim import without_steps
from wasp_cli.store.tables import Thresholds, read_episodes, read_steps, read_times
from wasp_cli.tasks.registry import TASKS

Bools = NDArray[np.bool_]

GATES = {
    GATE_NONE: "none",
    GATE_SAFETY: "safety",
    GATE_TASK: "task",
    GATE_METHOD: "method",
    GATE_LATE: "late",
}
"""The gate that called for a correction. `method` is the rule of a method without WASP's gates;
`late` is an assistant that had not answered.
"""

NUMBERS = ("reward", "cost_env", "goals", "deviation", "g_cost", "g_return", "delta_g", "signal")
THRESHOLDS = ("tau_c", "tau_r", "tau_q")
PREDICTED = ("plan_cost", "plan_return", "alone_cost", "alone_return")


@dataclass(frozen=True)
class Constants:
    """Constants of the method, from the manifest; None if there is no manifest, or the method has
    no such constant.
    """

    horizon: int | None = None  # H
    residual_steps: int | None = None  # L
    candidates: int | None = None  # N of the first iteration
    probe: int | None = None  # N_probe: random corrections that the task gate judges
    feasible: int | None = None  # N_f
    takeover: bool = False
    """whether the gates look at one correction, the expert's action now, and imagine the
    expert, not the operator, behind every command
    """
    bootstrap_cost: bool | None = None  # whether V_c stands for what lies behind H in costs (Eq. 7)
    gamma_c: float | None = None
    # share of IDA's ensemble, from -1 to 1, above which it takes over; a safety gate then looks at
    # its action
    vote: float | None = None
    action_repeat: int | None = None  # env steps of a decision
    # simulated time of a decision; None of a task that is not ours
    decision_seconds: float | None = None


@dataclass(frozen=True, eq=False)
class Episode:
    """A stored episode of T decisions."""

    cell: FoundCell
    row: Mapping[str, Any]  # the episode columns of `store.tables`
    episodes: int  # in the cell
    gate: NDArray[np.int64]  # [T]
    costly: Bools  # [T] any cost within the decision
    a_h: Floats  # [T, A]
    a: Floats  # [T, A]
    numbers: Mapping[str, Floats]  # NUMBERS and PREDICTED, [T] each; NaN is undefined
    # T times: I counts |F_s|, or None where nothing was searched
    safe: tuple[tuple[int, ...] | None, ...]
    case2: tuple[tuple[bool, ...] | None, ...]  # T times: I
    # T times: L residuals of A numbers, one after the other
    plan: tuple[tuple[float, ...] | None, ...]
    # [T] decision time, as stored: divided by the episodes that were decided side by side
    ms: Floats
    constants: Constants

    @property
    def decisions(self) -> int:
        """How many decisions it has: T."""
        return len(self.gate)

    @property
    def method(self) -> str:
        """The name of its method."""
        return str(self.row["method"])

    @property
    def side_by_side(self) -> int:
        """Episodes that shared the time of this one's decisions; 1 where the manifest does not
        say how many.
        """
        stated = self.cell.setting("settings", "side_by_side")
        size = stated if isinstance(stated, int) and stated > 0 else 1
        return min(size, self.episodes - int(self.row["episode"]) // size * size)

    @property
    def variant(self) -> str:
        """The ablation of the method; `full` for the method itself."""
        return str(self.row["variant"])

    @property
    def label(self) -> str:
        """The label of its cell."""
        row = self.row
        who = cell_label(self.method, self.variant, row["operator"], row["value"])
        return printable(self.cell.label or f"{row['task']} s{row['seed']} {who}")

    @property
    def title(self) -> str:
        """The label of its cell, and its number."""
        return f"{self.label}, episode {self.row['episode']}"

    def require(self, t: int) -> None:
        """Refuse a decision that it does not have. Raises UsageError."""
        if not 0 <= t < self.decisions:
            raise UsageError(
                f"there is no decision {t}",
                f"episode {self.row['episode']} has the decisions 0 to {self.decisions - 1}",
            )

    @property
    def thresholds(self) -> Thresholds:
        """The thresholds that it was decided with."""
        return Thresholds(*(number(self.row[name]) for name in THRESHOLDS))

    @property
    def asks_task(self) -> bool:
        """Whether there is a task gate: the ablation `safety-only` has none, nor has a safety gate
        that guards another method.
        """
        return self.variant != "safety-only" and (
            not self.constants.takeover or self.thresholds.tau_r is not None
        )

    @property
    def signal(self) -> Signal:
        """The signal by which its method decides; an empty one if the method is not known here."""
        return METHODS[self.method].signal if self.method in METHODS else Signal()

    @property
    def signal_limit(self) -> float | None:
        """The threshold of that signal; None where it has none."""
        limit = self.signal.limit
        if limit in THRESHOLDS:
            return number(self.row[limit])
        stated = self.cell.setting("axes", "method_config", limit) if limit else None
        if isinstance(stated, (int, float)) and not isinstance(stated, bool):
            return float(stated)
        return None

    def at(self, name: str, t: int) -> float | None:
        """Return a number of decision t; None where it is undefined."""
        return number(float(self.numbers[name][t]))

    @property
    def gated(self) -> bool:
        """Whether its method has WASP's gates, or one of them."""
        fired = np.isin(self.gate, (GATE_SAFETY, GATE_TASK)).any()
        # others may bound a cost too
        return bool(
            fired or np.isfinite(self.numbers["g_cost"]).any() or self.thresholds.tau_r is not None
        )

    @property
    def selective(self) -> bool:
        """Whether the method decides when to intervene, so that it can miss a cost. Human-only
        never intervenes, and a blend always does.
        """
        return bool(
            self.gated
            or np.isfinite(self.numbers["signal"]).any()
            or len({*self.gate.tolist()} - {GATE_LATE}) > 1
        )

    @property
    def intervened(self) -> Bools:
        """[T] whether the action differed from the command."""
        deviated: Bools = self.numbers["deviation"] > INTERVENED
        return deviated

    @property
    def missed(self) -> Bools:
        """[T] whether a decision cost and no gate had fired, if the method decides when to
        intervene.
        """
        missed: Bools = self.costly & (self.gate == GATE_NONE) & self.selective
        return missed

    @property
    def late(self) -> Bools:
        """[T] whether a decision cost and the assistant had not answered in time."""
        late: Bools = self.costly & (self.gate == GATE_LATE)
        return late


def read_episode(cell: FoundCell, episode: int) -> Episode:
    """Read one episode of a cell.

    Raises:
        UsageError: the cell has no episode of this number, or its steps are not published.
        StoreError: its tables cannot be read.
    """
    with odd_tables_refused(cell.path):
        return _read(cell, episode)


def _read(cell: FoundCell, episode: int) -> Episode:
    # Its row among the episodes of the cell.
    rows = read_episodes([cell.path])
    numbers = rows["episode"].to_pylist()
    if not numbers:
        raise StoreError(f"{cell.path} has no episodes")
    if episode not in numbers:
        raise UsageError(
            f"there is no episode {episode}",
            f"this cell has the episodes {min(numbers)} to {max(numbers)}",
        )
    place = numbers.index(episode)

    # Its steps, which published cells may lack.
    flat = read_steps(cell.path)
    mine = flat.filter(np.asarray(flat["episode"]) == episode)
    if not mine.num_rows and (flat.num_rows or without_steps(cell.manifest)):
        kept = flat["episode"].unique().to_pylist()
        here = "no episode of this cell has its steps"
        if kept:
            here = f"{len(kept)} episodes of this cell have their steps, from {min(kept)} on"
        raise UsageError(
            f"the steps of episode {episode} are not here",
            f"{here}; published cells may leave out steps. wasp run SPEC --reuse none computes "
            "the cell again, for which it trains again",
        )
    a_h = np.asarray(mine["a_h"].to_pylist(), np.float64).reshape(mine.num_rows, -1)
    a = np.asarray(mine["a"].to_pylist(), np.float64).reshape(mine.num_rows, -1)
    if not a.size or a.shape != a_h.shape:
        raise ValueError("its commands and actions are empty, or of different sizes")
    row = {
        name: printable(value) if isinstance(value, str) else value
        for name, value in rows.slice(place, 1).to_pylist()[0].items()
    }
    return Episode(
        cell=cell,
        row=row,
        episodes=len(numbers),
        # A gate that this version does not know can only be the rule of some method.
        gate=np.array(
            [gate if gate in GATES else GATE_METHOD for gate in mine["gate"].to_pylist()], np.int64
        ),
        costly=np.asarray(mine["cost"].to_pylist(), bool),
        a_h=a_h,
        a=a,
        numbers={name: _floats(mine[name].to_pylist()) for name in NUMBERS + PREDICTED},
        safe=_lists(mine["safe"].to_pylist()),
        case2=_lists(mine["case2"].to_pylist()),
        plan=_lists(mine["plan"].to_pylist()),
        ms=read_times(cell.path)[place],
        constants=_constants(cell, row),
    )


def _floats(values: list[float | None]) -> Floats:
    numbers = np.array(values, np.float64)
    return np.where(np.isfinite(numbers), numbers, np.nan)


def _lists(values: list[list[Any] | None]) -> tuple[tuple[Any, ...] | None, ...]:
    return tuple(
        None if not value or any(part is None or part != part for part in value) else tuple(value)
        for value in values
    )


def _constants(cell: FoundCell, row: Mapping[str, Any]) -> Constants:
    """The constants of a cell. A manifest may be of another version: a value of another type counts
    as unknown.
    """

    def of(name: str, kind: type) -> Any:
        value = cell.setting("axes", "method_config", name)
        return value if type(value) is kind else None

    counts = {
        name: of(name, int)
        for name in ("horizon", "residual_steps", "candidates", "probe", "feasible")
    }
    takeover = imagines_expert(cell)
    printed = row["method"] == "printed"
    if takeover:
        bootstrap = False
    elif printed:
        bootstrap = True
    else:
        bootstrap = of("bootstrap_cost", bool)
    # one imagined step and both critics, whatever H is
    if row["variant"] == "no-rollout" and counts["horizon"] is not None:
        counts["horizon"] = counts["residual_steps"] = 1
        bootstrap = True
    gamma_c = cell.setting("settings", "returns", "gamma_c")
    repeat = cell.setting("settings", "action_repeat")
    repeat = repeat if isinstance(repeat, int) else None
    seconds = TASKS[row["task"]].env_seconds if row["task"] in TASKS else None
    return Constants(
        **counts,
        takeover=takeover,
        bootstrap_cost=bootstrap,
        gamma_c=gamma_c if isinstance(gamma_c, float) else None,
        vote=of("vote", float),
        action_repeat=repeat,
        decision_seconds=None if seconds is None or repeat is None else seconds * repeat,
    )


def imagines_expert(cell: FoundCell) -> bool:
    """Return whether the method of a cell imagines that the expert, not the operator, goes on after
    a command; its settings say so.
    """
    config = cell.setting("axes", "method_config")
    return isinstance(config, dict) and type(config.get("search_rollouts")) is int


def number(value: float | None) -> float | None:
    """Return a finite number, and None for anything else."""
    return None if value is None or not math.isfinite(value) else float(value)
