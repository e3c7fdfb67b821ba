"""One block of a session: a person drives the episodes of one cell, with an assistant that answers
in time or not at all.

In each decision the latest state of the controls is the command, and the assistant corrects it. Its
search is asked to end with the period, and the world slows down if it takes longer. An assistant
that takes more than PATIENCE seconds is late: the command is executed as it is, and the row says
so. Everything is recorded as in an evaluation, so that the block is a cell like any other.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wasp_cli.drive.controls import Controls
from wasp_cli.drive.desk import (
    END,
    GO,
    NEXT,
    PAUSE,
    RESTART,
    Clock,
    Decider,
    Desk,
    Frame,
)
from wasp_cli.drive.view import Eyes, Futures, WorldView, short
from wasp_cli.learning.assistants import build_assistant
from wasp_cli.learning.closed_loop import DecisionColumns, Filter, Loop
from wasp_cli.learning.evaluation import trajectories
from wasp_cli.methods.base import Decision, Parts, checked
from wasp_cli.methods.record import Planned, blank_record
from wasp_cli.methods.registry import METHODS
from wasp_cli.metrics.episode import GATE_LATE, GATE_NONE, Trajectory
from wasp_cli.operators.base import EpisodeNoise
from wasp_cli.operators.person import PersonOperator
from wasp_cli.plan.node import Cell
from wasp_cli.report.explain.episode import GATES
from wasp_cli.tasks.base import Step, VectorTask
from wasp_cli.tasks.camera.appearance import HasScene
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.sight import seen_of
from wasp_cli.video.picture import asking_for_pictures

ALONE = "human"  # the method without an assistant: nobody can be late
PATIENCE = 1.0
"""Seconds after which an assistant is late. Until then the world waits for its answer."""
LEAST = 0.5  # least share of a period for its search, however long everything else takes


class Beat(NamedTuple):
    """What the clock and the connection were like at a decision; NaN is unknown."""

    at: float  # seconds since the block began
    decision_ms: float  # how long the assistant was waited for
    late: bool  # it had not answered after PATIENCE seconds, and the command was executed as it is
    behind_ms: float  # how long after its beat the decision began
    # how long everything else took: the step of the world, its images, the filter, the frame
    rest_ms: float
    input: int  # number of the last message about the controls that the command knows of
    input_age_ms: float  # from the arrival of that message to the execution of the action
    round_trip_ms: float  # of the last frame that the page acknowledged
    keys: str
    focused: bool


@dataclass
class Driven:
    """An episode that was driven to its end: T decisions, with the clock and the connection at
    each.
    """

    layout: int
    trajectory: Trajectory
    decision_ms: NDArray[Any]  # [T]
    beats: list[Beat]
    pauses: int = 0
    paused_seconds: float = 0.0
    # headers of the frames that were shown, for `Block.review`
    frames: list[dict[str, Any]] = field(default_factory=list)


@dataclass(frozen=True)
class Cut:
    """An episode that was given up after some decisions, and why."""

    layout: int
    decisions: int
    why: str  # `restart`, `next` or `end`


SHOWN = ("cameras", "map", "cost", "goals", "gate", "imagined")
ON_THE_MAP = ("map", "imagined")
"""What is left out for a task without a map."""


@dataclass(frozen=True)
class How:
    """How a session is shown and paced; none of it is in a key."""

    speed: float = 1.0  # simulated seconds per second
    shown: frozenset[str] = frozenset(SHOWN)
    simulated: bool = False


class Block:
    """One cell that a person drives; see the module. The caller chooses the worlds, so that
    practice and restarts do not use those of the cell.
    """

    def __init__(
        self,
        cell: Cell,
        method_config: Mapping[str, Any],
        action_repeat: int,
        how: How,
        parts: Parts,
        desk: Desk,
        keys: Sequence[str] | None = None,
    ) -> None:
        """`keys` are the `controls` of the task in a spec; None if it has none.

        Raises:
            UsageError: neither the task nor the spec says how its actions are commanded.
        """
        self.cell = cell
        self.how = how
        self.parts = parts
        self.desk = desk
        shown = (seen_of(cell.task), *asking_for_pictures(cell.task))
        self.task: VectorTask = make_task(cell.task, 1, action_repeat=action_repeat, observe=shown)
        self.controls = Controls(self.task, keys)
        self.view = WorldView(self.task)
        self.eyes = Eyes(self.task)
        self.period = self.task.decision_seconds / how.speed
        self.assistant = build_assistant(cell.method, method_config, parts)
        self.operator = PersonOperator(
            parts.skills.expert, self.task.action_size, EpisodeNoise([0]), 1
        )
        self.futures = None
        if "imagined" in how.shown:
            self.futures = Futures(cell.task, parts, self.assistant, self.task)
        self._decider: Decider[Decision] = Decider()
        assistant: Any = self.assistant
        if hasattr(assistant, "time_is_up"):
            assistant.time_is_up = self._decider.time_is_up
        self._clock = Clock(self.period)
        self._frames = 0
        self._begun = time.monotonic()

    def close(self) -> None:
        """Wait for an answer that is still being computed, and end the assistant's thread."""
        self._decider.close()

    @property
    def answers(self) -> list[tuple[float, bool, bool]]:
        """Every answer of the assistant: seconds it took, whether it was late, and whether a gate
        fired.
        """
        answers = []
        for seconds, late, decision in self._decider.answers:
            record = decision.record
            fired = record is not None and bool((record.gate != GATE_NONE).any())
            answers.append((seconds, late, fired))
        return answers

    def hello(self) -> dict[str, Any]:
        """Return the message that describes the block to the page: what is shown, the map, the
        period, the controls and the assistant. None stands for what is hidden or not there.
        """
        has_map = isinstance(self.task, HasScene)
        shown = [name for name in SHOWN if name in self.how.shown]
        if not has_map:
            shown = [name for name in shown if name not in ON_THE_MAP]
        assistant = None
        if "gate" in self.how.shown and self.cell.method != ALONE:
            assistant = METHODS[self.cell.method].title
        return {
            "type": "block",
            "task": self.cell.task,
            "shown": shown,
            "period_ms": 1000 * self.period,
            "speed": self.how.speed,
            **self.eyes.said,
            "map": self.view.still if "map" in self.how.shown else None,
            "decisions": self.task.max_decisions,
            "seconds": self.task.max_decisions * self.period,
            "controls": self.controls.told,
            "goals": has_map,
            "assistant": assistant,
        }

    def episode(
        self,
        number: int,
        layout: int,
        method_seed: int,
        facts: Mapping[str, Any] | None = None,
        most: int | None = None,
    ) -> Driven | Cut:
        """Let the driver drive one episode; it begins when they ask for it.

        Args:
            number: of the episode in its cell.
            layout: seed of its world.
            method_seed: seed of the assistant's own draws.
            facts: what else the page is told.
            most: decisions after which it ends; None: when the task ends it.

        Returns:
            The episode, or how far it came if the driver gave it up.
        """
        running = _Running(self, layout)
        with torch.inference_mode():
            running.reset(method_seed)
            running.show()
            self.desk.state("ready", episode=number, **(facts or {}))
            if self.desk.wait() == END:
                return Cut(layout, 0, END)
            self.desk.state("driving", episode=number, **(facts or {}))
            self._clock.begin()
            while not running.ended and (most is None or len(running.beats) < most):
                request = self.desk.asked()
                if request == PAUSE:
                    request = running.pause(number, facts or {})
                    self._clock.begin()
                if request in (RESTART, NEXT, END):
                    return running.cut(request)
                time.sleep(max(self._clock.due - time.monotonic(), 0.0))
                running.decide()
        self._decider.finish()
        return running.driven()

    def review(self, driven: Driven) -> dict[str, Any]:
        """Return what the page replays after an episode: the frames that were driven, and the same
        commands in the same world without the assistant.

        A person would have reacted to what happened without the assistant, so the second drive is
        only an illustration. An episode without an assistant has none.
        """
        alone: list[dict[str, Any]] = []
        if self.cell.method != ALONE:
            world = make_task(self.cell.task, 1, action_repeat=self.task.action_repeat, observe=())
            world.reset([driven.layout])
            view = WorldView(world)
            score = Score()
            alone.append(self._numbers(view, score, None))
            for command in driven.trajectory.a_h:
                step = world.step(command[None])
                score.add(step)
                alone.append(self._numbers(view, score, step))
                if step.ended[0]:
                    break
        return {"type": "review", "driven": driven.frames, "alone": alone}

    def _numbers(self, view: WorldView, score: Score, step: Step | None) -> dict[str, Any]:
        numbers: dict[str, Any] = dict(view.now()) if "map" in self.how.shown else {}
        if "cost" in self.how.shown:
            numbers |= {"cost": score.cost, "costly": bool(step is not None and step.cost[0])}
        if "goals" in self.how.shown:
            numbers |= {"goals": score.goals, "return": round(score.returned, 2)}
        return numbers


