"""What a foreign environment says of itself: it is made and stepped when a spec is read."""

from __future__ import annotations

import copy
import inspect
import sys
import warnings
from collections.abc import Container, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec, load_env_creator

from wasp_cli.errors import TaskError, UnknownName, WaspError, described, did_you_mean
from wasp_cli.registry import import_here, remedy
from wasp_cli.tasks.base import Floats
from wasp_cli.tasks.declared import (
    RENDER,
    Declaration,
    DeclarationError,
    declaration_of,
    text_of,
)
from wasp_cli.tasks.foreign.assets import Watch, declared_files, own_files, watched
from wasp_cli.tasks.foreign.calls import GymEnv, of_environment, reset
from wasp_cli.tasks.foreign.closing import close
from wasp_cli.tasks.foreign.layers import as_whole, attribute, env_seconds, env_steps, from_metadata
from wasp_cli.tasks.foreign.registration import registration_text
from wasp_cli.tasks.foreign.replayed import with_snapshots
from wasp_cli.tasks.foreign.started import mark
from wasp_cli.tasks.foreign.surroundings import go_headless, printing_aside
from wasp_cli.tasks.foreign.translated import functions_of, translated
from wasp_cli.tasks.foreign.views import Views, rendered, views_of
from wasp_cli.tasks.foreign.worlds import (
    AGAIN,
    Episode,
    random_actions,
    require_independent,
    require_same,
)

UNBOUNDED = 1e30
"""Bounds of actions from here on mean that there is none, as the largest float32 does."""
_CONTINUOUS = (
    "an operator's commands are continuous: a Box with finite bounds. Some environments have such "
    "actions as an option, as in `make: {continuous: true}`; else map a Box onto its actions in a "
    "wrapper that your module registers with it"
)
FIRST_STEPS = 3
"""Env steps of the episodes that are compared whenever a spec is read."""


@dataclass(frozen=True)
class Facts:
    modules: tuple[str, ...]  # where its code begins
    # the data files that it opens, by name (`tasks.foreign.assets`), and those that it declares
    files: tuple[str, ...]
    unowned: tuple[str, ...]  # paths of other files that it opened, of which no key knows
    # modules that only draw the image; none where an expert learns from the image
    image_modules: tuple[str, ...]
    spec: EnvSpec  # its registration
    env_steps: int  # time limit in env steps
    env_seconds: float  # time of one env step in seconds
    success_goals: int  # goals that count as success
    cost_sources: tuple[str, ...]
    action_low: Floats  # [A]
    action_high: Floats  # [A]
    views: Views

    def registered(self, without: Container[str] = ()) -> str:
        """Return how it is registered, as text: the options that it is made with decide its
        results. Wrappers of the modules `without` are left out.
        """
        return registration_text(self.spec, without)


def examine(name: str, tasks: Iterable[str] = ()) -> Facts:
    """Make the environment `name` (`module:Id-v0`, or a registered id) once per process;
    `tasks` are for suggestions.
    """
    # What modules and environments print as they start must not get between the lines of a plan
    # that is JSON.
    with printing_aside():
        meant = (name, text_of(declaration_of(name)))
        if meant not in _known:
            _known[meant] = _examined(name, tasks)
        return _known[meant]


_known: dict[tuple[str, str], Facts] = {}
"""What was found of the environments that were examined in this process, by name and
declaration."""


def _examined(name: str, tasks: Iterable[str]) -> Facts:
    with watched() as watch:  # its module may read files when it is imported, here
        try:
            spec = find_spec(name, tasks)
        except UnknownName as error:
            if declaration_of(name) is None:
                raise
            raise DeclarationError("id", error.message, error.hint) from error
        with of_environment(name):
            registration_text(spec)  # refused now, if it cannot be told apart from another one
        with made(name, renders=True) as env, of_environment(name):
            return _facts_of(name, spec, env, watch)


@contextmanager
def made(name: str, renders: bool = False) -> Iterator[GymEnv]:
    """Make an environment for the block, and close it at the end; arguments as of `make_env`."""
    env = make_env(name, renders)
    try:
        yield env
    finally:
        close(name, env)


def _facts_of(name: str, spec: EnvSpec, env: GymEnv, watch: Watch) -> Facts:
    declaration = declaration_of(name)
    limit = _env_steps(spec, env, declaration)
    low, high = _bounds(env)
    drawn = None
    if declaration is not None and declaration.image == RENDER:
        reset(env, 0)
        drawn = rendered(env)
    views = views_of(env.observation_space, declaration, drawn)
    sources = _try_steps(env, views)
    points = [spec.entry_point, *(wrapper.entry_point for wrapper in spec.additional_wrappers)]
    named = [
        registered_as(name).rpartition(":")[0],
        *map(_entry_module, points),
        *functions_of(declaration),
    ]
    modules = list(dict.fromkeys(filter(None, named)))
    files, others = own_files(watch, modules)
    assets = attribute(env, "assets")
    if assets is not None:
        files += declared_files(assets, modules)
    return Facts(
        modules=tuple(modules),
        files=tuple(sorted(set(files))),
        unowned=tuple(map(str, others)),
        image_modules=_image_modules(env, modules, views),
        spec=spec,
        env_steps=limit,
        env_seconds=_env_seconds(env, declaration),
        success_goals=_success_goals(env),
        cost_sources=sources,
        action_low=low.ravel(),
        action_high=high.ravel(),
        views=views,
    )


