"""Which severity impairs an operator by a stated amount: it drives without assistance at a few
severities, from the mildest on, in the same held-out worlds as random commands and as the
unimpaired expert. The rule is in `metrics.severity`.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from wasp_cli.learning.closed_loop import batches, run_episodes
from wasp_cli.learning.evaluation import trajectories
from wasp_cli.learning.privileged import evaluate_random
from wasp_cli.methods.base import Parts
from wasp_cli.methods.human import HumanOnly
from wasp_cli.metrics.severity import FILE, Choice, choose, nearest, share_kept
from wasp_cli.operators.base import EpisodeNoise, OperatorContext, Policy, build_operator
from wasp_cli.seeds import derive
from wasp_cli.tasks.make import make_task

REFERENCES_FILE = "references.json"
DRIVEN_FILE = "driven.json"  # in the work folder: what an interrupted search has driven
SIDE_BY_SIDE = 10  # worlds of one batch at most
DIGITS = 3  # of a chosen severity, where every number is one


@dataclass(frozen=True)
class Driven:
    """Episodes in the held-out worlds, in their order."""

    returns: tuple[float, ...]
    costs: tuple[float, ...]  # env steps that cost

    @property
    def mean_return(self) -> float:
        """The return of an episode."""
        return sum(self.returns) / len(self.returns)

    @property
    def mean_cost(self) -> float:
        """The cost of an episode."""
        return sum(self.costs) / len(self.costs)


@dataclass(frozen=True)
class References:
    """What an operator is held against in the same worlds."""

    random: Driven
    expert: Driven

    def share(self, driven: Driven) -> float:
        """Return which share of the way from random commands to the expert is kept; NaN where there
        is no way.
        """
        returns = self.random.mean_return, self.expert.mean_return
        return share_kept(driven.mean_return, *returns)

    @property
    def way(self) -> bool:
        """Whether the expert returns more than random commands."""
        return not math.isnan(self.share(self.expert))


@dataclass(frozen=True)
class Ladder:
    """The severities that are tried, and what lies between them."""

    tried: tuple[float, ...]  # from the mildest to the worst, at least one
    harmless: float | None = None
    """One that is milder than all of these, at which the operator is the expert."""
    step: float | None = 0.0
    """0: every number is a severity; another number: its multiples are; None: those tried alone."""

    def choose(self, shares: Sequence[float], kept: float) -> Choice:
        """Return the severity at which `kept` is kept, as a severity can be.

        Args:
            shares: of the first so many that were tried.
        """
        severities = list(self.tried[: len(shares)])
        if self.step is None:
            return nearest(severities, shares, kept)
        if self.harmless is not None:
            severities.insert(0, self.harmless)
            shares = [1.0, *shares]
        found = choose(severities, shares, kept)
        if found.severity in self.tried:
            return found
        if self.step == 0.0:
            return Choice(float(f"{found.severity:.{DIGITS}g}"), found.within)
        return Choice(round(found.severity / self.step) * self.step, found.within)


@dataclass(frozen=True)
class Found:
    """How a search ended."""

    choice: Choice
    points: dict[float, Driven]  # by severity, in the order in which they were driven
    decided: bool  # whether there was a way between random commands and the expert to measure on


def search(
    ladder: Ladder, kept: float, references: References, drive: Callable[[float], Driven]
) -> Found:
    """Drive from the mildest severity on until one keeps no more than `kept`, choose, and drive
    what was chosen.

    Where the expert returns no more than random commands, nothing can be measured: the middle one
    of the severities is taken.
    """
    if not references.way:
        middle = ladder.tried[(len(ladder.tried) - 1) // 2]
        return Found(Choice(middle, within=False), {middle: drive(middle)}, decided=False)
    points: dict[float, Driven] = {}
    shares: list[float] = []
    for severity in ladder.tried:
        points[severity] = drive(severity)
        shares.append(references.share(points[severity]))
        if shares[-1] <= kept:
            break
    choice = ladder.choose(shares, kept)
    if choice.severity not in points:
        points[choice.severity] = drive(choice.severity)
    return Found(choice, points, decided=True)


@dataclass(frozen=True)
class Worlds:
    """The held-out worlds of a training, which no evaluation uses."""

    task: str
    seed: int  # of the training
    count: int
    action_repeat: int
    parts: Parts
    informed: Callable[[float], Policy] | None
    observe: tuple[str, ...]
    threads: int

    def random(self) -> Driven:
        """Drive with uniformly random commands; no camera is needed."""
        returns: list[float] = []
        costs: list[float] = []
        for some in batches(0, self.count, SIDE_BY_SIDE):
            task = self._task(some, ("privileged",))
            drawn = derive("severity-random", self.task, self.seed, some.start)
            sums = evaluate_random(task, self._layouts(some), drawn)
            returns += sums.returns.tolist()
            costs += sums.costs.tolist()
        return Driven(tuple(returns), tuple(costs))

    def drive(self, operator: str, severity: float | None) -> Driven:
        """Drive with an operator alone; None: the unimpaired expert.

        Worlds and draws are the same at every severity, so that a severer operator makes the
        mistakes of a milder one, and more.
        """
        returns: list[float] = []
        costs: list[float] = []
        for some in batches(0, self.count, SIDE_BY_SIDE):
            task = self._task(some, self.observe)
            context = OperatorContext(
                self.parts.skills.at, task.action_size, task.decision_seconds, self.informed
            )
            noise = EpisodeNoise(
                [derive("severity-noise", self.task, operator, self.seed, i) for i in some]
            )
            driver = build_operator(operator, severity, context, noise, len(some))
            driver = driver.to(self.parts.device)
            layouts = self._layouts(some)
            loop = run_episodes(task, self.parts.world_model, driver, HumanOnly(), layouts, layouts)
            for episode in trajectories(loop)[0]:
                returns.append(float(episode.reward.sum()))
                costs.append(float(episode.cost_env.sum()))
        return Driven(tuple(returns), tuple(costs))

    def decision_seconds(self) -> float:
        """Return the seconds between two commands."""
        return float(self._task(range(1), ("privileged",)).decision_seconds)

    def _layouts(self, some: range) -> list[int]:
        return [derive("severity-episode", self.task, self.seed, i) for i in some]

    def _task(self, some: range, observe: tuple[str, ...]) -> Any:
        return make_task(
            self.task,
            len(some),
            action_repeat=self.action_repeat,
            observe=observe,
            threads=self.threads,
        )


class Kept:
    """What a search drives, kept in a work folder: after an interruption nothing is driven again.

    Args:
        told: called with how many severities were driven, these included.
    """

    def __init__(
        self, folder: Path, drive: Callable[[float], Driven], told: Callable[[int], None]
    ) -> None:
        self._file = folder / DRIVEN_FILE
        self._drive = drive
        self._told = told
        self._known: dict[str, Driven] = {}
        if self._file.exists():
            self._known = {
                severity: read_driven(each)
                for severity, each in json.loads(self._file.read_text()).items()
            }
        self._asked: set[str] = set()

    def __call__(self, severity: float) -> Driven:
        """Return the episodes at a severity."""
        name = repr(severity)
        if name not in self._known:
            self._known[name] = self._drive(severity)
            partial = self._file.with_suffix(".partial")
            partial.write_text(json.dumps({key: asdict(each) for key, each in self._known.items()}))
            os.replace(partial, self._file)
        self._asked.add(name)
        self._told(len(self._asked))
        return self._known[name]


def read_driven(document: dict[str, list[float]]) -> Driven:
    """Return episodes as `asdict` has them."""
    return Driven(tuple(document["returns"]), tuple(document["costs"]))


def write_references(folder: Path, references: References) -> None:
    """Write the episodes of random commands and of the unimpaired expert."""
    (folder / REFERENCES_FILE).write_text(json.dumps(asdict(references)))


def read_references(folder: Path) -> References:
    """Read what `write_references` has written."""
    document = json.loads((folder / REFERENCES_FILE).read_text())
    return References(read_driven(document["random"]), read_driven(document["expert"]))


def write_found(
    folder: Path, operator: str, kept: float, references: References, found: Found
) -> None:
    """Write the severity that was chosen, and everything that it was chosen from."""
    points = [
        {"severity": severity, "share": _finite(references.share(driven)), **asdict(driven)}
        for severity, driven in found.points.items()
    ]
    document = {
        "operator": operator,
        "severity": found.choice.severity,
        "within": found.choice.within,
        "decided": found.decided,
        "asked": kept,
        "points": points,
    }
    (folder / FILE).write_text(json.dumps(document, indent=1))


def _finite(number: float) -> float | None:
    return None if math.isnan(number) else number
