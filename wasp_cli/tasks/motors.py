"""What an action does to a robot: motors saturate, and beyond their limit different commands give
the same force.

A motor of the cars turns a command u of [-1, 1] into the torque clip(u, -.02, .02) N m, one motor
for each wheel (`tasks.car`). That of the point robot's throttle turns it into the force clip(u,
-.05, .05) N (`tasks.goal.model`). Its turning is a velocity servo, whose torque depends on how fast
it turns already: there, different commands always differ. A = action size.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from torch import Tensor

# A command that saturates is this much above the limit: rounding to single precision must not make
# it weaker
BEYOND = 1 + 1e-6


class Motors(NamedTuple):
    """The motors of a robot, one for each component of an action."""

    saturation: tuple[float, ...] | None = None
    """[A] absolute command from which on the force does not grow; 1 where it always does. None:
    nothing is known of the motors.
    """

    def force(self, action: NDArray[Any]) -> NDArray[Any]:
        """Return the force of actions [..., A] as shares of each motor's largest, within [-1, 1];
        the action itself where nothing is known of the motors.
        """
        if self.saturation is None:
            return action
        limit = np.array(self.saturation)
        forced: NDArray[Any] = np.clip(action, -limit, limit) / limit
        return forced

    def least(self, command: Tensor, wanted: Tensor) -> Tensor:
        """Return of all actions with the force of `wanted` [..., A] the one closest to
        `command` [..., A], both within [-1, 1].
        """
        if self.saturation is None:
            return wanted
        limit = wanted.new_tensor(self.saturation)
        full = (limit * BEYOND).clamp(max=1.0)
        forward = wanted >= limit
        backward = wanted <= -limit
        low = full.where(forward, (-full / full).where(backward, wanted))
        high = (full / full).where(forward, (-full).where(backward, wanted))
        return command.clamp(low, high)


UNKNOWN = Motors()