def require_two(name: str) -> None:
    """Refuse an environment whose instances are not independent: two are stepped side by side.

    Raises:
        TaskError: an episode depends on other episodes, or on another instance.
    """
    _require_two(name, text_of(declaration_of(name)))


@cache
def _require_two(name: str, declared: str) -> None:
    with (
        printing_aside(),
        made(name) as one,
        made(name) as other,
        of_environment(name),
    ):
        require_independent(one, other, FIRST_STEPS)


def registered_as(name: str) -> str:
    """Return the gymnasium id of a task, with its module: its own name, or what is declared."""
    declaration = declaration_of(name)
    return name if declaration is None else declaration.id


def find_spec(name: str, tasks: Iterable[str] = ()) -> EnvSpec:
    """Return the registration of an id; the module before the colon is imported first, and
    registers it.
    """
    go_headless()
    mark()  # what the module starts as it is imported, too
    module, _, gym_id = registered_as(name).rpartition(":")
    before = set(gymnasium.registry)
    if module:
        try:
            import_here(module)
        except WaspError as error:
            raise TaskError(error.message, error.hint) from error
    try:
        return gymnasium.spec(gym_id)
    except gymnasium.error.Error as error:
        # The ids of that module are the ones that can be meant.
        own = [
            known
            for known, spec in gymnasium.registry.items()
            if known not in before or _entry_module(spec.entry_point) == module
        ]
        if module:
            message = f"module '{module}' registers no '{gym_id}'"
            hint = remedy(module, _registering(module, gym_id, own))
            raise UnknownName(
                "gymnasium id", gym_id, (), message=message, otherwise=hint
            ) from error
        known = {*tasks, *gymnasium.registry}
        message = f"no task and no gymnasium id is called '{gym_id}'"
        otherwise = f"write module:{gym_id} for an id that a module of yours registers"
        raise UnknownName(
            "gymnasium id", gym_id, known, message=message, otherwise=otherwise
        ) from error


def _registering(module: str, gym_id: str, own: Sequence[str]) -> str:
    """What to write in the place of an id that `module` does not register; `own` are those that
    it does.
    """
    made = getattr(sys.modules[module], gym_id, None)
    if isinstance(made, type):  # the class stands there, not the id under which it is registered
        for known in own:
            if gymnasium.spec(known).entry_point in (made, f"{module}:{gym_id}"):
                return f"write '{module}:{known}'"
        example = f"gymnasium.register('{gym_id}-v0', entry_point={gym_id}, max_episode_steps=...)"
        return f"write {example} in it, and '{module}:{gym_id}-v0' here"
    example = f"gymnasium.register('{gym_id}', entry_point=..., max_episode_steps=...)"
    # Of few ids all are worth naming; a module without any is told how to register one.
    listed = "known: " + ", ".join(f"'{known}'" for known in own)
    hint = did_you_mean(gym_id, own, listed if own else f"write {example} in it")
    return hint.replace(" '", f" '{module}:") if own else hint


def make_env(name: str, renders: bool = False, draws: bool = False) -> GymEnv:
    """Make one environment without gymnasium's own time limit and checks, which the task
    replaces. Its info tells cost and success as `calls.step` reads them, and it has `snapshot` and
    `restore`.

    Args:
        name: of the task.
        renders: whether its image is looked at; where that is drawn, drawing costs time.
        draws: whether `render()` is called, whatever assistants see.

    Raises:
        TaskError: it cannot be made.
    """
    spec = copy.copy(find_spec(name))
    registered = spec.max_episode_steps
    declaration = declaration_of(name)
    arguments: dict[str, Any] = {}
    if declaration is not None:
        arguments = dict(declaration.make)
        draws |= renders and declaration.image == RENDER
    if draws:
        arguments.setdefault("render_mode", "rgb_array")
    spec.max_episode_steps, spec.order_enforce, spec.disable_env_checker = None, False, True
    try:
        with warnings.catch_warnings():
            # gymnasium says in a warning that a render mode is not among those of the metadata
            warnings.simplefilter("ignore")
            env: GymEnv = gymnasium.make(spec, **arguments)
    except (Exception, SystemExit) as error:  # the code is another's
        raise _not_made(name, spec, error, declaration) from error
    if declaration is not None:
        with of_environment(name):
            env = translated(env, declaration)
    limit = None if declaration is None else declaration.limit
    return with_snapshots(env, env_steps(env, limit or registered) or 0)


