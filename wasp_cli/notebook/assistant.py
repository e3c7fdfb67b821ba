"""A trained assistant for any loop in Python: a ROS node, a study's own software, a simulator.

    assistant = wasp_cli.load_assistant("results", "goal1 s1 wasp")
    assistant.reset(seed=0)
    decision = assistant.act(observation, command)      # at every decision of an episode
    robot.execute(decision.action)                      # the same for `assistant.action_repeat`
    env steps

It does what the closed loop of `wasp run` does (`learning.closed_loop`), so that the same episodes
come out, bit for bit. A = action size, B = episodes side by side, F = size of a latent.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from wasp_cli.errors import ArtifactError, TaskError, UnknownName, UsageError
from wasp_cli.learning.assistants import build_assistant, load_parts, operating_words
from wasp_cli.learning.closed_loop import Filter, privileged_view
from wasp_cli.learning.configs.shared import ReturnsConfig
from wasp_cli.learning.device import training_device
from wasp_cli.learning.informed import informed_policies
from wasp_cli.methods.base import Parts, checked
from wasp_cli.methods.record import blank_record
from wasp_cli.metrics.episode import INTERVENED
from wasp_cli.notebook.given import number_of, seeds_of
from wasp_cli.notebook.perceived import VECTOR, perceived, require_size
from wasp_cli.notebook.stored_assistants import StoredAssistant, the_assistant
from wasp_cli.operators.base import EpisodeNoise, Operator, OperatorContext, build_operator
from wasp_cli.operators.person import PersonOperator
from wasp_cli.operators.registry import OPERATORS, UNIMPAIRED
from wasp_cli.report.explain.episode import GATES
from wasp_cli.store.artifact import corruption
from wasp_cli.store.layout import Layout
from wasp_cli.tasks.base import Observation
from wasp_cli.tasks.declared import declaration_of, declare_from
from wasp_cli.tasks.motors import UNKNOWN, Motors
from wasp_cli.tasks.registry import TASKS, AnyTaskInfo, TaskInfo

THREADS = 1
"""Of linear algebra in a decision, as in evaluations (`stages.base.Stage`): another number may
round differently.
"""


@dataclass(frozen=True)
class AssistantDecision:
    """What an assistant decided. With `batch` every field but `ms` is an array [B, ...]."""

    action: NDArray[np.float32]  # [A] to be executed, in [-1, 1]
    command: NDArray[np.float32]  # [A] the operator's, clipped to [-1, 1]
    gate: Any
    """Which gate fired: `none`, `safety`, `task`, or `method` for the rule of a method without
    WASP's gates.
    """
    intervened: Any  # bool: whether the action is another one than the command
    # discounted costly decisions that the command is predicted to lead to (Eq. 9); NaN where the
    # method predicts none
    predicted_cost: Any
    # discounted return that the correction is predicted to gain (Eq. 12); NaN where none is
    predicted_gain: Any
    signal: Any  # what the method decides by, where that is something else (IDA: the vote); or NaN
    ms: float  # wall time of seeing and deciding, in milliseconds


class LoadedAssistant:
    """An assistant, and where it is in its episodes. Arrays go in and come out.

    One object follows one episode, or with `batch` so many side by side; `another` makes a second
    one of the same models.
    """

    def __init__(self, stored: StoredAssistant, parts: Parts, batch: int | None = None) -> None:
        if batch is not None:
            batch = number_of(batch, "batch", "episodes", ", or None")
        self.stored = stored
        self.parts = parts
        self.batch = batch
        self._assistant = build_assistant(stored.method, stored.settings, parts)
        self.within(None)
        self._operator: Operator | None = None
        self._filter: Filter | None = None
        self._seen = False  # whether something was seen in this episode
        self._due = False  # whether it was not yet decided on
        self._first = torch.ones(self._rows)
        self._privileged: NDArray[np.float32] | None = None
        self._seen_ms = 0.0

    def __repr__(self) -> str:
        point = self.operating_point
        at = "" if point is None else f", operating point: {point}"
        return f"<wasp assistant '{self.label}': actions of {self.action_size}{at}>"

    @property
    def label(self) -> str:
        """Task, training seed and method."""
        return self.stored.label

    @property
    def task(self) -> str:
        """The task that it was trained on."""
        return self.stored.task

    @property
    def method(self) -> str:
        """The name of its method."""
        return self.stored.method

    @property
    def settings(self) -> Mapping[str, Any]:
        """The settings of its method."""
        return self.stored.settings

    @property
    def operating_point(self) -> str | None:
        """At which operating point it works, in words; None where none was chosen."""
        return operating_words(self.method, self.parts)

    @property
    def action_size(self) -> int:
        """Numbers of an action."""
        return self.parts.world_model.action_size

    @property
    def action_repeat(self) -> int:
        """Env steps of a decision: it was trained to see and decide once in so many."""
        return int(self.stored.shared["action_repeat"])

    @property
    def own_task(self) -> bool:
        """Whether the task is one of this package's, or of a plugin of it."""
        return isinstance(_info(self.task), TaskInfo)

    @property
    def features(self) -> NDArray[np.float32]:
        """[F] the latent of what was seen last, as policies read it; [B, F] with `batch`.

        Raises:
            TaskError: nothing was seen yet.
        """
        running = self._running()
        if not self._seen:
            raise TaskError("nothing was seen yet in this episode", "call see(observation) first")
        return self._out(running.latent.features)

    def another(self, batch: int | None = None) -> LoadedAssistant:
        """Return a second assistant of the same models, which follows episodes of its own."""
        return LoadedAssistant(self.stored, self.parts, batch)

    def operator(self, variant: str, value: float | None, seed: int | Sequence[int]) -> Operator:
        """Make an impaired operator of ours, for `reset`: the commands are its own.

        Args:
            variant: as in a spec, such as `noisy`; `none` is the expert.
            value: the severity.
            seed: of its mistakes, one for each episode; `wasp_cli.seeds.operator_seed` gives those
                of evaluations.

        Raises:
            UnknownName: there is no such variant.
            UsageError: the severity is not one of it, or the seeds are none.
        """
        if variant != UNIMPAIRED:
            _require_severity(variant, value)
        noise = EpisodeNoise(seeds_of(seed, self._rows))
        info = TASKS[self.task]
        context = OperatorContext(
            self.parts.skills.at,
            self.action_size,
            info.env_seconds * self.action_repeat,
            informed_policies(self.task, self.parts.inputs, self.parts.device),
        )
        made = build_operator(variant, value, context, noise, self._rows)
        return made.to(self.parts.device)

    def reset(
        self,
        seed: int | Sequence[int],
        operator: Operator | None = None,
        rows: Sequence[bool] | None = None,
    ) -> None:
        """Begin an episode, or with `batch` B of them.

        Args:
            seed: of the assistant's own draws, one for each episode; `wasp_cli.seeds.method_seed`
                gives those of evaluations.
            operator: an impaired operator of `operator`, which gives the commands; None: a person
                or a program outside gives them.
            rows: [B] which of the episodes begin anew; None: all. The operator stays.

        Raises:
            UsageError: another number of seeds than of episodes, or `operator` is none.
        """
        if operator is not None and not isinstance(operator, Operator):
            raise UsageError(
                f"operator={operator!r} is no operator",
                "assistant.operator('noisy', 0.4, seed) makes one; without one, pass commands",
            )
        seeds = seeds_of(seed, self._rows)
        begins = torch.ones(self._rows, dtype=torch.bool)
        if rows is not None:
            begins = torch.tensor(np.asarray(rows, bool))
            if begins.shape != (self._rows,) or self._filter is None:
                raise UsageError(
                    f"rows has shape {list(begins.shape)}, expected [{self._rows}]",
                    "rows chooses among the episodes of a batch, once all have begun",
                )
        if rows is None:
            self._filter = Filter(self.parts.world_model, self._rows)
            self._operator = operator or self._person()
        assert self._operator is not None
        self._operator.reset(begins)
        self._assistant.reset(begins, seeds)
        self._first = torch.where(begins, torch.ones(self._rows), self._first)
        self._seen = self._due = False

    def rest(self, rows: Sequence[bool]) -> None:
        """Say which episodes [B] have ended: nothing is computed for them any more."""
        rest: Any = getattr(self._assistant, "rest", None)
        if rest is not None:
            rest(torch.tensor(np.asarray(rows, bool)))

    def see(self, observation: Any) -> None:
        """Take in what is seen now; once for each decision.

        Args:
            observation: what the task shows: `pixels` uint8 [6, 64, 64], the environment's own
                image (scaled as in training), a vector for worlds without images, or the
                dictionary that has them; [B, ...] with `batch`.

        Raises:
            TaskError: it is no observation of this task, or no episode has begun.
        """
        begun = time.perf_counter()
        running = self._running()
        model = self.parts.world_model
        shown = perceived(
            observation, model.reads, self.batch, self.own_task, declaration_of(self.task)
        )
        if shown.state is not None and model.reads == VECTOR:
            require_size(shown.state.shape[1], model.state_mean.numel(), self.label)
        try:
            with _deciding():
                running.see(shown, self._first)
        except RuntimeError as error:
            read = getattr(shown, model.reads)
            what = f"'{self.label}' cannot read an observation of shape {list(read.shape[1:])}"
            raise TaskError(f"{what}: {str(error).splitlines()[0]}") from error
        self._first = torch.zeros(self._rows)
        self._privileged = shown.privileged
        self._seen = self._due = True
        self._seen_ms = _ms_since(begun)

    def command(self) -> NDArray[np.float32]:
        """Return the command [A] of the operator that `reset` was given, for what was seen last;
        once for each decision.

        Raises:
            UsageError: a person or a program outside gives the commands.
            TaskError: nothing was seen since the last decision.
        """
        running = self._deciding_on()
        operator = self._operator
        assert operator is not None
        if isinstance(operator, PersonOperator):
            raise UsageError(
                "nobody knows the command: `reset` was given no operator",
                "pass the command, or reset(seed, operator=assistant.operator(...))",
            )
        seen = _told(operator, self._privileged)
        with _deciding():
            issued = operator.command(running.latent.features, seen)
        return self._out(issued)

    def decide(self, command: ArrayLike) -> AssistantDecision:
        """Decide on a command [A] for what was seen last. Values beyond [-1, 1] are clipped.

        Raises:
            TaskError: the command has another shape or is not finite, or nothing was seen since the
                last decision.
        """
        running = self._deciding_on()
        operator = self._operator
        assert operator is not None
        begun = time.perf_counter()
        with _deciding():
            a_h = self._command(command).clamp(-1, 1)
            if isinstance(operator, PersonOperator):
                operator.say(a_h)
                a_h = operator.command(running.latent.features)
            given = a_h.clone()
            self._deadline.begin()
            decided = checked(
                self._assistant.decide(running.latent, a_h, operator), self._assistant, a_h, given
            )
            running.executed(decided.action)
            operator.observe(decided.action)
        self._due = False
        record = blank_record(self._rows) if decided.record is None else decided.record
        action = self._out(decided.action)
        given_to = self._out(a_h)
        return AssistantDecision(
            action=action,
            command=given_to,
            gate=self._each([GATES[int(code)] for code in record.gate]),
            intervened=self._each(
                np.linalg.norm(self._many(action) - self._many(given_to), axis=-1) > INTERVENED
            ),
            predicted_cost=self._each(record.g_cost.cpu().numpy().astype(np.float64)),
            predicted_gain=self._each(record.delta_g.cpu().numpy().astype(np.float64)),
            signal=self._each(record.signal.cpu().numpy().astype(np.float64)),
            ms=self._seen_ms + _ms_since(begun),
        )

    def act(self, observation: Any, command: ArrayLike | None = None) -> AssistantDecision:
        """See, and decide on a command; without one, on that of the operator that `reset` was
        given. Arguments and errors are those of `see` and `decide`.
        """
        self.see(observation)
        return self.decide(self.command() if command is None else command)

    def within(self, ms: float | None) -> None:
        """Let a search return its best so far when a decision has taken so many milliseconds; None:
        let it end by itself. Decisions then depend on the speed of the machine.

        Raises:
            UsageError: it is no time.
        """
        is_number = isinstance(ms, int | float | np.number) and math.isfinite(ms)
        if ms is not None and not (is_number and ms > 0):
            raise UsageError(f"{ms!r} is no time in milliseconds", "it is above 0, or None")
        self._deadline = _Deadline(math.inf if ms is None else float(ms) / 1000)
        assistant: Any = self._assistant
        if hasattr(assistant, "time_is_up"):
            assistant.time_is_up = self._deadline

    # -- rows --------------------------------------------------------------------------------------

    @property
    def _rows(self) -> int:
        return self.batch or 1

    def _person(self) -> PersonOperator:
        noise = EpisodeNoise([0] * self._rows)
        person = PersonOperator(self.parts.skills.expert, self.action_size, noise, self._rows)
        return person.to(self.parts.device)

    def _running(self) -> Filter:
        if self._filter is None:
            raise TaskError("no episode has begun", "call reset(seed) first")
        return self._filter

    def _deciding_on(self) -> Filter:
        running = self._running()
        if not self._due:
            raise TaskError(
                "nothing was seen since the last decision",
                "call see(observation), then decide(command); or act(observation, command)",
            )
        return running

    def _command(self, command: ArrayLike) -> Tensor:
        """[B, A] on the device."""
        shape = (self.action_size,) if self.batch is None else (self._rows, self.action_size)
        try:
            given = np.asarray(command)
            if given.dtype.kind not in "biuf":
                raise TypeError(given.dtype)
            values = given.astype(np.float32)
        except (TypeError, ValueError) as error:
            raise TaskError(
                f"a command is an array of real numbers {list(shape)}: {error}"
            ) from error
        if values.shape != shape:
            raise TaskError(f"the command has shape {list(values.shape)}, expected {list(shape)}")
        if not np.isfinite(values).all():
            raise TaskError(f"the command is not finite: {values.tolist()}")
        return torch.from_numpy(self._many(values)).to(self.parts.device)

    def _many(self, values: NDArray[Any]) -> NDArray[Any]:
        return values[None] if self.batch is None else values

    def _out(self, values: Tensor) -> NDArray[np.float32]:
        """A copy [B, ...], without the first dimension for a single episode."""
        array: NDArray[np.float32] = values.detach().cpu().numpy().copy()
        return array[0] if self.batch is None else array

    def _each(self, values: Any) -> Any:
        """A plain value for a single episode, an array [B] for a batch."""
        array = np.asarray(values)
        return array[0].item() if self.batch is None else array


