"""What simple drivers meet in a foreign environment: lengths, returns and costs of episodes, the
time of a step, what assistants will see, and whether a cost is seen before it comes. Nothing is
trained but a linear probe.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
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
HELD_SECONDS = 3.0  # for which the holding driver keeps a command
AHEAD_SECONDS = 1.0  # within which a cost is to be seen
DECISIONS = (100, 200, 300)  # of an episode: fewest, wished for, most
DECISION_SECONDS = (0.1, 0.4)  # of a decision, if the time of an env step allows it
MOST_EPISODES = 40
MOST_SAMPLES = 2000
QUIET_STRIDE = 3
"""Of the moments before no cost each third is a sample: they are many, and neighbours are alike."""
FRAMES = 8  # of the sheet


@dataclass
class Met:
    """What a driver met; lists have an entry for each finished episode."""

    driver: str
    steps: int = 0  # env steps
    costly: int = 0  # env steps that cost
    sources: dict[str, int] = field(default_factory=dict)  # the same by cost source
    lengths: list[int] = field(default_factory=list)  # env steps
    returns: list[float] = field(default_factory=list)

    @property
    def cost_per_1000(self) -> float:
        """Costly env steps of 1000."""
        return 1000.0 * self.costly / max(self.steps, 1)


@dataclass(frozen=True)
class Frame:
    """What an assistant sees at one moment, for the sheet."""

    pixels: Pixels  # [3 or 6, 64, 64]
    env_step: int
    costs: bool  # in this decision


@dataclass(frozen=True)
class Trial:
    """All that was found out of an environment."""

    name: str
    cameras: int
    state_size: int
    env_seconds: float  # simulated time of an env step
    limit: int  # env steps
    action_repeat: int  # suggested
    step_seconds: float  # wall time of an env step with the image that assistants see
    bare_seconds: float  # the same where nobody looks at an image
    met: tuple[Met, ...]
    sight: Sight
    frames: tuple[Frame, ...]
    findings: Findings

    @property
    def render_share(self) -> float:
        """The share of a step that the image takes."""
        return max(0.0, 1.0 - self.bare_seconds / self.step_seconds)

    @property
    def typical_length(self) -> float:
        """Env steps of an episode of the driver that lasts longest."""
        means = [float(np.mean(met.lengths)) for met in self.met if met.lengths]
        return max(means, default=float(self.limit))


def tried(name: str, seconds: float = 60.0, action_repeat: int | None = None) -> Trial:
    """Try an environment for about so many seconds.

    Args:
        name: of the task; it has to be declared, where it is not a gymnasium id alone.
        seconds: wall time, most of which the drivers get.
        action_repeat: env steps of a decision; None: as is suggested.

    Raises:
        TaskError: it does not work, or its worlds do not follow their seeds.
    """
    with printing_aside():
        facts = examine(name)
        met = tuple(_met(name, driver, 0.3 * seconds / len(DRIVERS)) for driver in DRIVERS)
        lengths = [float(np.mean(each.lengths)) for each in met if each.lengths]
        typical = max(lengths, default=float(facts.env_steps))
        repeat = action_repeat or suggested_repeat(facts.env_seconds, facts.env_steps, typical)
        bare, whole = _step_seconds(name, 0.1 * seconds)
        sight, frames = _looked(name, repeat, 0.5 * seconds)
        steps = int(np.clip(0.1 * seconds / (3 * whole), 50, 1000))
        costs = any(each.costly for each in met)
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
        met=met,
        sight=sight,
        frames=frames,
        findings=findings,
    )


def suggested_repeat(env_seconds: float, limit: int, typical: float) -> int:
    """Return env steps of a decision, so that an episode up to its limit has about 200 of them and
    each takes .1 to .4 s, as in the built-in tasks; but no more than leave an episode of typical
    length the decisions of a training sequence.
    """
    fewest = max(1, round(DECISION_SECONDS[0] / env_seconds))
    most = max(1, int(DECISION_SECONDS[1] / env_seconds + 1e-9))
    wished = min(max(round(limit / DECISIONS[1]), fewest), most)
    return max(1, min(wished, int(typical) // SEQUENCE))


def suggested_limit(limit: int, action_repeat: int) -> int:
    """Return the time limit in env steps after which an episode has 300 decisions at most."""
    return min(limit, DECISIONS[2] * action_repeat)


def _driver(kind: str, task: GymTask, seed: int) -> Driver:
    """The driver of one episode."""
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


def _met(name: str, kind: str, seconds: float) -> Met:
    """Drive episodes that nobody looks at, until the time is over."""
    met = Met(kind)
    task = GymTask(name, 1, action_repeat=1, observe=())
    end = time.perf_counter() + seconds
    seed = 0
    while time.perf_counter() < end and len(met.lengths) < MOST_EPISODES:
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
            met.costly += int(step.cost_env[0])
            for source, counts in step.sources.items():
                met.sources[source] = met.sources.get(source, 0) + int(counts[0])
            is_over = bool(step.ended[0])
        met.steps += length
        if is_over:
            met.lengths.append(length)
            met.returns.append(total)
    task.close()
    return met


def _step_seconds(name: str, seconds: float) -> tuple[float, float]:
    """Return the wall time of an env step without and with what assistants see; both take turns."""
    tasks = [
        GymTask(name, 1, action_repeat=1, observe=observe)
        for observe in ((), ("pixels", "state", "privileged"))
    ]
    spent: list[list[float]] = [[], []]
    ends = [True, True]
    drivers = [_driver("random", task, 0) for task in tasks]
    over = time.perf_counter() + seconds
    while time.perf_counter() < over or not all(spent):
        for place, task in enumerate(tasks):
            if ends[place]:
                task.reset([0])
            begun = time.perf_counter()
            ends[place] = bool(task.step(drivers[place](0)).ended[0])
            spent[place].append(time.perf_counter() - begun)
    for task in tasks:
        task.close()
    bare, whole = (float(np.mean(times)) for times in spent)
    return bare, whole


@dataclass(frozen=True)
class _Watched:
    """An episode as an assistant sees it; lists have an entry for each decision."""

    seen: list[NDArray[Any]]  # before the decision
    frames: list[Frame]
    costs: list[bool]
    is_over: bool


def _looked(name: str, action_repeat: int, seconds: float) -> tuple[Sight, tuple[Frame, ...]]:
    """Drive episodes and look on; return whether costs were seen, and frames through an episode:
    one with a cost, if there is any, and the longest of those.
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
    seed = 1000  # other worlds than those of `_met`
    while time.perf_counter() < end:
        driver = _driver(("held", "held", "random")[seed % 3], task, seed)
        observation = task.reset([seed])
        watched = _Watched([], [], [], False)
        is_over = False
        while not is_over and time.perf_counter() < end:
            number = len(watched.costs)
            watched.seen.append(_sight_in(observation, cameras))
            step = task.step(driver(number))
            costs = bool(step.cost[0])
            if cameras and observation.pixels is not None:
                pixels = observation.pixels[0, : 3 * cameras]
                watched.frames.append(Frame(pixels, number * task.action_repeat, costs))
            watched.costs.append(costs)
            observation = step.observation
            is_over = bool(step.ended[0])
        yield _Watched(watched.seen, watched.frames, watched.costs, is_over)
        seed += 1