@dataclass
class Score:
    """The totals of an episode so far: return, env steps with cost, and goals."""

    returned: float = 0.0
    cost: int = 0
    goals: int = 0

    def add(self, step: Step) -> None:
        """Add a decision step."""
        self.returned += float(step.reward[0])
        self.cost += int(step.cost_env[0])
        self.goals += int(step.goals[0])


@dataclass
class _Running:
    """An episode while it is driven."""

    block: Block
    layout: int
    ended: bool = False
    columns: list[DecisionColumns] = field(default_factory=list)
    decisions: list[Decision] = field(default_factory=list)
    beats: list[Beat] = field(default_factory=list)
    pauses: int = 0
    paused_seconds: float = 0.0
    score: Score = field(default_factory=Score)
    frames: list[dict[str, Any]] = field(default_factory=list)

    def reset(self, method_seed: int) -> None:
        """Begin the episode, with the seed of the assistant's own draws."""
        block = self.block
        self._seen = block.task.reset([self.layout])
        block.eyes.begin()
        self._filter = Filter(block.parts.world_model, 1)
        block.operator.reset(torch.ones(1, dtype=torch.bool))
        block.assistant.reset(torch.ones(1, dtype=torch.bool), [method_seed])
        self._latent = self._filter.see(self._seen, torch.ones(1))

    def decide(self) -> None:
        """Make one decision at the next beat of the clock, and show what came of it."""
        block = self.block
        clock = self.block._clock
        begun, behind = clock.beat()

        # The command: what the controls say now.
        held = block.desk.held
        commanded = torch.from_numpy(block.controls.action(held.stick))
        command = commanded[None].to(self._latent.h.device)
        block.operator.say(command)
        a_h = block.operator.command(self._latent.features).clamp(-1, 1)

        # What the assistant makes of it; if it does not answer in time, the command is executed.
        latent = self._latent
        assistant = block.assistant
        operator = block.operator
        own = a_h.clone()  # a late answer may still read it when the next decision is made

        def answer() -> Decision:
            with torch.inference_mode():
                return checked(assistant.decide(latent, own, operator), assistant, own, a_h)

        answered, seconds = block._decider.ask(
            answer, PATIENCE, clock.deadline(), LEAST * block.period
        )
        late = answered is None and block.cell.method != ALONE
        if answered is not None:
            decision = answered
        elif late:
            decision = Decision(a_h, blank_record(1, GATE_LATE, a_h.device))
        else:
            decision = Decision(a_h, None)

        # The world goes on.
        executed_at = time.monotonic()
        self._filter.executed(decision.action)
        step = block.task.step(decision.action.cpu().numpy())
        self._keep(step, a_h, decision)
        age = executed_at - held.at if held.number else float("nan")
        self.beats.append(
            Beat(
                at=begun - block._begun,
                decision_ms=1000 * seconds,
                late=late,
                behind_ms=1000 * behind,
                rest_ms=float("nan"),
                input=held.number,
                input_age_ms=1000 * age,
                round_trip_ms=1000 * block.desk.round_trip,
                keys=" ".join(sorted(held.keys)),
                focused=block.desk.focused,
            )
        )

        # The next observation, and the frame that shows it. How long that took is added afterwards.
        self._seen = step.observation
        before = self.frames[-1]
        self._latent = self._filter.see(self._seen, torch.zeros(1))
        self.ended = bool(step.ended[0])
        self.show(step, a_h, decision)
        rest = time.monotonic() - executed_at
        clock.spent(rest)
        self.beats[-1] = self.beats[-1]._replace(rest_ms=1000 * rest)

        # If there is time left before the next beat: lines of what the assistant imagined.
        if block.futures is not None and not self.ended:
            lines = block.futures.lines(
                len(self.beats),
                latent,
                a_h,
                operator,
                decision,
                before.get("robot"),
                clock.due - time.monotonic(),
            )
            if lines is not None:
                block.desk.say({"type": "imagined", "frame": block._frames, **lines})

    def _keep(self, step: Step, a_h: Tensor, decision: Decision) -> None:
        alive = np.ones(1, bool)
        self.columns.append(DecisionColumns.of(step, a_h, decision.action, alive))
        self.decisions.append(decision)
        self.score.add(step)

    def show(
        self, step: Step | None = None, a_h: Tensor | None = None, decision: Decision | None = None
    ) -> None:
        """Send a frame of what is now; the first one of an episode has no step behind it."""
        block = self.block
        block._frames += 1
        shown = block.how.shown
        t = len(self.beats)
        header: dict[str, Any] = {
            "frame": block._frames,
            "t": t,
            "seconds": round(t * block.task.decision_seconds, 2),
        }
        if self.beats:
            header |= {"input": self.beats[-1].input, "late": sum(beat.late for beat in self.beats)}
        header |= block._numbers(block.view, self.score, step)
        if a_h is not None and decision is not None:
            commanded = block.controls.stick(a_h[0].cpu().numpy())
            header["command"] = None if commanded is None else short(commanded)
            if "gate" in shown:
                executed = block.controls.stick(decision.action[0].cpu().numpy())
                header["executed"] = None if executed is None else short(executed)
                gate = GATE_NONE if decision.record is None else int(decision.record.gate[0])
                header["gate"] = GATES.get(gate, "method")
                if block.cell.method == ALONE:
                    header["gate"] = "alone"
                header["corrected"] = bool((decision.action != a_h).any())
        self.frames.append(header)
        pixels = b""
        if "cameras" in shown:
            pixels = block.eyes.look(self._seen)
        block.desk.show(Frame(header, pixels))

    def pause(self, number: int, facts: Mapping[str, Any]) -> str:
        """Hold the world until the driver goes on, or asks for something else."""
        begun = time.monotonic()
        self.block.desk.state("paused", episode=number, **facts)
        request = self.block.desk.wait((GO, RESTART, NEXT, END))
        self.pauses += 1
        self.paused_seconds += time.monotonic() - begun
        if request == GO:
            self.block.desk.state("driving", episode=number, **facts)
        return request

    def cut(self, why: str) -> Cut:
        """Give the episode up; return where."""
        self.block._decider.finish()
        return Cut(self.layout, len(self.beats), why)

    def driven(self) -> Driven:
        """Return the episode in the form that rows are written from."""
        times = [beat.decision_ms for beat in self.beats]
        # If the assistant plans, decisions that were late get an empty plan.
        plan = next(
            (decision.planned for decision in self.decisions if decision.planned is not None), None
        )
        decisions = self.decisions
        if plan is not None:
            nothing = Planned.nothing(
                1,
                plan.safe.shape[1],
                plan.residuals.shape[1],
                plan.residuals.shape[2],
                plan.residuals.device,
            )
            decisions = [
                decision if decision.planned is not None else decision._replace(planned=nothing)
                for decision in decisions
            ]
        loop = Loop.joined(self.columns, decisions, times)
        (trajectory,), (decision_ms,) = trajectories(loop)
        return Driven(
            self.layout,
            trajectory,
            decision_ms,
            self.beats,
            self.pauses,
            self.paused_seconds,
            self.frames,
        )