def _told(operator: Operator, privileged: NDArray[np.float32] | None) -> Tensor | None:
    """Return what an operator who knows more than assistants perceive reads.

    Raises:
        TaskError: the observation does not have it.
    """
    if operator.knows_more and privileged is None:
        raise TaskError(
            "the operators of this task know more than the cameras show",
            "let the observation have `privileged`: observation='all'",
        )
    return privileged_view(operator, Observation(None, None, privileged))


def load_assistant(
    results: str | Path = "results", which: str | None = None, *, batch: int | None = None
) -> LoadedAssistant:
    """Load a trained assistant, as `wasp run` evaluated it; the SHA-256 of every file are checked
    first.

    Args:
        results: a results folder, or a published one; manifests alone are read, so that it may have
            been moved, and needs no runs.
        which: task, seed of the training and method, in any order: `goal1 s1 wasp`; the method with
            its ablation, `wasp/no-case2`; also settings of the method, such as `tau_c=0.5`. Or the
            label of a cell as `wasp run` prints it, or the beginning of its key. What there is only
            one of may be left out.
        batch: episodes side by side; None: one, whose arrays have no dimension for it.

    Returns:
        The assistant, on the device of `WASP_DEVICE`, else a GPU, else the CPU.

    Raises:
        StoreError: there is no such folder, or no assistant in it.
        UnknownName: a word of `which` names nothing.
        UsageError: there is no such assistant, or there are several.
        ArtifactError: a model that it needs is missing or damaged.
    """
    _require_texts(results, which)
    layout = Layout(Path(results))
    stored = the_assistant(layout, which)
    folders, _ = stored.folders(layout)
    for name, folder in folders.items():
        kind, key = stored.inputs[name]
        wrong = corruption(Layout(folder.parents[2]), kind, key)
        if wrong is not None:
            raise ArtifactError(wrong, "run the spec again: what is damaged is computed again")
    declare_from(stored.task, stored.shared)  # its environment is found by its name from now on
    returns = ReturnsConfig.model_validate(stored.shared["returns"])
    parts = load_parts(folders, returns, training_device(), motors=_motors(stored.task))
    return LoadedAssistant(stored, parts, batch)


