"""What a foreign environment says of itself: it is made and stepped when a spec is read."""

from __future__ import annotations

from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass
from functools import cache

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec

from wasp_cli.errors import TaskError, UnknownName
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
from wasp_cli.tasks.foreign.layers import as_whole, attribute, env_seconds, env_steps, from_metadata
from wasp_cli.tasks.foreign.lookup import entry_module, registered_as, registration_of
from wasp_cli.tasks.foreign.make import made
from wasp_cli.tasks.foreign.registration import registration_text
from wasp_cli.tasks.foreign.surroundings import printing_aside
from wasp_cli.tasks.foreign.translated import functions_of
from wasp_cli.tasks.foreign.views import Views, rendered, views_of
from wasp_cli.tasks.foreign.worlds import (
    AGAIN,
    Episode,
    random_actions,
    require_independent,
    require_same,
)

UNBOUNDED = 1e30
"""An action whose bound is at least this large, such as the largest float32, has no bound."""
_CONTINUOUS = (
    "an operator's commands are continuous: a Box with finite bounds. Some environments have such "
    "actions as an option, as in `make: {continuous: true}`; else map a Box onto its actions in a "
    "wrapper that your module registers with it"
)
FIRST_STEPS = 3
"""Env steps of the episodes that are compared whenever a spec is read."""


@dataclass(frozen=True)
class Facts:
    """What is known of an environment. A = action size."""

    modules: tuple[str, ...]  # where its code begins
    # the data files that it opens, by name (`tasks.foreign.assets`), and those that it declares
    files: tuple[str, ...]
    unowned: tuple[str, ...]  # paths of other files that it opened, which no key covers
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
        """Return how it is registered, as text for keys: the options that it is made with decide
        results. Wrappers of the modules `without` are left out.
        """
        return registration_text(self.spec, without)


def examine(name: str, tasks: Iterable[str] = ()) -> Facts:
    """Return what an environment says of itself. It is made and stepped for that, once per process.

    Args:
        name: of the task: `module:Id-v0`, a registered id, or a declared name.
        tasks: further names that are suggested where there is no such id.

    Raises:
        UnknownName: no such id is registered.
        TaskError: it cannot be made, or is none of which a task can be made; a DeclarationError
            where a line of its declaration is wrong.
    """
    # What modules and environments print as they start must not get between the lines of a plan
    # that is JSON.
    with printing_aside():
        key = (name, text_of(declaration_of(name)))
        if key not in _known:
            _known[key] = _examined(name, tasks)
        return _known[key]


_known: dict[tuple[str, str], Facts] = {}
"""The environments that were examined in this process, by name and declaration."""


def _examined(name: str, tasks: Iterable[str]) -> Facts:
    with watched() as watch:  # its module may read files when it is imported, here
        try:
            spec = registration_of(name, tasks)
        except UnknownName as error:
            if declaration_of(name) is None:
                raise
            raise DeclarationError("id", error.message, error.hint) from error
        with of_environment(name):
            registration_text(spec)  # raises now, if no key could tell it from another one
        with made(name, renders=True) as env, of_environment(name):
            return _facts_of(name, spec, env, watch)


def _facts_of(name: str, spec: EnvSpec, env: GymEnv, watch: Watch) -> Facts:
    # What a batch of it is like.
    declaration = declaration_of(name)
    limit = _env_steps(spec, env, declaration)
    low, high = _bounds(env)
    picture = None
    if declaration is not None and declaration.image == RENDER:
        reset(env, 0)
        picture = rendered(env)
    views = views_of(env.observation_space, declaration, picture)
    sources = _try_steps(env, views)

    # Its code and its data files, which keys cover.
    points = [spec.entry_point, *(wrapper.entry_point for wrapper in spec.additional_wrappers)]
    named = [
        registered_as(name).rpartition(":")[0],
        *map(entry_module, points),
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
    """Check that instances of an environment are independent: two are stepped side by side.

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


def _env_steps(spec: EnvSpec, env: GymEnv, declaration: Declaration | None) -> int:
    """The time limit in env steps, as it is declared, registered, or set by a wrapper."""
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
    """The time of an env step in seconds."""
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
    """The bounds of actions, of the space's shape."""
    space = env.action_space
    if not isinstance(space, gymnasium.spaces.Box):
        raise TaskError(f"its action space is {space}", _CONTINUOUS)
    low = space.low.astype(np.float64)
    high = space.high.astype(np.float64)
    is_empty = not space.shape or not np.prod(space.shape)
    is_bounded = (np.abs(low) < UNBOUNDED).all() and (np.abs(high) < UNBOUNDED).all()
    if is_empty or not is_bounded or not (low < high).all():
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
    """Return the cost sources, after the first steps of an episode were taken twice and were the
    same.
    """
    actions = random_actions(env, FIRST_STEPS)
    first = Episode(env, 0, views).through(actions)
    second = Episode(env, 0, views).through(actions)
    require_same(first, second, AGAIN)
    return tuple(first.steps[0].sources)
