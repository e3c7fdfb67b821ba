"""The columns of the two tables of a cell, and what former versions of the tables have instead.

`tables` reads and writes them. Undefined numbers are null. Everything but the TIMING columns is a
function of the cell's key.
"""

from __future__ import annotations

from dataclasses import dataclass

import pyarrow as pa

# names of the tables inside the artifact of a cell
EPISODES_FILE = "episodes.parquet"
STEPS_FILE = "_steps.pq"

# grows with every change of SCHEMA or STEPS_SCHEMA; a file of a newer version is refused
VERSION = 5

# where the version is in the metadata of a file of episodes, and of steps
VERSION_KEY = b"wasp.cell"
STEPS_KEY = b"wasp.steps"
OLDEST = 3  # the first version that is read: rows and steps in files of their own


def _required(kind: pa.DataType, *names: str) -> list[pa.Field]:
    """Columns that are never null."""
    return [pa.field(name, kind, nullable=False) for name in names]


def _optional(kind: pa.DataType, *names: str) -> list[pa.Field]:
    """Columns that are null where a number is undefined."""
    return [pa.field(name, kind) for name in names]


STEP = pa.struct(
    [
        *_required(pa.int32(), "t"),
        *_required(pa.float32(), "reward"),
        *_required(pa.bool_(), "cost"),
        *_required(pa.int16(), "cost_env", "env_steps", "goals"),
        *_required(pa.list_(pa.float32()), "a_h", "a"),
        *_required(pa.float32(), "deviation"),
        *_required(pa.int8(), "gate"),
        *_optional(pa.float32(), "g_cost", "g_return", "delta_g", "signal"),
        *_optional(pa.float32(), "plan_cost", "plan_return", "alone_cost", "alone_return"),
        pa.field("safe", pa.list_(pa.int16())),
        pa.field("case2", pa.list_(pa.bool_())),
        pa.field("plan", pa.list_(pa.float32())),
    ]
)
"""A decision step; the meaning of the fields is that of `metrics.episode.Trajectory` and `Plans`.
`safe` and `case2` have an entry per iteration searched, `plan` the L residuals one after the other;
each is null where there was no search, or no plan."""
PLANNED = {
    "plan_cost": "cost",
    "plan_return": "reward",
    "alone_cost": "alone_cost",
    "alone_return": "alone_reward",
    "safe": "safe",
    "case2": "case2",
    "plan": "residuals",
}
"""Fields of STEP that come from `Plans`, with their names there."""

# which cell and which episode a row belongs to
IDENTITY = (
    *_required(pa.string(), "task", "method", "variant", "operator"),
    pa.field("value", pa.float64()),
    pa.field("seed", pa.int64(), nullable=False),
    pa.field("episode", pa.int32(), nullable=False),
    pa.field("episode_seed", pa.int64(), nullable=False),
)
# measures of an episode, by the names of `metrics.episode.EpisodeMetrics`
METRICS = (
    *_required(pa.int32(), "decisions", "env_steps", "intervened", "planned"),
    pa.field("handovers", pa.int32()),
    *_required(pa.float64(), "return"),
    *_required(pa.bool_(), "success", "safe_success"),
    *_required(pa.int32(), "goals", "cost"),
    *_required(pa.float64(), "viol", "viol_env"),
    *_required(pa.bool_(), "violated"),
    *_required(pa.float64(), "int_rate", "int_rate_05", "int_rate_10", "mag"),
    *_optional(pa.float64(), "mag_int", "int_eff", "mag_eff", "jump", "smoothness"),
    *_required(pa.float64(), "safety_gate", "task_gate"),
    pa.field("case2", pa.float64()),
)
# columns of METRICS that former versions do not have, and the first version that has them
ADDED = ("handovers", "int_eff", "mag_eff", "jump")
ADDED_IN = 4
# columns of IDENTITY with their former names, and the first version with today's names
RENAMED = {"operator": "variant", "variant": "assistant_variant"}
RENAMED_IN = 5
THRESHOLDS = tuple(_optional(pa.float64(), "tau_c", "tau_r", "tau_q"))
TIMES = tuple(_optional(pa.float32(), "decision_p50_ms", "decision_p95_ms"))
STEP_TIME = pa.field("decision_ms", pa.float32(), nullable=False)

# of the episodes
SCHEMA = pa.schema([*IDENTITY, *METRICS, *THRESHOLDS, *TIMES], {VERSION_KEY: str(VERSION).encode()})
STEPS_SCHEMA = pa.schema([*IDENTITY, *STEP, STEP_TIME], {STEPS_KEY: str(VERSION).encode()})

# columns that differ between two computations of one cell
TIMING = (*(field.name for field in TIMES), STEP_TIME.name)


@dataclass(frozen=True)
class CellIdentity:
    """What the rows of a cell have in common, named by what was computed (severity names belong
    to a spec).
    """

    task: str
    method: str
    variant: str  # of the method: `full`, or an ablation
    operator: str
    value: float | None  # severity value of the operator; None for the unimpaired one
    seed: int


@dataclass(frozen=True)
class Thresholds:
    """The thresholds of an assistant in a cell; None where the method has no such threshold."""

    tau_c: float | None = None
    tau_r: float | None = None
    tau_q: float | None = None


def lacking(version: int) -> tuple[str, ...]:
    """Return the columns of the episodes that a version does not have."""
    return ADDED if version < ADDED_IN else ()