def _require_texts(results: object, which: object) -> None:
    """Refuse what names no folder, or no assistant. Raises UsageError."""
    example = 'load_assistant("results", "goal1 s1 wasp")'
    if not isinstance(results, str | Path):
        raise UsageError(f"results={results!r} is no folder", example)
    if which is not None and not isinstance(which, str):
        raise UsageError(f"which={which!r} is no text", example)


def _require_severity(variant: str, value: float | None) -> None:
    """Refuse what is no severity of an operator variant. Raises UnknownName and UsageError."""
    info = OPERATORS[variant]
    is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    if not is_number or not info.low <= float(value or 0.0) <= info.high:
        raise UsageError(
            f"{value!r} is no severity of the operator '{variant}'",
            f"it lies between {info.low:g} and {info.high:g} ({info.unit})",
        )


def _info(task: str) -> AnyTaskInfo | None:
    """What is known of a task; None where its plugin is not installed."""
    try:
        return TASKS[task]
    except UnknownName:
        return None


def _motors(task: str) -> Motors:
    info = _info(task)
    return UNKNOWN if info is None else info.motors


@contextmanager
def _deciding() -> Iterator[None]:
    """Compute as an evaluation does, and leave torch as it was."""
    before = torch.get_num_threads()
    torch.set_num_threads(THREADS)
    try:
        with torch.inference_mode():
            yield
    finally:
        torch.set_num_threads(before)


def _ms_since(begun: float) -> float:
    return (time.perf_counter() - begun) * 1000


class _Deadline:
    """Tells a search whether a further step, as long as its last one, would end too late."""

    def __init__(self, seconds: float = math.inf) -> None:
        self._seconds = seconds
        self._end = self._looked = math.inf

    def begin(self) -> None:
        """Let the time of a decision begin now."""
        self._looked = time.monotonic()
        self._end = self._looked + self._seconds

    def __call__(self) -> bool:
        now = time.monotonic()
        step = now - self._looked
        self._looked = now
        return now + step > self._end
