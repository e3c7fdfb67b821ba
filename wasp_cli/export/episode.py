"""An episode between the store and the formats of others."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wasp_cli.metrics.episode import INTERVENED

Array = NDArray[Any]

PIXELS = "pixels"
STATE = "state"


@dataclass(frozen=True)
class Origin:
    """The node that an episode comes from, and who drove."""

    kind: str  # `dataset`, or `evaluate` of a cell
    key: str
    label: str  # as `wasp run` prints it
    task: str
    seed: int  # of the label
    driver: str  # the operator of a cell; the behaviour of an episode of a dataset
    value: float | None = None  # severity of the operator, or the number of a participant
    method: str | None = None  # None: nobody corrects the commands
    variant: str | None = None


@dataclass(frozen=True, eq=False)
class Episode:
    """T decisions, in their order. A = numbers of an action, P = of the privileged vector."""

    origin: Origin
    number: int  # in its cell or dataset
    world_seed: int  # with which its task is reset
    seen: Array | None
    """What assistants see before each decision and after the last one: uint8 [T + 1, 6, 64, 64], or
    float32 [T + 1, S] of a task without images. None: left out.
    """
    privileged: Array | None  # float32 [T + 1, P] what experts may know; None: left out
    command: Array  # float32 [T, A] the operator's
    action: Array  # float32 [T, A] what was executed
    reward: Array  # float32 [T]
    cost: Array  # bool [T] any cost in the decision
    cost_env: Array  # int64 [T] env steps of it that cost
    goals: Array  # int64 [T] goals reached in it
    gate: Array  # int8 [T] of `metrics.episode.GATE_*`
    predicted_cost: Array  # float32 [T] of the command (Eq. 9); NaN where none is predicted
    predicted_gain: Array  # float32 [T] of the correction (Eq. 12); NaN likewise
    signal: Array  # float32 [T] what another method decides by; NaN likewise
    terminated: bool  # ended by the task's own rule, and not by the time limit
    success: bool | None = None  # None of an episode of a dataset

    @property
    def decisions(self) -> int:
        """T."""
        return len(self.action)

    @property
    def intervened(self) -> NDArray[np.bool_]:
        """Whether each executed action [T] is another one than the command."""
        difference = self.action.astype(np.float64) - self.command.astype(np.float64)
        changed: NDArray[np.bool_] = np.linalg.norm(difference, axis=1) > INTERVENED
        return changed

    @property
    def sees(self) -> str | None:
        """What `seen` holds: PIXELS, STATE, or None."""
        if self.seen is None:
            return None
        return PIXELS if self.seen.ndim == 4 else STATE

    def facts(self) -> dict[str, Any]:
        """Return what is known of the whole episode, by name; what is not known is None."""
        origin = self.origin
        return {
            "kind": origin.kind,
            "key": origin.key,
            "label": origin.label,
            "task": origin.task,
            "seed": origin.seed,
            "method": origin.method,
            "variant": origin.variant,
            "driver": origin.driver,
            "value": origin.value,
            "episode": self.number,
            "world_seed": self.world_seed,
            "return": float(self.reward.astype(np.float64).sum()),
            "cost": int(self.cost_env.sum()),
            "goals": int(self.goals.sum()),
            "interventions": int(self.intervened.sum()),
            "success": self.success,
        }
