"""A trial of a foreign environment with simple drivers: lengths, returns and costs of episodes, the
time of a step, what assistants will see, and whether a cost can be seen before it comes. Only a
linear probe is trained.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wasp_cli.learning.seeing import Sight, sight_of
from wasp_cli.tasks.base import Observation, Pixels
from wasp_cli.tasks.foreign.examine import examine
from wasp_cli.tasks.foreign.learnable import SEQUENCE, Findings, findings_of
from wasp_cli.tasks.foreign.surroundings import printing_aside
from wasp_cli.tasks.foreign.task import GymTask

Driver = Callable[[int], NDArray[np.float64]]
"""From the number of a decision in its episode to a command [1, A] in [-1, 1]."""
DRIVERS = ("zero", "random", "held")
HELD_SECONDS = 3.0  # for which the driver `held` keeps a command
AHEAD_SECONDS = 1.0  # a cost should be seen so long before it comes
DECISIONS = 200  # of an episode, if possible
MOST_DECISIONS = 300  # of an episode
DECISION_SECONDS = (0.1, 0.4)  # shortest and longest decision, if the time of an env step allows it
MOST_EPISODES = 40  # of a driver
MOST_SAMPLES = 2000  # of the probe
CALM_STRIDE = 3
"""Every third moment without a cost ahead is a sample: they are many, and neighbours are alike."""
FRAMES = 8  # of the sheet
SHARE_OF_DRIVERS = 0.3  # of the time of a trial
SHARE_OF_STEPS = 0.1  # of it, for the time of a step
SHARE_OF_PROBE = 0.5  # of it, for what can be seen
SHARE_OF_FINDINGS = 0.1  # of it, about


@dataclass
class Drives:
    """The episodes of one driver; lists have an entry for each finished episode."""

    driver: str
    steps: int = 0  # env steps
    costly: int = 0  # env steps that cost
    sources: dict[str, int] = field(default_factory=dict)  # the same by cost source
    lengths: list[int] = field(default_factory=list)  # env steps
    returns: list[float] = field(default_factory=list)

    @property
    def cost_per_1000(self) -> float:
        """Costly env steps per 1000 env steps."""
        return 1000.0 * self.costly / max(self.steps, 1)


@dataclass(frozen=True)
class Frame:
    """What an assistant sees at one moment, for the sheet."""

    pixels: Pixels  # [3 or 6, 64, 64]
    env_step: int
    costs: bool  # in this decision


@dataclass(frozen=True)
class Trial:
    """What a trial of an environment found."""

    name: str
    cameras: int
    state_size: int
    env_seconds: float  # simulated time of an env step
    limit: int  # env steps
    action_repeat: int  # suggested
    step_seconds: float  # wall time of an env step with what assistants see
    bare_seconds: float  # wall time of an env step without it
    drives: tuple[Drives, ...]
    sight: Sight
    frames: tuple[Frame, ...]
    findings: Findings

    @property
    def render_share(self) -> float:
        """The share of the wall time of a step that what assistants see takes."""
        return max(0.0, 1.0 - self.bare_seconds / self.step_seconds)

    @property
    def typical_length(self) -> float:
        """Env steps of an episode of the driver whose episodes are longest."""
        return _typical_length(self.drives, self.limit)


def try_environment(name: str, seconds: float = 60.0, action_repeat: int | None = None) -> Trial:
    """Try an environment.

    Args:
        name: of the task. It has to be declared where it is not a gymnasium id alone.
        seconds: wall time of the trial, about.
        action_repeat: env steps of a decision; None takes what is suggested.

    Raises:
        TaskError: it does not work, or its worlds do not follow their seeds.
    """
    with printing_aside():
        # -- the drivers, one after the other
        facts = examine(name)
        of_driver = SHARE_OF_DRIVERS * seconds / len(DRIVERS)
        drives = tuple(_drive(name, driver, of_driver) for driver in DRIVERS)

        # -- the length of a decision and the time of a step
        typical = _typical_length(drives, facts.env_steps)
        repeat = action_repeat or suggested_repeat(facts.env_seconds, facts.env_steps, typical)
        bare, whole = _step_seconds(name, SHARE_OF_STEPS * seconds)

        # -- what can be seen, and what speaks against training
        sight, frames = _looked(name, repeat, SHARE_OF_PROBE * seconds)
        steps = int(np.clip(SHARE_OF_FINDINGS * seconds / (3 * whole), 50, 1000))
        costs = any(each.costly for each in drives)
        findings = findings_of(name, repeat, steps, costs=costs)
    return Trial(
        name=name,
        cameras=facts.views.cameras,
        state_size=facts.views.state_size,
        env_seconds=facts.env_seconds,
        limit=facts.env_steps,
        action_repeat=repeat,
        step_seconds=whole,
        bare_seconds=min(bare, whole),
        drives=drives,
        sight=sight,
        frames=frames,
        findings=findings,
    )


def suggested_repeat(env_seconds: float, limit: int, typical: float) -> int:
    """Return the env steps of a decision.

    An episode up to its limit should have about `DECISIONS` decisions of .1 to .4 s, as in the
    built-in tasks. An episode of typical length should have at least the decisions of a training
    sequence.

    Args:
        env_seconds: simulated time of an env step.
        limit: time limit of an episode in env steps.
        typical: length of a typical episode in env steps.
    """
    shortest, longest = DECISION_SECONDS
    fewest = max(1, round(shortest / env_seconds))
    most = max(1, int(longest / env_seconds + 1e-9))
    repeat = min(max(round(limit / DECISIONS), fewest), most)
    return max(1, min(repeat, int(typical) // SEQUENCE))


def suggested_limit(limit: int, action_repeat: int) -> int:
    """Return a time limit in env steps with which an episode has `MOST_DECISIONS` at most."""
    return min(limit, MOST_DECISIONS * action_repeat)


def _typical_length(drives: Sequence[Drives], limit: int) -> float:
    """Return the env steps of an episode of the driver whose episodes are longest; the time limit
    where no driver finished one.
    """
    means = [float(np.mean(each.lengths)) for each in drives if each.lengths]
    return max(means, default=float(limit))


def _driver(kind: str, task: GymTask, seed: int) -> Driver:
    """Return the driver of one episode."""
    draws = np.random.default_rng(seed)
    held = max(1, round(HELD_SECONDS / task.decision_seconds))
    shape = (1, task.action_size)
    command = np.zeros(shape)

    def driven(number: int) -> NDArray[np.float64]:
        nonlocal command
        if kind == "random" or (kind == "held" and number % held == 0):
            command = draws.uniform(-1.0, 1.0, shape)
        return command

    return driven


def _drive(name: str, kind: str, seconds: float) -> Drives:
    """Drive episodes without observations, until the time is over."""
    drives = Drives(kind)
    task = GymTask(name, 1, action_repeat=1, observe=())
    end = time.perf_counter() + seconds
    seed = 0
    while time.perf_counter() < end and len(drives.lengths) < MOST_EPISODES:
        driver = _driver(kind, task, seed)
        length = 0
        total = 0.0
        is_over = False
        task.reset([seed])
        seed += 1
        while not is_over and time.perf_counter() < end:
            step = task.step(driver(length))
            length += 1
            total += float(step.reward[0])
            drives.costly += int(step.cost_env[0])
            for source, counts in step.sources.items():
                drives.sources[source] = drives.sources.get(source, 0) + int(counts[0])
            is_over = bool(step.ended[0])
        drives.steps += length
        if is_over:
            drives.lengths.append(length)
            drives.returns.append(total)
    task.close()
    return drives


def _step_seconds(name: str, seconds: float) -> tuple[float, float]:
    """Return the mean wall time of an env step without and with what assistants see. Steps of both
    sorts take turns.
    """
    bare = _Stopwatch(GymTask(name, 1, action_repeat=1, observe=()))
    whole = _Stopwatch(GymTask(name, 1, action_repeat=1, observe=("pixels", "state", "privileged")))
    end = time.perf_counter() + seconds
    while time.perf_counter() < end or not bare.times or not whole.times:
        bare.step()
        whole.step()
    bare.task.close()
    whole.task.close()
    return float(np.mean(bare.times)), float(np.mean(whole.times))


class _Stopwatch:
    """Measures the env steps of a task under random commands."""

    def __init__(self, task: GymTask) -> None:
        self.task = task
        self.times: list[float] = []  # seconds of each step
        self._driver = _driver("random", task, 0)
        self._ended = True

    def step(self) -> None:
        """Make and measure one env step."""
        if self._ended:
            self.task.reset([0])
        begin = time.perf_counter()
        self._ended = bool(self.task.step(self._driver(0)).ended[0])
        self.times.append(time.perf_counter() - begin)


@dataclass(frozen=True)
class _Watched:
    """An episode as an assistant sees it; lists have an entry for each decision."""

    seen: list[NDArray[Any]]  # before the decision, flat
    frames: list[Frame]
    costs: list[bool]
    is_over: bool


def _looked(name: str, action_repeat: int, seconds: float) -> tuple[Sight, tuple[Frame, ...]]:
    """Drive episodes with what assistants see.

    Returns:
        Whether costs can be seen, and frames of one episode: the longest of those with a cost, or
        where there is none of all.
    """
    task = GymTask(name, 1, action_repeat=action_repeat, observe=("pixels", "state"))
    ahead = max(1, round(AHEAD_SECONDS / task.decision_seconds))
    seen: list[NDArray[Any]] = []
    follows: list[bool] = []
    numbers: list[int] = []
    best: _Watched | None = None
    for number, watched in enumerate(_episodes(task, seconds)):
        for moment, follow in _samples(watched, ahead):
            seen.append(np.concatenate([watched.seen[moment], watched.seen[moment - 1]]))
            follows.append(follow)
            numbers.append(number)
        if best is None or _worth(watched) > _worth(best):
            best = watched
        if len(seen) >= MOST_SAMPLES:
            break
    task.close()
    sight = Sight(len(seen), sum(follows), None, None, None)
    if seen:
        sight = sight_of(np.stack(seen), np.array(follows), np.array(numbers))
    return sight, tuple(_spread(best.frames if best is not None else []))


def _episodes(task: GymTask, seconds: float) -> Iterator[_Watched]:
    """Yield episodes of the drivers in turn, until the time is over."""
    cameras = task.cameras
    end = time.perf_counter() + seconds
    seed = 1000  # other worlds than those of `_drive`
    while time.perf_counter() < end:
        driver = _driver(("held", "held", "random")[seed % 3], task, seed)
        observation = task.reset([seed])
        seen: list[NDArray[Any]] = []
        frames: list[Frame] = []
        costs: list[bool] = []
        is_over = False
        while not is_over and time.perf_counter() < end:
            number = len(costs)
            seen.append(_sight_in(observation, cameras))
            step = task.step(driver(number))
            is_costly = bool(step.cost[0])
            if cameras and observation.pixels is not None:
                pixels = observation.pixels[0, : 3 * cameras]
                frames.append(Frame(pixels, number * task.action_repeat, is_costly))
            costs.append(is_costly)
            observation = step.observation
            is_over = bool(step.ended[0])
        yield _Watched(seen, frames, costs, is_over)
        seed += 1


def _sight_in(observation: Observation, cameras: int) -> NDArray[Any]:
    """Return what an assistant sees, flat: bytes of the images, or numbers of the vector."""
    if cameras and observation.pixels is not None:
        images: NDArray[Any] = observation.pixels[0, : 3 * cameras].ravel()
        return images
    assert observation.state is not None
    vector: NDArray[Any] = observation.state[0].astype(np.float32)
    return vector


def _samples(watched: _Watched, ahead: int) -> Iterator[tuple[int, bool]]:
    """Yield decisions before which nothing costs, and whether one of the next `ahead` decisions
    costs. What follows the last decisions of an episode that ran out of time is not known, so they
    are left out.
    """
    end = len(watched.costs)
    if not watched.is_over:
        end -= ahead
    for moment in range(1, end):
        follows = any(watched.costs[moment : moment + ahead])
        if not watched.costs[moment - 1] and (follows or moment % CALM_STRIDE == 0):
            yield moment, follows


def _worth(watched: _Watched) -> tuple[bool, int]:
    """Return how good an episode is for the sheet, as a value that can be compared."""
    return any(watched.costs), len(watched.costs)


def _spread(frames: list[Frame]) -> list[Frame]:
    """Return `FRAMES` frames spread over an episode, with its first and last, and the first that
    costs.
    """
    if len(frames) <= FRAMES:
        return frames
    last = len(frames) - 1
    chosen = set(np.linspace(0, last, FRAMES).round().astype(int).tolist())
    costly = [place for place, frame in enumerate(frames) if frame.costs]
    if costly and costly[0] not in chosen:
        inner = chosen - {0, last}
        nearest = min(inner, key=lambda place: abs(place - costly[0]))
        chosen.remove(nearest)
        chosen.add(costly[0])
    return [frames[place] for place in sorted(chosen)]
