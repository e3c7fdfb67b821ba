"""A gymnasium environment with a trained assistant in it: its actions are the operator's commands.

    env = gymnasium.make("wasp_cli.tasks.gym:wasp/SafetyPointGoal1-v0", observation="all")
    env = wasp_cli.AssistedEnv(env, wasp_cli.load_assistant("results", "goal1 s1 wasp"))
    seen, info = env.reset(seed=0)
    seen, reward, terminated, truncated, info = env.step(command)   # info["executed_action"], ...

A step is a decision: the assistant corrects the command, and what it decided is executed for
`action_repeat` steps of the environment inside. A = action size.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector.utils import create_empty_array
from numpy.typing import NDArray

from wasp_cli.errors import TaskError, UsageError
from wasp_cli.notebook.assistant import AssistantDecision, LoadedAssistant
from wasp_cli.notebook.given import number_of, one_seed
from wasp_cli.notebook.made_alike import require_made_alike
from wasp_cli.notebook.perceived import (
    VECTOR,
    perceived,
    require_sight,
    require_size,
    seen_through,
)
from wasp_cli.tasks.declared import RENDER, declaration_of
from wasp_cli.tasks.foreign.translated import translated
from wasp_cli.tasks.foreign.views import Views, views_of
from wasp_cli.tasks.gym import TaskEnv

OPERATOR, ASSISTANT_SEED = "operator", "assistant_seed"  # options of `reset`
SEEDS = 2**31  # an assistant's seed is below


class AssistedEnv(gymnasium.Wrapper[Any, NDArray[Any], Any, NDArray[Any]], RecordConstructorArgs):
    """See the module. Observations and episodes are those of the environment inside.

    `info` is that of the last env step, with costs (`cost`, `cost_*`) added up over the step, and
    has besides: `executed_action` [A] and `command` [A] in [-1, 1]; `gate` (`none`, `safety`,
    `task` or `method`); `intervened`; `predicted_cost` and `predicted_gain` where the method
    predicts them; and `env_steps`, how many steps of the environment inside were made.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        assistant: LoadedAssistant,
        action_repeat: int | None = None,
        shown: Callable[[Any], Any] | None = None,
    ) -> None:
        """Wrap an environment.

        Args:
            env: a task of ours with observation `pixels` or `all`, or the environment that the
                assistant was trained on.
            assistant: its models are shared; `self.assistant` follows the episodes of this
                environment alone.
            action_repeat: steps of `env` for each decision; None: those that the assistant was
                trained with, less what `env` repeats itself, if it is one of ours.
            shown: from an observation of `env` to what the assistant sees, as `LoadedAssistant.see`
                takes it; None: the observation itself.

        Raises:
            UsageError: the environment is of another task, was made with other arguments than in
                training, or cannot be repeated so.
            TaskError: its actions or observations are not what the assistant was trained on.
        """
        # The environment: of the assistant's task, as in training.
        _require_parts(env, assistant)
        RecordConstructorArgs.__init__(
            self,
            _disable_deepcopy=True,
            assistant=assistant,
            action_repeat=action_repeat,
            shown=shown,
        )
        if not assistant.own_task:
            require_made_alike(env, assistant.task, assistant.label)
        declaration = declaration_of(assistant.task)
        if declaration is not None:
            env = translated(env, declaration)  # which says its cost and its success
        gymnasium.Wrapper.__init__(self, env)

        # How decisions become steps of it.
        self.assistant = assistant.another()
        self.action_repeat = _repeat(env, assistant, action_repeat)
        self._shown = shown
        self._low, self._high = _bounds(env, assistant)

        # What the assistant sees. The views are of somebody else's environment; of one that is
        # drawn, they are there from the first reset on.
        self._views: Views | None = None
        self._draws_itself = declaration is not None and declaration.image == RENDER
        if shown is None and assistant.own_task:
            _try_observation(env, assistant)
        elif shown is None and self._draws_itself:
            _require_drawing(env)
        elif shown is None:
            self._views = views_of(env.observation_space, declaration)
            model = assistant.parts.world_model
            require_sight(self._views, model.reads)
            if model.reads == VECTOR:
                require_size(self._views.state_size, model.state_mean.numel(), assistant.label)

        # What the wrapper shows of itself.
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, self._low.shape, np.float32)
        self.decision: AssistantDecision | None = None  # the last one
        self._running = False
        self._draws = np.random.default_rng()
        fps = env.metadata.get("render_fps")
        if isinstance(fps, int | float | np.number):
            slower = max(1, round(fps / self.action_repeat))
            self.metadata = {**self.metadata, "render_fps": slower}
        if self._draws_itself and shown is None:
            self.metadata = {**self.metadata, "render_modes": ["rgb_array"]}  # it needs that one

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: of the environment; it also seeds the draw of assistants' seeds.
            options: `operator`: an impaired operator of `self.assistant.operator`, whose commands
                `self.assistant.command()` returns; `assistant_seed`: of the assistant's own draws;
                the rest is for the environment inside.

        Raises:
            UsageError: a seed is none, `operator` is none, or the options are no dictionary.
        """
        self._running = False
        if options is not None and not isinstance(options, Mapping):
            raise UsageError(
                f"options={options!r} is no dictionary", "reset(options={'assistant_seed': 0})"
            )
        given = dict(options or {})
        operator = given.pop(OPERATOR, None)
        own = given.pop(ASSISTANT_SEED, None)
        if seed is not None:
            seed = one_seed(seed)  # gymnasium takes no NumPy number
            self._draws = np.random.default_rng(seed)
        if own is None:
            own = int(self._draws.integers(SEEDS))
        own = one_seed(own, ASSISTANT_SEED)
        observation, info = self.env.reset(seed=seed, options=given or None)
        if self._draws_itself and self._views is None and self._shown is None:
            declaration = declaration_of(self.assistant.task)
            self._views = views_of(self.env.observation_space, declaration, self.env.render())
        self.assistant.reset(own, operator)
        self.assistant.see(self._perceived(observation))
        self._running = True
        self.decision = None
        return observation, info

    def step(self, action: NDArray[Any]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Let the assistant correct a command [A] in [-1, 1], and execute what it decides.

        Raises:
            TaskError: the command has another shape or is not finite, or no episode is running.
        """
        if not self._running:
            raise TaskError("no episode is running", "call reset first")
        self.decision = decision = self.assistant.decide(action)
        control = self._scaled(decision.action)
        total = 0.0
        costs = dict[str, Any]()
        made = 0
        terminated = truncated = False
        while made < self.action_repeat and not (terminated or truncated):
            observation, reward, terminated, truncated, info = self._stepped(control)
            total += float(reward)
            costs = _added(costs, info)
            made += 1
        self._running = not (terminated or truncated)
        if self._running:
            self.assistant.see(self._perceived(observation))
        return observation, total, terminated, truncated, {**info, **costs, **_told(decision, made)}

    def _stepped(self, control: NDArray[Any]) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        returned: Any = self.env.step(control.copy())
        if len(returned) != 5:
            raise TaskError(
                f"the step of the environment returned {len(returned)} values",
                "gymnasium's step returns five; make the environment without upstream_api",
            )
        observation, reward, terminated, truncated, info = returned
        return observation, reward, bool(terminated), bool(truncated), dict(info)

    def _perceived(self, observation: Any) -> Any:
        if self._shown is not None:
            return self._shown(observation)
        if self._views is None:
            return observation
        reads = self.assistant.parts.world_model.reads
        return seen_through(self._views, observation, self.env, reads)

    def _scaled(self, action: NDArray[np.float32]) -> NDArray[Any]:
        """An action in [-1, 1] within the environment's own bounds, as a task maps it."""
        space = self.env.action_space
        assert isinstance(space, gymnasium.spaces.Box)
        low = self._low
        high = self._high
        scaled = (low + high) / 2 + (high - low) / 2 * action.astype(np.float64)
        scaled = np.clip(scaled, low, high)
        if np.issubdtype(space.dtype, np.integer):
            scaled = np.rint(scaled)
        return scaled.reshape(space.shape).astype(space.dtype)


