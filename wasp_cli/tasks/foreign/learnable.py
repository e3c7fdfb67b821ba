"""Whether there is anything to learn in a foreign environment: what simple drivers meet in it.

Nothing is trained. Three drivers go through episodes: one commands at random, one holds a random
command for long, one commands the middle of the bounds. Nothing can be learned in an environment
that never costs, always costs, ends at once, always looks the same, or ignores commands.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wasp_cli.tasks.foreign.calls import SUCCESS, GymEnv, of_environment, reset, step
from wasp_cli.tasks.foreign.elsewhere import require_same_elsewhere
from wasp_cli.tasks.foreign.examine import Facts, examine
from wasp_cli.tasks.foreign.make import made
from wasp_cli.tasks.foreign.worlds import (
    Episode,
    difference,
    random_actions,
    require_restored,
    same,
)

STEPS = 1000
"""Env steps that each driver takes, where nothing else is asked for."""
SECONDS_A_STEP = 0.01
"""Time that a driver takes for its env steps on average, before it begins no further episode."""
HELD = 25
"""Env steps for which the holding driver keeps a command."""
COMPARED = 16
"""Env steps of the episodes that are compared."""
SEQUENCE = 32
"""Decisions of a training sequence of the presets `cpu` and larger."""
WORLDS = 4
"""Seeds whose first observations are compared."""


@dataclass
class Driven:
    """What a driver met. Lists have an entry for each episode."""

    driver: str
    steps: int = 0  # env steps
    costly: int = 0  # env steps that cost
    seconds: float = 0.0  # wall time of all steps
    lengths: list[int] = field(default_factory=list)  # env steps
    returns: list[float] = field(default_factory=list)
    rewards: set[float] = field(default_factory=set)  # of single steps; at most a few are kept
    images: set[int] = field(default_factory=set)  # hashes of what was seen; at most a few


@dataclass(frozen=True)
class Findings:
    """What is wrong with an environment, and what you may want to know of it."""

    problems: list[tuple[str, str]]  # message and hint of what keeps assistants from learning
    notes: list[str]  # sentences
    summary: str  # what the drivers met, in a sentence


def findings_of(
    name: str, action_repeat: int, steps: int = STEPS, *, costs: bool = False
) -> Findings:
    """Drive through a foreign environment, and say whether assistants can learn in it.

    Args:
        name: its gymnasium id, with the module before the colon.
        action_repeat: env steps of a decision.
        steps: env steps that each driver takes at most.
        costs: whether it is known that it costs at times.

    Raises:
        TaskError: a call into the environment failed, or its worlds do not follow their seeds.
    """
    facts = examine(name)
    with (
        made(name, renders=True) as one,
        made(name, renders=True) as other,
        of_environment(name),
    ):
        restored = require_restored(one, COMPARED)
        require_same_elsewhere(name, one, COMPARED)
        worlds = _first_observations(one)
        indifferent = _ignores_commands(one, other)
        drivers = _drivers(one, steps)
        driven = [_driven(label, one, steps, drivers[label], facts) for label in drivers]
        info = _told(one)
    sight = "image" if facts.views.cameras else "vector"
    problems = _problems(driven, indifferent, action_repeat, sight, costs)
    notes = list(_notes(driven, facts, info, worlds, restored, action_repeat))
    return Findings(problems, notes, _summary(driven))


def _drivers(env: GymEnv, steps: int) -> dict[str, Callable[[int], NDArray[Any]]]:
    """How each driver chooses the command of an env step from its number, by the driver's name."""
    random_commands = random_actions(env, steps, seed=3)
    held_commands = random_actions(env, steps // HELD + 1, seed=4)
    space = env.action_space
    centre = (space.low + space.high) / 2  # type: ignore[attr-defined]
    middle_command: NDArray[Any] = centre.astype(space.dtype)

    def random(number: int) -> NDArray[Any]:
        return random_commands[number]

    def held(number: int) -> NDArray[Any]:
        return held_commands[number // HELD]

    def middle(number: int) -> NDArray[Any]:
        return middle_command

    return {"random": random, "held": held, "middle": middle}


def _driven(
    driver: str, env: GymEnv, steps: int, command: Callable[[int], NDArray[Any]], facts: Facts
) -> Driven:
    """What a driver meets in episodes of the seeds 1, 2, ..., until its steps or its time are used
    up.
    """
    result = Driven(driver)
    begun = time.perf_counter()
    seed = 0
    while result.steps < steps and time.perf_counter() - begun < SECONDS_A_STEP * steps:
        seed += 1
        _episode(env, seed, steps, command, facts, result)
    result.seconds = time.perf_counter() - begun
    return result


def _episode(
    env: GymEnv,
    seed: int,
    steps: int,
    command: Callable[[int], NDArray[Any]],
    facts: Facts,
    result: Driven,
) -> None:
    """Go through an episode, or through its beginning where the driver's steps are used up."""
    reset(env, seed)
    length = 0
    total = 0.0
    while length < facts.env_steps and result.steps < steps:
        done = step(env, command(result.steps).copy())
        result.steps += 1
        length += 1
        total += done.reward
        result.costly += done.cost > 0
        if len(result.rewards) < 3:
            result.rewards.add(done.reward)
        if len(result.images) < 3:
            result.images.add(hash(_sight(done.seen, env, facts).tobytes()))
        if done.terminated or done.truncated or length == facts.env_steps:
            result.lengths.append(length)
            result.returns.append(total)
            return


def _sight(seen: Any, env: GymEnv, facts: Facts) -> NDArray[Any]:
    """What an assistant sees: the images, or where there are none the vector."""
    views = facts.views
    if views.front is None and views.state is not None:
        return views.vector(seen, views.state)
    return views.pixels(seen, env)


def _first_observations(env: GymEnv) -> int:
    """How many of a few seeds begin differently."""
    firsts = [Episode(env, seed).first for seed in range(WORLDS)]
    different: list[Any] = []
    for first in firsts:
        if not any(same(first, earlier) for earlier in different):
            different.append(first)
    return len(different)


def _ignores_commands(one: GymEnv, other: GymEnv) -> bool:
    """Whether an episode goes on in the same way whatever is commanded."""
    left = Episode(one, 0).through(random_actions(one, COMPARED, seed=5))
    right = Episode(other, 0).through(random_actions(other, COMPARED, seed=6))
    return difference(left, right) is None


def _told(env: GymEnv) -> frozenset[str]:
    """The entries of `info` after a step."""
    reset(env, 0)
    (action,) = random_actions(env, 1)
    *_, info = env.step(action)
    return frozenset(map(str, info))


def _problems(
    driven: list[Driven], indifferent: bool, action_repeat: int, sight: str, costs: bool
) -> list[tuple[str, str]]:
    """What keeps assistants from learning: message and hint of each.

    `sight`: what assistants see; `costs`: whether it is known that it costs at times.
    """
    steps = sum(each.steps for each in driven)
    costly = sum(each.costly for each in driven)
    lengths = _lengths(driven)
    images = set().union(*(each.images for each in driven))
    who = f"{steps} env steps of random, held and middle commands"
    problems: list[tuple[str, str]] = []
    if costly == 0 and not costs:
        message = f"it never costs: not once in {who}"
        hint = (
            "info['cost'] is above 0 in every env step in which something goes wrong; if only "
            "longer driving comes that far, look longer: wasp check --steps 20000"
        )
        problems.append((message, hint))
    if costly == steps:
        message = f"it always costs: in each of {who}"
        hint = (
            "info['cost'] is 0 where nothing goes wrong; a cost that is always paid teaches an "
            "expert nothing"
        )
        problems.append((message, hint))
    if lengths and max(lengths) <= action_repeat:
        message = (
            f"its episodes end at once: after at most {max(lengths)} env steps, and a decision has "
            f"{action_repeat}"
        )
        problems.append((message, "look at what ends an episode, or lower action_repeat"))
    if len(images) == 1:
        message = f"its {sight} is the same in {who}"
        hint = f"show the state that step leads to: the {sight} is all that an assistant sees"
        problems.append((message, hint))
    if indifferent:
        message = "its episodes are the same whatever is commanded"
        problems.append((message, "use the action that step gets"))
    return problems


def _lengths(driven: list[Driven]) -> list[int]:
    """The env steps of all episodes of all drivers."""
    lengths: list[int] = []
    for each in driven:
        lengths += each.lengths
    return lengths


def _notes(
    driven: list[Driven],
    facts: Facts,
    info: frozenset[str],
    worlds: int,
    restored: bool,
    action_repeat: int,
) -> list[str]:
    """What else you may want to know, in sentences."""
    notes = []
    rewards = set().union(*(each.rewards for each in driven))
    lengths = _lengths(driven)
    if len(rewards) == 1:
        notes.append(f"Its reward is {rewards.pop():g} in every step that was taken.")
    if lengths and max(lengths) < SEQUENCE * action_repeat:
        notes.append(
            f"Its longest episode has {-(-max(lengths) // action_repeat)} decisions, and a "
            f"training sequence has {SEQUENCE}: lower action_repeat, now {action_repeat}."
        )
    if info.isdisjoint({"goals", *SUCCESS}):
        others = ", ".join(sorted(info)) or "nothing"
        notes.append(
            "Its info has no success (goals, success or is_success), so that the success "
            f"rate stays 0 %. It has: {others}."
        )
    if worlds == 1:
        notes.append(f"Its first observation is the same for {WORLDS} seeds.")
    if not restored:
        notes.append(
            "It has no snapshot and restore: to judge an intervention (UIR), its episode is played "
            "again from its seed, up to that step."
        )
    if facts.unowned:
        files = ", ".join(facts.unowned[:3])
        notes.append(
            f"It reads files outside of its module's folder, which no key covers: {files}. Name "
            "them in its attribute `assets`."
        )
    return notes


def _summary(driven: list[Driven]) -> str:
    """What the drivers met, in a sentence."""
    parts = []
    for each in driven:
        share = each.costly / each.steps
        mean = f"{np.mean(each.returns):.3g}" if each.returns else "unknown"
        parts.append(f"{each.driver} return {mean}, cost in {share:.1%} of env steps")
    steps = sum(each.steps for each in driven)
    milliseconds = 1000 * sum(each.seconds for each in driven) / steps
    return f"{steps} env steps, {milliseconds:.2g} ms each: {'; '.join(parts)}"
