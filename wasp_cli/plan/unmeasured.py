"""How long nodes take if nothing similar was measured: those of an environment of one's own, of a
preset without figures, or of other sizes.

Learning is assumed to take as long as on the tasks of this package, by the shipped figures and the
sizes of the node. For each decision in the environment a time is added: as the finished nodes of
the environment show it, or, before there are any, as `wasp try` has measured it here in one
process. If it was not tried, that time is unknown, and the number of decisions is reported instead.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from statistics import median
from typing import Annotated, Any

from pydantic import Field, FiniteFloat

from wasp_cli.plan.grid import stage_class
from wasp_cli.plan.node import Node
from wasp_cli.plan.schedule import SIZES, figures_like, shipped, speed, units
from wasp_cli.plan.tried import Tried, kept
from wasp_cli.spec.presets import PRESETS, preset_values
from wasp_cli.stages.registry import STAGES
from wasp_cli.tasks.foreign.payoff import processes_pay
from wasp_cli.tasks.registry import TASKS

DRIVES = ("expert", "dataset", "residual")
"""Stages whose time grows with their decisions alone: they show how long one takes."""
BY_LENGTH = ("evaluate", "operating", "severity", "heldout")
"""Stages whose time grows with the decisions of an episode too."""
GROWS_WITH = {**SIZES, "diagnostics": "starts"}
"""By stage the setting that its time grows with; that of the others grows with their updates."""
REFERENCES = 10  # episodes of zero and of random commands at most, as `stages.expert` has them
ACTING = 32  # episodes of each of two ways of acting at most, as it has them
REPEAT = 4  # env steps of a decision, where a stage does not say so, and in the shipped figures


@dataclass(frozen=True)
class Stepping:
    """What a node spends in its environment, which several processes may share. A plan records it;
    whoever reads the record checks the bounds.
    """

    seconds: Annotated[FiniteFloat, Field(ge=0.0)]  # in one process
    # environments side by side: at most so many processes have something to do
    rows: Annotated[int, Field(ge=1, lt=2**53)]

    def saved(self, threads: int) -> float:
        """Return the seconds that are saved if this number of processes share it."""
        return self.seconds * (1.0 - 1.0 / min(threads, self.rows))


@dataclass(frozen=True)
class Guesses:
    """By sort of a node: its seconds with one thread, the part of them that several processes
    share, and the decisions in it that are not in them, since nobody has measured the environment.
    """

    seconds: Mapping[str, float]
    stepping: Mapping[str, Stepping]
    decisions: Mapping[str, int]


def guessed(
    nodes: Iterable[Node], presets: Mapping[str, str], done: Iterable[tuple[Node, float]]
) -> Guesses:
    """Return estimates for nodes if nothing similar was measured. `done` are nodes that were
    computed here, each with its seconds; `presets` are by key of a node.
    """
    here = _measured(done)
    seconds: dict[str, float] = {}
    stepping: dict[str, Stepping] = {}
    decisions: dict[str, int] = {}
    for node in {node.sort: node for node in nodes}.values():
        preset = presets[node.key]
        unit = _unit(node.kind, node.axes, preset)
        if unit is None:
            continue
        count = drives(node)
        extra = _of_a_decision(node.task, preset, here)
        if extra is None:
            extra = _as_tried(node)
            count += _judged(node)
            if extra is not None and _is_shared(node, extra):
                stepping[node.sort] = Stepping(extra * count, _rows(node))
        if count and extra is None:
            decisions[node.sort] = count
        share = 1.0 if count else _of_learning(node.task, preset, here)
        learned = unit * share * _amount(node.kind, node.config, _length(node))
        seconds[node.sort] = learned + (extra or 0.0) * count
    return Guesses(seconds, stepping, decisions)


@dataclass(frozen=True)
class _Done:
    kind: str
    axes: Mapping[str, Any]
    unit: float  # seconds for each of what its time grows with
    drives: bool


def _measured(done: Iterable[tuple[Node, float]]) -> Mapping[str, list[_Done]]:
    found: dict[str, list[_Done]] = {}  # by task
    for node, seconds in done:
        unit = seconds / _amount(node.kind, node.config, _length(node))
        found.setdefault(node.task, []).append(
            _Done(node.kind, node.axes, unit, bool(drives(node)))
        )
    return found


def _of_a_decision(task: str, preset: str, here: Mapping[str, list[_Done]]) -> float | None:
    """Seconds of a decision in an environment beyond those in ours: 0 for ours, None if it was not
    measured.
    """
    if task in TASKS.own:
        return 0.0
    beyond = [
        max(done.unit - unit, 0.0)
        for done in here.get(task, ())
        if done.kind in DRIVES and (unit := _unit(done.kind, done.axes, preset)) is not None
    ]
    return median(beyond) if beyond else None


def _as_tried(node: Node) -> float | None:
    """Seconds of a decision as `wasp try` has measured it on this machine, or None."""
    found = _tried(node.task)
    if found is None:
        return None
    looks = STAGES[node.kind].reads_images
    step = found.step_seconds if looks else found.bare_seconds
    return step * int(node.settings.get("action_repeat", REPEAT))


def _rows(node: Node) -> int:
    """Environments that a node steps side by side."""
    return int(node.config.get("envs") or node.settings.get("side_by_side") or 1)


def _is_shared(node: Node, seconds: float) -> bool:
    """Whether the batch of a node is stepped in several processes where it has threads for them;
    `seconds` are those of a decision of one row.
    """
    repeat = int(node.settings.get("action_repeat", REPEAT))
    longest = -(-TASKS[node.task].env_steps // repeat)
    return processes_pay(_rows(node) * seconds, longest)


def _of_learning(task: str, preset: str, here: Mapping[str, list[_Done]]) -> float:
    """By what factor learning takes longer for a task here than the figures say."""
    shares = [
        done.unit / unit
        for done in here.get(task, ())
        if not done.drives and (unit := _unit(done.kind, done.axes, preset))
    ]
    return median(shares) if shares else 1.0


def drives(node: Node) -> int:
    """Return about how many decisions a node makes in its environment."""
    config = node.config
    length = _length(node)
    if node.kind in DRIVES:
        return int(config[SIZES[node.kind]])
    if node.kind == "severity":
        return units(node.kind, config) * length
    if node.kind in (*BY_LENGTH, "diagnostics"):
        return int(config["episodes"]) * length
    if node.kind == "counterfactual":  # its episodes again, and two branches of an intervention
        episodes = int(node.needs["evaluate"].config["episodes"])
        return episodes * length + 2 * int(config["window"]) * int(config["most"] or 0)
    if node.kind == "policies":
        judged = (1 + config["labelling_rounds"]) * config["evaluation_episodes"]
        labelled = config["labelling_rounds"] * config["labelling_episodes"]
        return int(config["reinforce"]["interactions"] + (judged + labelled) * length)
    return 0


def _judged(node: Node) -> int:
    """Return how many decisions an expert is judged by, beside those that it learns from: episodes
    of its checkpoints, of two ways of acting, and of zero and random commands. What a finished node
    shows of a decision has them in it.
    """
    if node.kind != "expert":
        return 0
    each = int(node.config["evaluation_episodes"])
    references = 2 * min(REFERENCES, each)
    acting = 0 if node.task in TASKS.own else 2 * min(ACTING, 3 * each)
    episodes = len(node.config["checkpoints"]) * each + references + acting
    return episodes * _episode(node)


def _length(node: Node) -> int:
    """Decisions of an episode if the time of a stage grows with them, else 1."""
    if node.kind not in (*BY_LENGTH, "diagnostics", "counterfactual", "policies"):
        return 1
    return _episode(node)


def _episode(node: Node) -> int:
    """Decisions of an episode, at most or as they were met."""
    return max(_env_steps(node.task) // int(node.settings.get("action_repeat", REPEAT)), 1)


def _env_steps(task: str) -> int:
    """Env steps of an episode: up to the time limit, or as many as simple drivers have made."""
    found = _tried(task)
    return TASKS[task].env_steps if found is None else round(found.length)


def _tried(task: str) -> Tried | None:
    return None if task in TASKS.own else kept(task)


def _amount(kind: str, config: Mapping[str, Any], length: int) -> float:
    """The quantity that the time of a stage grows with."""
    if kind == "severity":
        return float(units(kind, config) * length)
    if kind in BY_LENGTH:
        return float(config["episodes"]) * length
    return float(config.get(GROWS_WITH.get(kind, "updates"), 1))


def _unit(kind: str, axes: Mapping[str, Any], preset: str) -> float | None:
    """Seconds for each unit of that quantity, on the quickest of our tasks: by the figures of a
    preset, or of another one if it has none. None if no preset has any.
    """
    figures = shipped()
    for known in dict.fromkeys((preset, *figures["seconds"])):
        seconds = list(_figures(kind, axes, known))
        if seconds:
            return min(seconds) * float(figures["speed"]) / speed()
    return None


def _figures(kind: str, axes: Mapping[str, Any], preset: str) -> Iterator[float]:
    figures = shipped()["seconds"].get(preset, {})
    config = _config(kind, preset)
    for task, info in TASKS.own.items():
        amount = _amount(kind, config, info.env_steps // REPEAT)
        for name in figures_like(kind, task, axes):
            if name in figures:
                yield figures[name] * units(kind, config) / amount
                break


@cache
def _config(kind: str, preset: str) -> Mapping[str, Any]:
    values = preset_values(preset) if preset in PRESETS else {}
    section = dict(values.get(kind, {}))
    if kind == "evaluate":
        section["episodes"] = values.get("episodes", 30)
    return stage_class(kind).config.model_validate(section).model_dump(mode="json")
