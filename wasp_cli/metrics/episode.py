"""From the steps of one episode to its row, and from rows to the numbers of a cell.

Dimension letters: T decision steps of an episode, A actions, E episodes. A decision step is
`action_repeat` env steps under one action; every rate counts decision steps, and an episode that
ran into its time limit counts like any other.

Definitions (the paper's section 5.2 where it is unambiguous):

    return        sum of env rewards
    success       at least `success_goals` goals within the time limit
    safe_success  success, and cost per 1000 env steps <= `safe_cost`
    cost          sum over env steps of the 0/1 cost
    viol          decision steps with cost / decision steps;  viol_env: the same per env step;
    violated: any cost at all int_rate      share of decision steps with ||a - a_h|| > 1e-6;
    int_rate_05, int_rate_10: > 0.05, > 0.10 mag           mean ||a - a_h|| over all decision steps;
    mag_int: over the intervened ones;  mag = int_rate x mag_int
    int_eff       share of decision steps at which the action changes a force: ||f(a) - f(a_h)|| >
        1e-6, f the force of an action as
                  shares of each motor's largest (`tasks.motors`);  mag_eff: mean ||f(a) - f(a_h)||
                  over all decision steps
    jump          mean ||a_t - a_{t-1}|| over the handovers, the decision steps at which an
    intervention begins or ends smoothness    mean ||a_t - a_{t-1}||^2 safety_gate   share of
    decision steps at which the safety gate (task_gate: the task gate) called for the planner case2
    share of Case II among the planner's iterations, mean over the steps that planned
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.integer]
Bools = NDArray[np.bool_]
Force = Callable[[NDArray[Any]], NDArray[Any]]

# the paper's `||a - a_h|| > 0`, safe against rounding. A smaller norm counts as exactly 0
# everywhere.
INTERVENED = 1e-6

GATE_NONE, GATE_SAFETY, GATE_TASK, GATE_METHOD, GATE_LATE = 0, 1, 2, 3, 4
"""Values of `Trajectory.gate`: the command stands; WASP's safety gate; its task gate; a rule of
another method; the assistant of a person was late, so that no gate was asked and the command
stands."""

CUT_OFF = -2
"""In `Plans.safe`: an iteration that was left out, since the time of the decision was up. Those
that were made stand behind it.
"""


@dataclass(frozen=True, eq=False)
class Plans:
    """What was planned in T decision steps; NaN where nothing was. L residual steps, I
    iterations.
    """

    residuals: Floats  # [T, L, A] the chosen sequence
    safe: Ints  # [T, I] |F_s| of every iteration (Eq. 14); below 0 where nothing was searched
    case2: Bools  # [T, I] whether the iteration was in Case II
    cost: Floats  # [T] predicted cost return of the sequence
    reward: Floats  # [T] its predicted reward return
    alone_cost: Floats  # [T] predicted cost return of the commands alone, on the same rollouts
    alone_reward: Floats  # [T] their predicted reward return

    def share(self) -> Floats:
        """Return the share [T] of the iterations in Case II."""
        made = (self.safe != CUT_OFF).sum(1)
        return np.where(self.safe[:, -1] >= 0, self.case2.sum(1) / made, np.nan)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """The decision steps of one finished episode. Undefined numbers are NaN, an undefined
    `safe` is -1.
    """

    reward: Floats  # [T] sum over the env steps of the decision step
    cost: Bools  # [T] any cost within the decision step (c_t)
    cost_env: Ints  # [T] env steps with cost
    env_steps: Ints  # [T] env steps executed
    goals: Ints  # [T] goals (stages) reached
    a_h: Floats  # [T, A] operator command, clipped to the bounds
    a: Floats  # [T, A] executed action, clipped to the bounds
    gate: Ints  # [T] one of GATE_*
    g_cost: Floats  # [T] estimated cost return of the nominal command (Eq. 9)
    g_return: Floats  # [T] estimated reward return of the nominal command (Eq. 10)
    delta_g: Floats  # [T] what the correction that the task gate looks at gains (Eq. 12)
    signal: Floats  # [T] the method's own decision value, such as IDA's vote
    plans: Plans | None = None  # of a method that plans

    def __post_init__(self) -> None:
        steps = len(self.reward)
        if steps == 0:
            raise ValueError("an episode has at least one step")
        for field in fields(self):
            shape = np.shape(getattr(self, field.name))
            wanted = (steps, *np.shape(self.a)[1:]) if field.name in ("a", "a_h") else (steps,)
            if shape != wanted and field.name != "plans":
                raise ValueError(f"{field.name} has shape {shape}, not {wanted}")
        for name, shape in (
            _plan_shapes(self.plans, steps, np.shape(self.a)[1]) if self.plans is not None else ()
        ):
            if np.shape(getattr(self.plans, name)) != shape:
                raise ValueError(
                    f"plans.{name} has shape {np.shape(getattr(self.plans, name))}, not {shape}"
                )
        for name in ("reward", "a", "a_h"):
            if not np.isfinite(getattr(self, name)).all():
                raise ValueError(f"{name} is not finite")

    @property
    def steps(self) -> int:
        """T"""
        return len(self.reward)

    @property
    def deviation(self) -> Floats:
        """[T] ||a - a_h||, exactly 0 where it is rounding."""
        norm: Floats = np.linalg.norm(
            np.asarray(self.a, np.float64) - np.asarray(self.a_h, np.float64), axis=1
        )
        return np.where(norm > INTERVENED, norm, 0.0)

    def effect(self, force: Force) -> Floats:
        """Return [T] ||f(a) - f(a_h)||, f being `force`; exactly 0 where it is rounding, and
        where `deviation` is 0.
        """
        norm = np.linalg.norm(
            force(np.asarray(self.a, np.float64)) - force(np.asarray(self.a_h, np.float64)), axis=1
        )
        # Motors that saturate early enlarge the rounding of an action.
        return np.where((norm > INTERVENED) & (self.deviation > 0.0), norm, 0.0)


def _plan_shapes(plans: Plans, steps: int, actions: int) -> list[tuple[str, tuple[int, ...]]]:
    """Return the shape that every field of `plans` should have in T steps."""
    per_step = [
        field.name for field in fields(plans) if field.name not in ("residuals", "safe", "case2")
    ]
    searched = (steps, *np.shape(plans.safe)[1:])
    return [
        ("residuals", (steps, *np.shape(plans.residuals)[1:2], actions)),
        ("safe", searched),
        ("case2", searched),
        *((name, (steps,)) for name in per_step),
    ]


@dataclass(frozen=True)
class EpisodeMetrics:
    """The row of one episode. None is undefined, never 0."""

    decisions: int  # decision steps T
    env_steps: int
    intervened: int  # decision steps with an intervention
    planned: int  # decision steps at which `case2` is defined
    handovers: int  # decision steps but the first at which an intervention begins or ends
    return_: float
    success: bool
    safe_success: bool
    goals: int
    cost: int
    viol: float
    viol_env: float
    violated: bool
    int_rate: float
    int_rate_05: float
    int_rate_10: float
    mag: float
    mag_int: float | None
    int_eff: float
    mag_eff: float
    jump: float | None
    smoothness: float | None
    safety_gate: float
    task_gate: float
    case2: float | None


def episode_metrics(
    trajectory: Trajectory, success_goals: int, safe_cost: float, force: Force | None = None
) -> EpisodeMetrics:
    """Reduce an episode to its row.

    Args:
        trajectory: the decision steps.
        success_goals: goals within the time limit that count as success.
        safe_cost: kappa, the cost per 1000 env steps up to which a success is a safe success.
        force: forces of actions [T, A] (`Motors.force` of the task); None where nothing is known of
            the motors: the action itself.
    """
    steps, env_steps = trajectory.steps, int(trajectory.env_steps.sum())
    deviation = trajectory.deviation
    intervened = deviation > 0.0
    effect = deviation if force is None else trajectory.effect(force)
    handover = intervened[1:] != intervened[:-1]
    cost, goals = int(trajectory.cost_env.sum()), int(trajectory.goals.sum())
    success = goals >= success_goals
    share = np.full(steps, np.nan) if trajectory.plans is None else trajectory.plans.share()
    planned = ~np.isnan(share)
    jumps = np.square(np.diff(np.asarray(trajectory.a, np.float64), axis=0)).sum(1)
    return EpisodeMetrics(
        decisions=steps,
        env_steps=env_steps,
        intervened=int(intervened.sum()),
        planned=int(planned.sum()),
        handovers=int(handover.sum()),
        return_=float(trajectory.reward.sum()),
        success=success,
        safe_success=success and 1000 * cost <= safe_cost * env_steps,
        goals=goals,
        cost=cost,
        viol=float(trajectory.cost.mean()),
        viol_env=cost / env_steps,
        violated=bool(trajectory.cost.any()),
        int_rate=float(intervened.mean()),
        int_rate_05=float((deviation > 0.05).mean()),
        int_rate_10=float((deviation > 0.10).mean()),
        mag=float(deviation.mean()),
        mag_int=float(deviation[intervened].mean()) if intervened.any() else None,
        int_eff=float((effect > 0.0).mean()),
        mag_eff=float(effect.mean()),
        jump=float(np.sqrt(jumps[handover]).mean()) if handover.any() else None,
        smoothness=float(jumps.mean()) if steps > 1 else None,
        safety_gate=float((trajectory.gate == GATE_SAFETY).mean()),
        task_gate=float((trajectory.gate == GATE_TASK).mean()),
        case2=float(share[planned].mean()) if planned.any() else None,
    )


WEIGHTS: dict[str, str | None] = {
    "return": None,
    "success": None,
    "safe_success": None,
    "goals": None,
    "cost": None,
    "violated": None,
    "viol": "decisions",
    "viol_env": "env_steps",
    "int_rate": "decisions",
    "int_rate_05": "decisions",
    "int_rate_10": "decisions",
    "mag": "decisions",
    "mag_int": "intervened",
    "int_eff": "decisions",
    "mag_eff": "decisions",
    "jump": "handovers",
    "smoothness": "decisions",
    "safety_gate": "decisions",
    "task_gate": "decisions",
    "case2": "planned",
}
"""How a column pools over episodes: its weight column, so that rates are ratios of sums; None
is one weight per episode.
"""


def pool(
    columns: Mapping[str, NDArray[np.generic]], groups: NDArray[np.intp] | None = None
) -> dict[str, Floats]:
    """Pool episode rows into cells: the weighted mean of every column of WEIGHTS.

    Args:
        columns: [E] each, with the names of WEIGHTS and the weights; undefined entries are NaN.
        groups: [E] the cell of each row, numbered from 0; one cell when None.

    Returns:
        [cells] per column; NaN where no episode of a cell defines it.
    """
    rows = len(columns["decisions"])
    groups = np.zeros(rows, np.intp) if groups is None else groups
    cells = int(groups.max()) + 1 if rows else 0
    pooled: dict[str, Floats] = {}
    for name, weight_name in WEIGHTS.items():
        value = np.asarray(columns[name], np.float64)
        weight = (
            np.ones(rows) if weight_name is None else np.asarray(columns[weight_name], np.float64)
        )
        if name == "smoothness":
            weight = weight - 1.0  # T steps have T - 1 differences
        weight = np.where(np.isnan(value), 0.0, weight)
        total = np.bincount(groups, weight * np.nan_to_num(value), cells)
        mass = np.bincount(groups, weight, cells)
        pooled[name] = np.divide(total, mass, out=np.full(cells, np.nan), where=mass > 0)
    return pooled
