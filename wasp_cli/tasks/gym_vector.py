"""Many episodes of a task as one gymnasium vector environment."""

from __future__ import annotations

from typing import Any, Literal, cast

import gymnasium
import numpy as np
from numpy.typing import NDArray

from wasp_cli.errors import UsageError
from wasp_cli.tasks.base import Bools, Floats, Observation, Pixels
from wasp_cli.tasks.gym import (
    ObservationName,
    Seen,
    checked_control,
    chosen_fields,
    drawn_task,
    map_of,
    observed_task,
    refuse_other_task,
    refuse_reset_options,
    refuse_unknown,
    space_of,
)
from wasp_cli.tasks.layout import SEED_LIMIT
from wasp_cli.tasks.registry import TASKS


class TaskVectorEnv(gymnasium.vector.VectorEnv[Any, NDArray[Any], NDArray[Any]]):
    """B episodes of a task, stepped in one call: what `gymnasium.make_vec(id, num_envs=B)` gives.

    Step by step the same as gymnasium's `SyncVectorEnv` over B `TaskEnv`, seed for seed, and several times as fast. An episode that ended
    starts anew in the next step, whose action it ignores (`AutoresetMode.NEXT_STEP`).

    Args:
        num_envs: B, episodes side by side.
        task: as for `TaskEnv`; so are `observation`, `action_repeat` and `render_mode`.
        observation: see `task`.
        action_repeat: see `task`.
        render_mode: see `task`; `render` gives B pictures.
        threads: threads for physics and cameras; results do not depend on it.
        upstream_api: not there for vectors.
        registered: see `task`.

    Raises:
        UnknownName: no such task.
        UsageError: an unknown option, observation or render mode.
    """

    def __init__(
        self,
        num_envs: int = 1,
        task: str = "goal1",
        observation: ObservationName = "state",
        action_repeat: int = 1,
        render_mode: Literal["rgb_array"] | None = None,
        threads: int = 1,
        upstream_api: bool = False,
        registered: str | None = None,
        **unknown: object,
    ) -> None:
        refuse_other_task(task, registered)
        refuse_unknown(task, unknown, ("observation", "action_repeat", "render_mode", "threads"))
        if upstream_api:
            raise UsageError("a vector of environments has no six-tuple", "read infos['cost'], or step single environments")
        self._task, self._name = observed_task(task, num_envs, observation, action_repeat, threads), observation
        self._success_goals = TASKS[task].success_goals
        self.num_envs = num_envs
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": round(1.0 / self._task.decision_seconds),
            "autoreset_mode": gymnasium.vector.AutoresetMode.NEXT_STEP,
        }
        self.render_mode, self._drawn = render_mode, drawn_task(task, self._task, render_mode)
        self.single_action_space = gymnasium.spaces.Box(self._task.action_low, self._task.action_high, dtype=np.float64)
        self.single_observation_space = space_of(self._task, observation)
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, num_envs)
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, num_envs)
        self._goals = np.zeros(num_envs, np.int64)
        self._over = np.zeros(num_envs, np.bool_)
        """[B] the episode ended with the last step, so the next one starts another."""
        self._draws: list[np.random.Generator | None] = [None] * num_envs
        """Per row: draws the layouts of episodes that start without a seed."""
        self._begun = np.zeros(num_envs, np.bool_)
        """[B] an episode was started."""

    def reset(self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None) -> tuple[Seen, dict[str, Any]]:
        """Start episodes: row b with `seed + b`, or with the b-th of a list of seeds; None draws a layout.

        `options={"reset_mask": bool [B]}` starts those rows alone, and the others show what they showed; the first reset starts every row.

        Raises:
            UsageError: a wrong number of seeds, a wrong mask, or another option.
        """
        if isinstance(seed, int | np.integer):
            seed = [int(seed) + row for row in range(self.num_envs)]
        seeds = [None] * self.num_envs if seed is None else seed
        if len(seeds) != self.num_envs:
            raise UsageError(f"{len(seeds)} seeds for {self.num_envs} environments")
        options = dict(options or {})
        rows = _mask(options.pop("reset_mask", None), self.num_envs)
        refuse_reset_options(options)
        if not (rows | self._begun).all():
            left = ", ".join(map(str, np.flatnonzero(~(rows | self._begun))))
            raise UsageError(f"options['reset_mask'] leaves out rows that have not begun: {left}", "the first reset starts every row")
        return chosen_fields(self._start(rows, [seeds[row] for row in np.flatnonzero(rows)]), self._name), {}

    def step(self, actions: NDArray[Any]) -> tuple[Seen, Floats, Bools, Bools, dict[str, Any]]:
        """Advance every running episode under `actions` [B, A], and start those anew that had ended.

        Raises:
            TaskError: the actions are no finite [B, A], or an episode has not begun.
        """
        control = checked_control(actions, (self.num_envs, self._task.action_size))
        fresh = self._over.copy()
        reward, terminated, truncated = np.zeros(self.num_envs), np.zeros_like(fresh), np.zeros_like(fresh)
        infos: dict[str, Any] = {}
        seen: Seen | None = None
        if not fresh.all():
            step = self._task.step(control)
            reward = step.reward  # rows that had ended before have none
            terminated = step.terminated & ~fresh
            truncated = step.ended & ~step.terminated & ~fresh
            self._goals += step.goals
            sources = _info({name: count.astype(np.float64) for name, count in step.sources.items()}, ~fresh)
            success = (self._goals >= self._success_goals) & ~fresh
            infos = _info({"cost": step.cost_env.astype(np.float64), "cost_sources": sources, "success": success}, ~fresh)
            infos |= _info({"goals": np.where(fresh, 0, self._goals)}, ~fresh)
            seen = chosen_fields(step.observation, self._name)
        if fresh.any():
            begun = chosen_fields(self._start(fresh, [None] * int(fresh.sum())), self._name)
            seen = begun if seen is None else _merged(fresh, begun, seen)
        assert seen is not None
        self._over = terminated | truncated
        return seen, reward, terminated, truncated, infos

    def render(self) -> tuple[Pixels, ...] | None:
        """Draw a map of each episode, uint8 [256, 256, 3]; None without a render mode."""
        return None if self._drawn is None else tuple(map_of(self._drawn, row) for row in range(self.num_envs))

    def _start(self, rows: Bools, seeds: list[int | None]) -> Observation:
        layouts = []
        for row, seed in zip(np.flatnonzero(rows).tolist(), seeds, strict=True):
            draws = self._draws[row]
            if seed is not None or draws is None:
                draws, _ = gymnasium.utils.seeding.np_random(seed)
                self._draws[row] = draws
            layouts.append(int(draws.integers(SEED_LIMIT)) if seed is None else seed)
        self._goals[rows] = 0
        self._over[rows] = False
        seen = self._task.reset(layouts, rows)
        self._begun |= rows
        return seen


def _merged(rows: Bools, ours: Seen, theirs: Seen) -> Seen:
    """`ours` in the rows of a mask, `theirs` in the others."""
    if isinstance(ours, dict) and isinstance(theirs, dict):
        return {name: cast("NDArray[Any]", _merged(rows, value, theirs[name])) for name, value in ours.items()}
    assert isinstance(ours, np.ndarray)
    assert isinstance(theirs, np.ndarray)
    return np.where(rows.reshape(-1, *[1] * (ours.ndim - 1)), ours, theirs)


def _info(values: dict[str, Any], rows: Bools) -> dict[str, Any]:
    """Infos as gymnasium's vectors give them: beside each key a mask of the rows that have it."""
    return {name: value for key, array in values.items() for name, value in ((key, array), (f"_{key}", rows.copy()))}


def _mask(mask: Any, size: int) -> Bools:
    if mask is None:
        return np.ones(size, np.bool_)
    if not isinstance(mask, np.ndarray) or mask.shape != (size,) or mask.dtype != np.bool_ or not mask.any():
        raise UsageError(f"options['reset_mask'] should be an array of {size} bools, at least one of them true")
    return mask