def _sight_in(observation: Observation, cameras: int) -> NDArray[Any]:
    """What an assistant sees, flat: bytes of the images, or numbers of the vector."""
    if cameras and observation.pixels is not None:
        images: NDArray[Any] = observation.pixels[0, : 3 * cameras].ravel()
        return images
    assert observation.state is not None
    vector: NDArray[Any] = observation.state[0].astype(np.float32)
    return vector


def _samples(watched: _Watched, ahead: int) -> Iterator[tuple[int, bool]]:
    """Yield decisions at which nothing costs yet, and whether a cost follows within `ahead` of
    them. Where an episode was cut by the clock, its last ones are not known.
    """
    known = len(watched.costs) if watched.is_over else len(watched.costs) - ahead
    for moment in range(1, known):
        follows = any(watched.costs[moment : moment + ahead])
        if not watched.costs[moment - 1] and (follows or moment % QUIET_STRIDE == 0):
            yield moment, follows


def _worth(watched: _Watched) -> tuple[bool, int]:
    return any(watched.costs), len(watched.costs)


def _spread(frames: list[Frame]) -> list[Frame]:
    """Frames from the first to the last of an episode, and the first that costs among them."""
    if len(frames) <= FRAMES:
        return frames
    chosen = set(np.linspace(0, len(frames) - 1, FRAMES).round().astype(int).tolist())
    first = next((place for place, frame in enumerate(frames) if frame.costs), None)
    if first is not None and first not in chosen:
        nearest = min(chosen - {0, len(frames) - 1}, key=lambda place: abs(place - first))
        chosen = (chosen - {nearest}) | {first}
    return [frames[place] for place in sorted(chosen)]