def _require_parts(env: object, assistant: object) -> None:
    """Refuse what is no environment, no assistant, or an environment that has an assistant."""
    example = "AssistedEnv(gymnasium.make(...), load_assistant(...))"
    if isinstance(env, gymnasium.vector.VectorEnv):
        raise UsageError(
            "an assistant follows one environment, and this is a vector of them",
            "put one into each: gymnasium.vector.SyncVectorEnv([lambda: AssistedEnv(...), ...])",
        )
    if not isinstance(env, gymnasium.Env):
        raise UsageError(f"{type(env).__name__} is no gymnasium environment", example)
    if not isinstance(assistant, LoadedAssistant):
        raise UsageError(f"{type(assistant).__name__} is no loaded assistant", example)
    inside: Any = env
    while isinstance(inside, gymnasium.Wrapper):
        if isinstance(inside, AssistedEnv):
            raise UsageError(
                f"'{inside.assistant.label}' assists in this environment already",
                "wrap the environment that is inside it",
            )
        inside = inside.env


def _repeat(env: gymnasium.Env[Any, Any], assistant: LoadedAssistant, given: int | None) -> int:
    inside = env.unwrapped
    if isinstance(inside, TaskEnv) and inside.task_name != assistant.task:
        raise UsageError(
            f"the environment is the task '{inside.task_name}', which '{assistant.label}' was not "
            "trained on",
            f"load an assistant of '{inside.task_name}'",
        )
    if given is not None:
        return number_of(given, "action_repeat", "steps")
    its_own = inside.action_repeat if isinstance(inside, TaskEnv) else 1
    if assistant.action_repeat % its_own:
        raise UsageError(
            f"the environment repeats an action {its_own} times, and '{assistant.label}' decides "
            f"once in {assistant.action_repeat} env steps",
            "make the environment without action_repeat",
        )
    return assistant.action_repeat // its_own


