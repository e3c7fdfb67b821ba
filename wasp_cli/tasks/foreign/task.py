"""A batch of foreign gymnasium environments as a `VectorTask`.

The rest of wasp commands in [-1, 1]; the adapter maps this onto the environment's own bounds.
Rewards add up over the env steps of a decision step; an env step costs when `info["cost"]` is above
zero. `info["goals"]` (reached so far) or `info["success"]` tell of success.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from wasp_cli.errors import TaskError
from wasp_cli.tasks.base import CAMERA_SIZE, Bools, Floats, Observation, Pixels, Step
from wasp_cli.tasks.batch import (
    Totals,
    check_begun,
    check_options,
    checked_action,
    chosen_rows,
    running_rows,
)
from wasp_cli.tasks.foreign.calls import EnvStep, GymEnv, calling, of_environment
from wasp_cli.tasks.foreign.calls import reset as reset_env
from wasp_cli.tasks.foreign.calls import step as step_env
from wasp_cli.tasks.foreign.closing import close_owned, opened
from wasp_cli.tasks.foreign.examine import examine
from wasp_cli.tasks.foreign.make import make_env
from wasp_cli.tasks.foreign.picture import drawn
from wasp_cli.tasks.pictures import PICTURE

Ints = NDArray[np.int64]


class GymTask:
    """B environments of the gymnasium id `name` as a `VectorTask`; `threads` has no effect,
    they are stepped one after the other (`processes` steps them side by side).

    With `picture` among `observe` they are made so that they can draw themselves (see `picture`).
    """

    def __init__(
        self,
        name: str,
        batch: int,
        *,
        action_repeat: int = 4,
        observe: Sequence[str] = ("pixels", "state", "privileged"),
        threads: int = 1,
    ) -> None:
        check_options(batch, action_repeat, threads, observations(observe))
        facts = examine(name)
        self._facts = facts
        self._name = name

        # What a task is; see `VectorTask`.
        self.batch = batch
        self.action_repeat = action_repeat
        self.observe = tuple(observe)
        self.action_size = facts.action_low.size
        self.action_low = np.full(self.action_size, -1.0)
        self.action_high = np.full(self.action_size, 1.0)
        self.privileged_size = facts.views.privileged_size
        self.state_size = facts.views.state_size
        self.decision_seconds = facts.env_seconds * action_repeat
        self.max_decisions = -(-facts.env_steps // action_repeat)
        self.cost_sources = facts.cost_sources
        # 1, or 2; the image of a rear camera that is not there is black
        self.cameras = facts.views.cameras

        # The environments. Without vectors, state and privileged are made of images.
        from_images = facts.views.privileged is None
        self._looks = from_images or "pixels" in self.observe
        self._draws = PICTURE in self.observe
        self._envs: list[GymEnv] = opened(self, name)
        try:
            for _ in range(batch):
                self._envs.append(self._made())
        except TaskError:
            self.close()
            raise

        # The episodes, and what was seen of them last.
        self._env_steps = np.zeros(batch, np.int64)
        self._goals = np.zeros(batch, np.int64)
        self._ended = np.ones(batch, np.bool_)
        self._terminated = np.zeros(batch, np.bool_)
        self._begun = np.zeros(batch, np.bool_)
        self._pixels: Pixels = np.zeros((batch, 6, CAMERA_SIZE, CAMERA_SIZE), np.uint8)
        self._state = np.zeros((batch, self.state_size))
        self._privileged = np.zeros((batch, self.privileged_size), np.float32)

    def _made(self) -> GymEnv:
        """One environment, which can draw itself where pictures were asked for and it can."""
        if self._draws:
            try:
                return make_env(self._name, renders=self._looks, draws=True)
            except TaskError:
                self._draws = False  # it takes no `render_mode`
        return make_env(self._name, renders=self._looks)

    def close(self) -> None:
        """Close the environments; whoever holds the task cannot use it any more.

        It need not be called: a task that nobody holds is closed when the next one is made, and
        every task at the end of the node, of the command, or of Python.
        """
        close_owned(self)

    # -- episodes ----------------------------------------------------------------------------------

    def reset(self, seeds: Sequence[int], rows: Bools | None = None) -> Observation:
        """Start new episodes; see `VectorTask`."""
        self._require_open()
        for row, seed in chosen_rows(self.batch, seeds, rows):
            with of_environment(self._name):
                seen = reset_env(self._envs[row], seed)
                for zeroed in (self._env_steps, self._goals, self._ended, self._terminated):
                    zeroed[row] = 0
                self._begun[row] = True
                self._observe_row(row, seen, first=True)
        return self._observation()

    def step(self, action: NDArray[Any]) -> Step:
        """Advance one environment after the other; see `VectorTask`."""
        self._require_open()
        control = self._scaled(checked_action(action, self.batch, self.action_size))
        totals = Totals.zeros(self.batch, self.cost_sources)
        for row in running_rows(self._ended).tolist():
            with of_environment(self._name):
                self._advance(row, control[row], totals)
        return totals.as_step(self._observation(), self._ended, self._terminated)

    def _require_open(self) -> None:
        if not self._envs:
            raise TaskError(f"environment '{self._name}' was closed", "make the task again")

    def _scaled(self, control: Floats) -> Floats:
        """Commands [B, A] in [-1, 1] within the environment's own bounds."""
        low = self._facts.action_low
        high = self._facts.action_high
        # In this order a Box of [-1, 1] gets every command as it is, to the bit.
        scaled = (low + high) / 2 + (high - low) / 2 * control
        return np.clip(scaled, low, high)

    def _advance(self, row: int, control: Floats, totals: Totals) -> None:
        """Take the env steps of a decision in one environment, and add them to the totals."""
        env = self._envs[row]
        space = env.action_space
        for _ in range(self.action_repeat):
            done = step_env(env, self._action(control, space))
            self._env_steps[row] += 1
            totals.env_steps[row] += 1
            totals.reward[row] += done.reward
            self._count(row, done, totals)
            self._terminated[row] = done.terminated
            self._ended[row] = (
                done.terminated or done.truncated or self._env_steps[row] >= self._facts.env_steps
            )
            if self._ended[row]:
                break
        self._observe_row(row, done.seen, first=False)

    def _action(self, control: Floats, space: gymnasium.Space[Any]) -> NDArray[Any]:
        """A command as the environment takes it: of its shape and type; whole numbers are the
        nearest ones.
        """
        assert space.shape is not None
        if np.issubdtype(space.dtype, np.integer):
            control = np.rint(control)
        return control.reshape(space.shape).astype(space.dtype)

    def _count(self, row: int, done: EnvStep, totals: Totals) -> None:
        """Add the cost and the goals of an env step to the totals."""
        totals.cost[row] += done.cost > 0
        for source, value in done.sources.items():
            if source not in totals.sources:
                raise TaskError(
                    f"it has a new cost source '{source}'",
                    f"its first step had: {', '.join(self.cost_sources)}",
                )
            totals.sources[source][row] += value > 0
        goals = done.goals
        if goals is None:  # then success is a single goal
            goals = max(int(self._goals[row]), int(done.success))
        totals.goals[row] += goals - self._goals[row]
        self._goals[row] = goals

    # -- observation -------------------------------------------------------------------------------

    def _observe_row(self, row: int, seen: Any, *, first: bool) -> None:
        """Keep what an environment shows; `first`: whether the episode begins with it."""
        views = self._facts.views
        if self._looks:
            self._pixels[row] = views.pixels(seen, self._envs[row])
        if views.privileged is None:
            # A coarse image, and how it has changed.
            coarse = views.coarse(self._pixels[row])
            before = self._privileged[row, : self.privileged_size // 2].copy()
            if first:
                before = coarse
            self._privileged[row] = np.concatenate([coarse, coarse - before])
            self._state[row] = self._privileged[row]
        if views.privileged is not None and "privileged" in self.observe:
            self._privileged[row] = views.vector(seen, views.privileged)
        if views.state is not None and "state" in self.observe:
            self._state[row] = views.vector(seen, views.state)

    def _observation(self) -> Observation:
        return Observation(
            self._pixels.copy() if self.cameras and "pixels" in self.observe else None,
            self._state.copy() if "state" in self.observe else None,
            self._privileged.copy() if "privileged" in self.observe else None,
        )

    def picture(self, row: int) -> Pixels | None:
        """Return what the environment of a row draws of itself now, uint8 [H, W, 3], for people.

        None where pictures were not asked for, or where it cannot draw itself.
        """
        self._require_open()
        if not self._draws:
            return None
        picture = drawn(self._envs[row])
        # what cannot be drawn once is not tried again
        self._draws = picture is not None
        return picture

    # -- snapshot ----------------------------------------------------------------------------------

    def _arrays(self) -> dict[str, NDArray[Any]]:
        return {
            "env_steps": self._env_steps,
            "goals": self._goals,
            "ended": self._ended,
            "terminated": self._terminated,
            "pixels": self._pixels,
            "state": self._state,
            "privileged": self._privileged,
        }

    def snapshot(self) -> dict[str, NDArray[Any]]:
        """Return what `VectorTask` says; the environment's own part are the arrays of its
        `snapshot()`, or the seed and the actions of the episode (`replayed.Replayed`).
        """
        self._require_open()
        check_begun(self._begun)
        with of_environment(self._name), calling("snapshot"):
            own = [env.get_wrapper_attr("snapshot")() for env in self._envs]
            theirs = {}
            for name in own[0]:
                theirs[f"env/{name}"] = np.stack([np.asarray(arrays[name]) for arrays in own])
        return {name: array.copy() for name, array in self._arrays().items()} | theirs

    def restore(self, snapshot: dict[str, NDArray[Any]]) -> Observation:
        """Return to a snapshot; see `VectorTask`."""
        self._require_open()
        for name, array in self._arrays().items():
            if name not in snapshot or snapshot[name].shape != array.shape:
                raise TaskError(
                    f"the snapshot is not one of this task with batch {self.batch}: "
                    f"'{name}' is missing or has another shape"
                )
        theirs = {
            name.removeprefix("env/"): array
            for name, array in snapshot.items()
            if name.startswith("env/")
        }
        for row, env in enumerate(self._envs):
            with of_environment(self._name), calling("restore"):
                own = {name: array[row].copy() for name, array in theirs.items()}
                env.get_wrapper_attr("restore")(own)
        for name, array in self._arrays().items():
            array[...] = snapshot[name]
        self._begun[:] = True
        return self._observation()


def observations(observe: Sequence[str]) -> tuple[str, ...]:
    """Return the fields of `Observation` among the names in `observe`."""
    return tuple(name for name in observe if name != PICTURE)
