"""Many episodes of a task as one gymnasium vector environment."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, cast

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from wasp_cli.errors import TaskError, UsageError, did_you_mean
from wasp_cli.tasks.base import MAP_SIZE, Bools, Floats, Observation, Pixels
from wasp_cli.tasks.gym_common import (
    Info,
    Maps,
    ObservationName,
    Seen,
    checked_control,
    chosen_fields,
    drawn_layout,
    limited_spec,
    masked,
    observed_task,
    refuse_other_task,
    refuse_reset_options,
    refuse_unknown,
    row_of,
    space_of,
)
from wasp_cli.tasks.registry import TASKS

_OPTIONS = ("observation", "action_repeat", "render_mode", "width", "height", "threads", "autoreset_mode", "max_episode_steps")


class TaskVectorEnv(gymnasium.vector.VectorEnv[Any, NDArray[Any], NDArray[Any]]):
    """B episodes of a task, stepped in one call: what `gymnasium.make_vec(id, num_envs=B)` gives.

    Step by step the same as gymnasium's `SyncVectorEnv` over B `TaskEnv`, seed for seed and in every autoreset mode, and several times as
    fast. A copy (`copy.deepcopy`, pickle) goes on bit for bit.

    Args:
        num_envs: B, episodes side by side.
        task: as for `TaskEnv`; so are `observation`, `action_repeat`, `render_mode`, `width` and `height`.
        observation: see `task`.
        action_repeat: see `task`.
        render_mode: see `task`; `render` gives B pictures.
        width: see `task`.
        height: see `task`.
        threads: threads for physics and cameras; results do not depend on it.
        autoreset_mode: what becomes of an episode that ended: another starts with the next step, whose action it ignores (`NextStep`), with
            the same step (`SameStep`; the last observation is `infos["final_obs"]`), or when `reset` is called (`Disabled`).
        max_episode_steps: truncates episodes earlier than the task does, like `gymnasium.make`'s.
        upstream_api: not there for vectors.
        registered: see `task`.

    Raises:
        UnknownName: no such task.
        UnknownOption: an unknown option, which is a `TypeError` too.
        UsageError: an unknown observation, render mode or autoreset mode.
    """

    def __init__(
        self,
        num_envs: int = 1,
        task: str = "goal1",
        observation: ObservationName = "state",
        action_repeat: int = 1,
        render_mode: Literal["rgb_array"] | None = None,
        width: int = MAP_SIZE,
        height: int = MAP_SIZE,
        threads: int = 1,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        upstream_api: bool = False,
        registered: str | None = None,
        **unknown: object,
    ) -> None:
        refuse_other_task(task, registered)
        refuse_unknown("TaskVectorEnv", task, unknown, _OPTIONS)
        if upstream_api:
            raise UsageError("a vector of environments has no six-tuple", "read infos['cost'], or step single environments")
        self._task, self._name = observed_task(task, num_envs, observation, action_repeat, threads), observation
        self._success_goals = TASKS[task].success_goals
        self._spec: EnvSpec | None = None
        self.num_envs = num_envs
        self.autoreset_mode = _mode(autoreset_mode)
        self._limit = _limit(max_episode_steps, self._task.max_decisions)
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": round(1.0 / self._task.decision_seconds),
            "autoreset_mode": self.autoreset_mode,
        }
        self.render_mode, self._maps = render_mode, Maps(task, self._task, render_mode, width, height)
        self.single_action_space = gymnasium.spaces.Box(self._task.action_low, self._task.action_high, dtype=np.float64)
        self.single_observation_space = space_of(self._task, observation)
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, num_envs)
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, num_envs)
        self._goals = np.zeros(num_envs, np.int64)
        self._steps = np.zeros(num_envs, np.int64)
        """[B] steps of the episode so far."""
        self._over = np.zeros(num_envs, np.bool_)
        """[B] the episode ended with the last step, and no other has started."""
        self._draws: list[np.random.Generator | None] = [None] * num_envs
        """Per row: draws the layouts of episodes that start without a seed."""
        self._begun = np.zeros(num_envs, np.bool_)
        """[B] an episode was started."""

    @property
    def max_episode_steps(self) -> int:
        """Steps after which every episode has ended."""
        return self._limit

    @property
    def spec(self) -> EnvSpec | None:  # gymnasium sets it after making the environment
        """What `gymnasium.make_vec` makes such an environment of, the time limit included; None for one that was made without it."""
        return None if self._spec is None else limited_spec(self._spec, self.max_episode_steps)

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        """Keep what gymnasium sets; the time limit is added when it is read."""
        self._spec = spec

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
        seen = self._start(rows, [seeds[row] for row in np.flatnonzero(rows)])
        return chosen_fields(self._task, seen, self._name), Info.zeros(self._task).batch(rows)

    def step(self, actions: NDArray[Any]) -> tuple[Seen, Floats, Bools, Bools, dict[str, Any]]:
        """Advance every running episode under `actions` [B, A], and start those anew whose turn it is (see `autoreset_mode`).

        Raises:
            TaskError: the actions are no finite [B, A], or an episode has not begun, or has ended and nothing starts another.
        """
        control = checked_control(actions, (self.num_envs, self._task.action_size))
        fresh = self._over.copy()
        if self.autoreset_mode is AutoresetMode.DISABLED and fresh.any():
            ended = ", ".join(map(str, np.flatnonzero(fresh)))
            raise TaskError(f"step after the end of row {ended}", "call reset(options={'reset_mask': terminated | truncated})")
        reward, terminated, truncated = np.zeros(self.num_envs), np.zeros_like(fresh), np.zeros_like(fresh)
        everyone, info, seen = np.ones_like(fresh), Info.zeros(self._task), None
        if not fresh.all():
            step = self._task.step(control)
            self._steps += 1
            self._goals += step.goals
            reward = np.where(fresh, 0.0, step.reward)
            terminated = step.terminated & ~fresh
            truncated = step.ended & ~step.terminated & ~fresh
            if self._limit < self._task.max_decisions:
                truncated |= (self._steps >= self._limit) & ~fresh
            info = Info.of(step, self._goals.copy(), self._goals >= self._success_goals).only(~fresh)
            seen = chosen_fields(self._task, step.observation, self._name)
        self._over = terminated | truncated
        infos: dict[str, Any] = {}
        if self.autoreset_mode is AutoresetMode.SAME_STEP and self._over.any():
            assert seen is not None
            fresh = self._over.copy()
            infos = masked({"final_obs": _rows_of(seen, fresh), "final_info": info.batch(fresh)}, fresh)
            info = info.only(~fresh)
        if fresh.any():
            begun = chosen_fields(self._task, self._start(fresh, [None] * int(fresh.sum())), self._name)
            seen = begun if seen is None else _merged(fresh, begun, seen)
        assert seen is not None
        return seen, reward, terminated, truncated, infos | info.batch(everyone)

    def render(self) -> tuple[Pixels, ...] | None:
        """Draw a map of each episode, uint8 [height, width, 3]; None without a render mode."""
        return None if self.render_mode is None else cast("tuple[Pixels, ...]", self.call("render"))

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call a method of every episode, or read an attribute, as `SyncVectorEnv` does: what a `TaskEnv` of each row would say.

        There are `render`, `snapshot` (for `TaskEnv.restore`), `observation_space`, `action_space`, `render_mode`, `metadata`, `spec` and
        `max_episode_steps`.

        Raises:
            UsageError: another name: the episodes are one batch and not B environments.
        """
        kinds: dict[str, Callable[..., Any]] = {
            "render": self._maps.draw,
            "snapshot": self._snapshot,
            "observation_space": lambda row: self.single_observation_space,
            "action_space": lambda row: self.single_action_space,
            **{name: lambda row, name=name: getattr(self, name) for name in ("render_mode", "metadata", "spec", "max_episode_steps")},
        }
        if name not in kinds:
            raise UsageError(f"the episodes of a vector have no '{name}'", did_you_mean(name, kinds))
        return tuple(kinds[name](row, *args, **kwargs) for row in range(self.num_envs))

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Read an attribute of every episode, see `call`."""
        return self.call(name)

    def _snapshot(self, row: int) -> dict[str, NDArray[Any]]:
        """What `TaskEnv.snapshot` gives."""
        arrays = {name: array[row : row + 1] for name, array in self._task.snapshot().items()}
        return {**arrays, "goals_reached": self._goals[row : row + 1].copy()}

    def _start(self, rows: Bools, seeds: list[int | None]) -> Observation:
        layouts = []
        for row, seed in zip(np.flatnonzero(rows).tolist(), seeds, strict=True):
            draws = self._draws[row]
            if seed is not None or draws is None:
                draws, _ = gymnasium.utils.seeding.np_random(seed)
                self._draws[row] = draws
            layouts.append(drawn_layout(draws, seed))
        seen = self._task.reset(layouts, rows)
        self._goals[rows] = 0
        self._steps[rows] = 0
        self._over[rows] = False
        self._begun |= rows
        return seen


def _mode(mode: AutoresetMode | str) -> AutoresetMode:
    try:
        return AutoresetMode(mode)
    except ValueError as error:
        known = [known.value for known in AutoresetMode]
        raise UsageError(f"there is no autoreset_mode {mode!r}", did_you_mean(str(mode), known)) from error


def _limit(steps: int | None, own: int) -> int:
    """Steps of an episode: as many as the task's `own`, or fewer."""
    if steps is None:
        return own
    if not isinstance(steps, int | np.integer) or steps < 1:
        raise UsageError(f"max_episode_steps should be an integer of at least 1, not {steps!r}")
    return min(int(steps), own)


def _merged(rows: Bools, ours: Seen, theirs: Seen) -> Seen:
    """`ours` in the rows of a mask, `theirs` in the others."""
    if isinstance(ours, dict) and isinstance(theirs, dict):
        return {name: cast("NDArray[Any]", _merged(rows, value, theirs[name])) for name, value in ours.items()}
    assert isinstance(ours, np.ndarray)
    assert isinstance(theirs, np.ndarray)
    return np.where(rows.reshape(-1, *[1] * (ours.ndim - 1)), ours, theirs)


def _rows_of(seen: Seen, rows: Bools) -> NDArray[np.object_]:
    """The observations of some rows, one object each; None in the others."""
    objects: NDArray[np.object_] = np.full(len(rows), None, object)
    for row in np.flatnonzero(rows).tolist():
        objects[row] = row_of(seen, row)
    return objects


def _mask(mask: Any, size: int) -> Bools:
    if mask is None:
        return np.ones(size, np.bool_)
    if not isinstance(mask, np.ndarray) or mask.shape != (size,) or mask.dtype != np.bool_ or not mask.any():
        raise UsageError(f"options['reset_mask'] should be an array of {size} bools, at least one of them true")
    return mask