def _not_made(
    name: str, spec: EnvSpec, error: BaseException, declaration: Declaration | None
) -> TaskError:
    """Why an environment cannot be made, at the line that may be to blame."""
    message = f"environment '{name}' cannot be made: {described(error)}"
    if declaration is None:
        return TaskError(message)
    if isinstance(error, TypeError) and "render_mode" in str(error):
        hint = "it does not draw itself: leave `image: render` out"
        return DeclarationError("image", message, hint)
    if declaration.make:
        taken = ", ".join(_arguments(spec)) or "no arguments that could be told"
        return DeclarationError("make", message, f"`make` has arguments of it; it takes {taken}")
    return DeclarationError("id", message)


def _arguments(spec: EnvSpec) -> list[str]:
    """The names of the arguments that an environment is made with, as far as they can be told."""
    point = spec.entry_point
    try:
        made = load_env_creator(point) if isinstance(point, str) else point
        parameters = inspect.signature(made).parameters if made is not None else {}
    except (Exception, SystemExit):  # the code is another's
        return []
    return [name for name in parameters if name not in ("self", "args", "kwargs", "render_mode")]


# -- what is looked at -----------------------------------------------------------------------------


def _entry_module(entry_point: Any) -> str:
    return (
        entry_point.partition(":")[0]
        if isinstance(entry_point, str)
        else str(getattr(entry_point, "__module__", ""))
    )


def _env_steps(spec: EnvSpec, env: GymEnv, declaration: Declaration | None) -> int:
    declared = None if declaration is None else declaration.limit
    limit = env_steps(env, declared or spec.max_episode_steps)
    if limit is None:
        raise TaskError(
            "it has no time limit",
            "write `limit: 500` (env steps) into its entry of `tasks`, or register it with one: "
            f"gymnasium.register('{spec.id}', ..., max_episode_steps=500)",
        )
    return limit


def _env_seconds(env: GymEnv, declaration: Declaration | None) -> float:
    if declaration is not None and declaration.seconds is not None:
        return declaration.seconds
    seconds = env_seconds(env)
    if seconds is None:
        hint = (
            "write `seconds: 0.1` into its entry of `tasks`; or metadata = {'render_fps': 10}, "
            "which says that ten env steps are a second: operators with a reaction time need it"
        )
        raise TaskError("it does not say how long an env step is", hint)
    return seconds


def _bounds(env: GymEnv) -> tuple[Floats, Floats]:
    space = env.action_space
    if not isinstance(space, gymnasium.spaces.Box):
        raise TaskError(f"its action space is {space}", _CONTINUOUS)
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    if not (
        space.shape
        and np.prod(space.shape)
        and (np.abs(low) < UNBOUNDED).all()
        and (np.abs(high) < UNBOUNDED).all()
        and (low < high).all()
    ):
        raise TaskError(
            f"its action space is {space}",
            "every action needs a finite lower bound and a finite upper bound above it: register "
            "it with gymnasium.wrappers.RescaleAction or a wrapper of your own",
        )
    return low, high


def _success_goals(env: GymEnv) -> int:
    stated = from_metadata(env, "success_goals")
    goals = 1 if stated is None else as_whole(stated)
    if goals is None or goals < 1:
        raise TaskError(
            f"its metadata['success_goals'] is {stated!r}",
            "the number of goals within the time limit that count as success",
        )
    return goals


def _image_modules(env: GymEnv, modules: Sequence[str], views: Views) -> tuple[str, ...]:
    """Return the modules that `metadata["image_modules"]` names: they only draw the image."""
    stated = from_metadata(env, "image_modules") or ()
    if isinstance(stated, str) or not all(isinstance(module, str) for module in stated):
        raise TaskError(
            f"its metadata['image_modules'] is {stated!r}",
            "a list of modules that only draw the image, as in ['my_env.camera']",
        )
    for module in stated:
        if module in modules:
            raise TaskError(
                f"its metadata['image_modules'] has '{module}', where the environment itself is",
                "move what draws the image into a module of its own, and name that one",
            )
    # Without vectors an expert learns from the image, and needs all of it.
    return tuple(stated) if views.privileged is not None else ()


def _try_steps(env: GymEnv, views: Views) -> tuple[str, ...]:
    """Run the first steps of an episode twice, and see that they are the same.

    Returns:
        The cost sources.
    """
    actions = random_actions(env, FIRST_STEPS)
    first = Episode(env, 0, views).through(actions)
    again = Episode(env, 0, views).through(actions)
    require_same(first, again, AGAIN)
    return tuple(first.steps[0].sources)
