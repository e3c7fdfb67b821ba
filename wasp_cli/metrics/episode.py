"""From the steps of one episode to its row, and from rows to the numbers of a cell.

Dimension letters: T decision steps of an episode, A actions, E episodes. A decision step is
`action_repeat` env steps under one action; every rate counts decision steps, and an episode that
ran into its time limit counts like any other.

Definitions, which are the paper's (section 5.2) where it is unambiguous:

    return                    sum of env rewards
    success                   at least `success_goals` goals within the time limit
    safe_success              success, and cost per 1000 env steps <= `safe_cost`
    cost                      sum over env steps of the 0/1 cost
    viol                      decision steps with cost / decision steps
    viol_env                  env steps with cost / env steps
    violated                  any cost at all
    int_rate                  share of decision steps with ||a - a_h|| > 1e-6
    int_rate_05, int_rate_10  share of decision steps with ||a - a_h|| > 0.05, > 0.10
    mag                       mean ||a - a_h|| over all decision steps
    mag_int                   mean ||a - a_h|| over the intervened ones: mag = int_rate x mag_int
    int_eff                   share of decision steps at which the action changes a force:
                              ||f(a) - f(a_h)|| > 1e-6, where f is the force of an action as shares
                              of each motor's largest (`tasks.motors`)
    mag_eff                   mean ||f(a) - f(a_h)|| over all decision steps
    jump                      mean ||a_t - a_{t-1}|| over the handovers, the decision steps at which
                              an intervention begins or ends
    smoothness                mean ||a_t - a_{t-1}||^2
    safety_gate, task_gate    share of decision steps at which that gate called for the planner
    case2                     share of Case II among the planner's iterations, mean over the steps
                              that planned
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

# Norm above which an action differs from the command: the paper's `||a - a_h|| > 0`, safe against
# rounding. A smaller norm counts as exactly 0 everywhere.
INTERVENED = 1e-6

# Values of `Trajectory.gate`.
GATE_NONE = 0  # the command stands
GATE_SAFETY = 1  # WASP's safety gate
GATE_TASK = 2  # WASP's task gate
GATE_METHOD = 3  # the rule of another method
GATE_LATE = 4  # a person's assistant was late: no gate was asked, and the command stands

CUT_OFF = -2
"""In `Plans.safe`: an iteration that was left out, since the time of the decision was up. The
iterations that were made come after it.
"""


@dataclass(frozen=True, eq=False)
class Plans:
    """The plans of T decision steps, L residual steps each, made in I iterations; NaN where nothing
    was planned.
    """

    residuals: Floats  # [T, L, A] the chosen sequence
    safe: Ints  # [T, I] |F_s| of every iteration (Eq. 14); below 0 where nothing was searched
    case2: Bools  # [T, I] whether the iteration was in Case II
    cost: Floats  # [T] predicted cost return of the sequence
    reward: Floats  # [T] its predicted reward return
    alone_cost: Floats  # [T] predicted cost return of the commands alone, on the same rollouts
    alone_reward: Floats  # [T] their predicted reward return

    def share(self) -> Floats:
        """Return the share [T] of the iterations that were in Case II; NaN where nothing was
        searched.
        """
        iterations = (self.safe != CUT_OFF).sum(1)  # that were made
        return np.where(self.safe[:, -1] >= 0, self.case2.sum(1) / iterations, np.nan)


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
        """Raise a ValueError where shapes do not fit, or rewards or actions are not finite."""
        steps = len(self.reward)
        if steps == 0:
            raise ValueError("an episode has at least one step")
        for field in fields(self):
            if field.name == "plans":
                continue
            shape = np.shape(getattr(self, field.name))
            expected: tuple[int, ...] = (steps,)
            if field.name in ("a", "a_h"):
                expected = (steps, *np.shape(self.a)[1:])
            if shape != expected:
                raise ValueError(f"{field.name} has shape {shape}, not {expected}")
        if self.plans is not None:
            _check_plans(self.plans, steps, np.shape(self.a)[1])
        for name in ("reward", "a", "a_h"):
            if not np.isfinite(getattr(self, name)).all():
                raise ValueError(f"{name} is not finite")

    @property
    def steps(self) -> int:
        """T, the number of decision steps."""
        return len(self.reward)

    @property
    def deviation(self) -> Floats:
        """||a - a_h|| of every step [T], exactly 0 where it is rounding."""
        difference = np.asarray(self.a, np.float64) - np.asarray(self.a_h, np.float64)
        norm: Floats = np.linalg.norm(difference, axis=1)
        return np.where(norm > INTERVENED, norm, 0.0)

    def effect(self, force: Force) -> Floats:
        """Return ||f(a) - f(a_h)|| of every step [T], where f is `force`; exactly 0 where it is
        rounding, and where `deviation` is 0.
        """
        executed = force(np.asarray(self.a, np.float64))
        commanded = force(np.asarray(self.a_h, np.float64))
        norm = np.linalg.norm(executed - commanded, axis=1)
        # Motors that saturate early enlarge the rounding of an action.
        return np.where((norm > INTERVENED) & (self.deviation > 0.0), norm, 0.0)


def _check_plans(plans: Plans, steps: int, actions: int) -> None:
    """Raise a ValueError where a field of plans in T steps has another shape than it should."""
    iterations = np.shape(plans.safe)[1:]
    for field in fields(plans):
        shape = np.shape(getattr(plans, field.name))
        expected: tuple[int, ...] = (steps,)
        if field.name == "residuals":
            expected = (steps, *shape[1:2], actions)
        elif field.name in ("safe", "case2"):
            expected = (steps, *iterations)
        if shape != expected:
            raise ValueError(f"plans.{field.name} has shape {shape}, not {expected}")


@dataclass(frozen=True)
class EpisodeMetrics:
    """The row of one episode: weights, and the measures that the module defines. None is
    undefined, never 0.
    """

    decisions: int  # decision steps T
    env_steps: int
    intervened: int  # decision steps with an intervention
    planned: int  # decision steps at which `case2` is defined
    handovers: int  # decision steps after the first at which an intervention begins or ends
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
    # The task.
    steps = trajectory.steps
    env_steps = int(trajectory.env_steps.sum())
    cost = int(trajectory.cost_env.sum())
    goals = int(trajectory.goals.sum())
    success = goals >= success_goals

    # What was intervened.
    deviation = trajectory.deviation
    intervened = deviation > 0.0
    effect = deviation if force is None else trajectory.effect(force)
    handover = intervened[1:] != intervened[:-1]
    squared_jumps = np.square(np.diff(np.asarray(trajectory.a, np.float64), axis=0)).sum(1)

    # What was planned.
    share = np.full(steps, np.nan)
    if trajectory.plans is not None:
        share = trajectory.plans.share()
    planned = ~np.isnan(share)

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
        jump=float(np.sqrt(squared_jumps[handover]).mean()) if handover.any() else None,
        smoothness=float(squared_jumps.mean()) if steps > 1 else None,
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
"""How a column pools over episodes: the column that weighs it, so that rates are ratios of sums.
None: every episode weighs the same.
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
    if groups is None:
        groups = np.zeros(rows, np.intp)
    cells = int(groups.max()) + 1 if rows else 0
    pooled: dict[str, Floats] = {}
    for name, weight_name in WEIGHTS.items():
        value = np.asarray(columns[name], np.float64)
        weight = np.ones(rows)
        if weight_name is not None:
            weight = np.asarray(columns[weight_name], np.float64)
        if name == "smoothness":
            weight = weight - 1.0  # T steps have T - 1 differences
        weight = np.where(np.isnan(value), 0.0, weight)
        total = np.bincount(groups, weight * np.nan_to_num(value), cells)
        mass = np.bincount(groups, weight, cells)
        pooled[name] = np.divide(total, mass, out=np.full(cells, np.nan), where=mass > 0)
    return pooled
