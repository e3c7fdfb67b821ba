"""A batch of tasks as a stable-baselines3 vector environment, with the cost as a Lagrangian
penalty.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from wasp_cli.learning.reward_unit import GrowingUnit
from wasp_cli.seeds import derive
from wasp_cli.tasks.base import Observation, Step, VectorTask

Array = NDArray[np.float32]


class Curve:
    """Sums of finished episodes since the last `take`."""

    def __init__(self) -> None:
        self._clear()

    def _clear(self) -> None:
        self.returns: list[float] = []
        self.costs: list[float] = []
        self.env_steps = 0
        self.costly_env_steps = 0

    def take(self) -> dict[str, float]:
        """Return means of the finished episodes and the cost per 1000 env steps since the last
        call.
        """
        row = {
            "return": float(np.mean(self.returns)) if self.returns else float("nan"),
            "cost": float(np.mean(self.costs)) if self.costs else float("nan"),
            "cost_per_1000": 1000.0 * self.costly_env_steps / max(1, self.env_steps),
        }
        self._clear()
        return row


class TaskVecEnv(VecEnv):
    """B episodes that restart by themselves. `objective` computes the reward, `observe` the
    observation.

    Subclasses override `observe` and `execute` to put an operator and a filter between policy and
    task.
    """

    def __init__(
        self, task: VectorTask, size: int, low: float, high: float, next_seed: Callable[[], int]
    ) -> None:
        """Wrap a task.

        Args:
            task: B episodes.
            size: numbers of an observation.
            low: lower bound of an action's components.
            high: upper bound of an action's components.
            next_seed: returns the seed of the next episode.
        """
        # -- what the owner may set before training
        self.task = task
        self.multiplier = 0.0  # of the cost, in the reward that is learned from
        self.unit = 1.0  # of a reward, see `learning.reward_unit`
        self.growing: GrowingUnit | None = None  # where the unit follows the rewards of training
        self.normalise = False
        """Divide the reward by 1 + multiplier, so that its scale does not grow with the
        multiplier.
        """
        self.spread = False
        """Cut the first episode of row b after (b + 1) / B of the time limit, so that every
        rollout sees all parts of an episode.
        """

        # -- the running episodes
        self.curve = Curve()
        self._next_seed = next_seed
        self._return = np.zeros(task.batch)
        self._cost = np.zeros(task.batch)
        self._until_cut = np.full(task.batch, -1)  # decisions until a cut; below 0 there is none
        self._action: NDArray[Any] = np.zeros((task.batch, task.action_size), np.float32)
        observation_space = spaces.Box(-np.inf, np.inf, (size,), np.float32)
        action_space = spaces.Box(low, high, (task.action_size,), np.float32)
        super().__init__(task.batch, observation_space, action_space)

    # -- what a subclass changes -------------------------------------------------------------------

    def observe(self, seen: Observation, rows: NDArray[np.bool_], executed: Array) -> Array:
        """Return observations [B, size] after `executed` [B, A]; `rows` [B] have just started
        an episode.
        """
        assert seen.privileged is not None
        return seen.privileged

    def execute(self, action: Array) -> tuple[Array, Array]:
        """Return the executed action [B, A] and a penalty [B] for the policy's action."""
        return action, np.zeros(len(action), np.float32)

    def objective(self, step: Step, penalty: Array) -> NDArray[Any]:
        """Return the reward [B] that is learned from: r / unit - penalty - multiplier * c_t,
        divided by 1 + multiplier where `normalise` is set.
        """
        reward: NDArray[Any] = step.reward / self.unit - penalty - self.multiplier * step.cost
        if self.normalise:
            return reward / (1.0 + self.multiplier)
        return reward

    def settle_unit(self) -> None:
        """Let the unit of rewards follow the last rollout, where `growing` is set."""
        if self.growing is not None:
            self.growing.settle()
            self.unit = self.growing.value

    # -- VecEnv ------------------------------------------------------------------------------------

    def reset(self) -> Array:
        """Start new episodes in all rows and return their observations [B, size]."""
        seen = self.task.reset([self._next_seed() for _ in range(self.num_envs)])
        self._return[:] = 0
        self._cost[:] = 0
        self._until_cut[:] = -1
        if self.spread:
            number = np.arange(1, self.num_envs + 1)
            self._until_cut[:] = number * self.task.max_decisions // self.num_envs
        all_rows = np.ones(self.num_envs, bool)
        return self.observe(seen, all_rows, np.zeros_like(self._action))

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take the actions [B, A] of the next step."""
        self._action = np.asarray(actions, np.float32)

    def step_wait(self) -> tuple[Array, Array, NDArray[np.bool_], list[dict[str, Any]]]:
        """Make the step of `step_async`. Rows whose episodes end start new ones at once.

        Returns:
            Observations [B, size], those of ended rows from the new episodes; rewards [B]; ends
            [B]; and infos, in which an ended row finds its last observation.
        """
        # -- act
        executed, penalty = self.execute(self._action)
        step: Step = self.task.step(executed)
        reward = self.objective(step, penalty)
        if self.growing is not None:
            self.growing.see(step.reward)

        # -- count
        self._return += step.reward
        self._cost += step.cost_env
        self.curve.env_steps += int(step.env_steps.sum())
        self.curve.costly_env_steps += int(step.cost_env.sum())

        # -- observe
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        no_rows = np.zeros(self.num_envs, bool)
        observation = self.observe(step.observation, no_rows, executed)
        self._until_cut -= 1
        ended = step.ended | (self._until_cut == 0)
        if not ended.any():
            return observation, reward.astype(np.float32), ended, infos

        # -- close the books of the episodes that ended
        rows = np.flatnonzero(ended)
        for row in rows:
            infos[row] = {
                "terminal_observation": observation[row].copy(),
                "TimeLimit.truncated": not step.terminated[row],
            }
            if step.ended[row]:  # an episode that was cut is not a whole one
                self.curve.returns.append(float(self._return[row]))
                self.curve.costs.append(float(self._cost[row]))
        self._return[rows] = 0
        self._cost[rows] = 0
        self._until_cut[rows] = -1

        # -- start new ones in their rows
        seen = self.task.reset([self._next_seed() for _ in rows], ended)
        fresh = self.observe(seen, ended, np.where(ended[:, None], 0, executed))
        observation = np.where(ended[:, None], fresh, observation)
        return observation, reward.astype(np.float32), ended, infos

    def snapshot(self) -> dict[str, NDArray[Any]]:
        """Return what determines the future of every row, without what a subclass adds. The curve
        is not part of it: take it first.
        """
        arrays = {f"task/{name}": array for name, array in self.task.snapshot().items()}
        arrays["return"] = self._return.copy()
        arrays["cost"] = self._cost.copy()
        arrays["until_cut"] = self._until_cut.copy()
        return arrays

    def restore(self, snapshot: dict[str, NDArray[Any]]) -> None:
        """Return to a snapshot. The caller keeps the last observation."""
        # A foreign environment may refuse everything before its first reset.
        self.task.reset([0] * self.num_envs)
        self.task.restore(
            {
                name.removeprefix("task/"): array
                for name, array in snapshot.items()
                if name.startswith("task/")
            }
        )
        self._return[:] = snapshot["return"]
        self._cost[:] = snapshot["cost"]
        self._until_cut[:] = snapshot["until_cut"]

    def close(self) -> None:
        """Do nothing: there is nothing to release."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return the same value for every environment; stable-baselines3 asks for `render_mode`."""
        return [getattr(self, attr_name, None)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set a value, the same for every environment."""
        setattr(self, attr_name, value)

    def env_method(
        self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any
    ) -> list[Any]:
        """Raise: there are no separate environments to call."""
        raise AttributeError(f"a batch of tasks has no method '{method_name}' for each environment")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Return False for every environment: nothing wraps it."""
        return [False] * self.num_envs


class SeedStream:
    """An endless, reproducible stream of episode seeds: derive(*parts, 0), derive(*parts, 1), and
    so on. `drawn` counts them.
    """

    def __init__(self, *parts: Any) -> None:
        self._parts = parts
        self.drawn = 0

    def __call__(self) -> int:
        seed = derive(*self._parts, self.drawn)
        self.drawn += 1
        return seed


def actor_layers(policy: Any) -> Sequence[Any]:
    """Return the linear layers of a stable-baselines3 actor, first to last."""
    from torch import nn

    modules = policy.mlp_extractor.policy_net
    layers = [module for module in modules if isinstance(module, nn.Linear)]
    layers.append(policy.action_net)
    return layers