def _bounds(
    env: gymnasium.Env[Any, Any], assistant: LoadedAssistant
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The bounds [A] of an environment's actions."""
    space = env.action_space
    if not isinstance(space, gymnasium.spaces.Box) or space.shape is None:
        raise TaskError(f"the action space is {space}", "an assistant's actions are a Box")
    low = space.low.astype(np.float64).ravel()
    high = space.high.astype(np.float64).ravel()
    if not np.isfinite([low, high]).all():
        raise TaskError(
            f"the action space is {space}, and [-1, 1] is mapped onto its bounds",
            "take off what widens the bounds, such as ClipAction: actions are within them anyway",
        )
    if low.size != assistant.action_size:
        raise TaskError(
            f"the action space is {space}, and '{assistant.label}' has actions of "
            f"{assistant.action_size} numbers",
            "wrap the environment that it was trained on",
        )
    return low, high


def _try_observation(env: gymnasium.Env[Any, Any], assistant: LoadedAssistant) -> None:
    """Refuse an environment that does not show what an assistant of a task of ours sees."""
    reads = assistant.parts.world_model.reads
    zeros = create_empty_array(env.observation_space, 1, np.zeros)
    perceived(zeros, reads, 1, assistant.own_task, None)


def _require_drawing(env: gymnasium.Env[Any, Any]) -> None:
    """Refuse an environment that does not draw itself, where that is what the assistant sees."""
    if env.render_mode != "rgb_array":
        raise UsageError(
            f"the assistant sees what render() draws, and the render mode is {env.render_mode!r}",
            "make the environment with render_mode='rgb_array'",
        )


def _added(costs: Mapping[str, Any], info: Mapping[str, Any]) -> dict[str, Any]:
    """Costs so far with those of an env step: `cost`, `cost_<source>`, and the dictionary
    `cost_sources`.
    """
    added: dict[str, Any] = {}
    for name, value in info.items():
        if name != "cost" and not str(name).startswith("cost_"):
            continue
        before = costs.get(name)
        if isinstance(value, Mapping):
            earlier = before or {}
            added[name] = {source: earlier.get(source, 0) + cost for source, cost in value.items()}
        else:
            added[name] = value if before is None else before + value
    return added


def _told(decision: AssistantDecision, made: int) -> dict[str, Any]:
    """What `info` says of a decision; a prediction that was not made has no entry."""
    predicted = {
        "predicted_cost": decision.predicted_cost,
        "predicted_gain": decision.predicted_gain,
    }
    return {
        "executed_action": decision.action.copy(),
        "command": decision.command.copy(),
        "gate": decision.gate,
        "intervened": decision.intervened,
        "env_steps": made,
        **{name: value for name, value in predicted.items() if math.isfinite(value)},
    }
