"""A spec to its cells, and cells to the nodes that compute them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import Any

from wasp_cli.config import Config
from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import OPERATORS, UNIMPAIRED
from wasp_cli.plan.cell import Cell
from wasp_cli.plan.closure import closure_hash
from wasp_cli.plan.keys import key_of
from wasp_cli.plan.node import Node, with_upstream
from wasp_cli.plan.part import Part
from wasp_cli.registry import load_target, module_of
from wasp_cli.spec.model import Spec
from wasp_cli.spec.names import OF_METHODS
from wasp_cli.stages.base import Stage
from wasp_cli.stages.registry import STAGES
from wasp_cli.tasks.registry import TASKS

CALIBRATED_VARIANT = "full"
"""Ablations share the thresholds of the method that they ablate, unless theirs have another unit (`MethodInfo.own_thresholds`)."""


@dataclass(frozen=True)
class Grid:
    """What a spec asks for: its cells, each with its evaluation node, what else it trains, and every node behind them."""

    cells: tuple[tuple[Cell, Node], ...]
    nodes: tuple[Node, ...]
    """Each once, needed ones first."""
    points: int
    """Combinations that the spec writes down; the unimpaired reference counts once for every operator there, and once in `cells`."""

    @property
    def parts(self) -> list[tuple[Part, Node]]:
        """What is trained, needed parts first."""
        return [(Part(node.task, node.kind, node.seed), node) for node in self.nodes if node.kind not in OF_METHODS]


def lay_out(spec: Spec) -> Grid:
    """Every cell of a spec, every stage that it names, and every node behind them, each node once."""
    builder = _Builder(spec)
    cells = tuple((cell, builder.evaluation(cell)) for cell in cells_of(spec))
    severities = sum(len(values) for values in spec.operators.values())
    per_seed = sum(len(spec.variants_of(method)) for method in spec.methods) * max(severities, 1)
    named = [builder.training(kind, task, seed) for task, seed, kind in product(spec.tasks, spec.chain_seeds(), spec.stages)]
    nodes = with_upstream([*(node for _, node in cells), *named])
    return Grid(cells, tuple(nodes), len(spec.tasks) * len(spec.seeds) * per_seed)


def cells_of(spec: Spec) -> Iterable[Cell]:
    """The cells of a spec in its own order."""
    impaired = [(variant, name, value) for variant, severities in spec.operators.items() for name, value in severities.items()]
    for task, method in product(spec.tasks, spec.methods):
        operators = impaired if METHODS[method].impaired else [(UNIMPAIRED, None, None)]
        for assistant, (operator, severity, value), seed in product(spec.variants_of(method), operators, spec.seeds):
            yield Cell(task, method, assistant, operator, severity, value, seed)


class _Builder:
    """Builds nodes of one spec; what cells share is built once."""

    def __init__(self, spec: Spec) -> None:
        self.spec = spec
        self.config = cache(lambda kind: spec.stage(kind).model_dump(mode="json"))
        self.identity = cache(lambda kind: spec.stage(kind).identity())
        self.settings = cache(self._settings)
        self.method_config = cache(lambda method, variant: spec.method(method, variant).model_dump(mode="json"))
        self.training = cache(self._training)
        self.calibration = cache(self._calibration)

    def evaluation(self, cell: Cell) -> Node:
        """The node that computes a cell, from the training chain of its seed."""
        info, chain = METHODS[cell.method], self.spec.chain_seed(cell.seed)
        needs = self._inputs("evaluate", cell.task, chain, info.needs)
        if info.calibrated:
            variant = cell.assistant if cell.assistant in info.own_thresholds else CALIBRATED_VARIANT
            needs["calibration"] = self.calibration(cell.task, chain, cell.method, variant)
        axes = {
            "method": cell.method,
            "method_config": self.method_config(cell.method, cell.assistant),
            "variant": cell.operator,
            "value": cell.value,
        }
        roots = [module_of(info.target)]
        if cell.operator in OPERATORS:
            roots.append(module_of(OPERATORS[cell.operator].target))
        assistant = "" if cell.assistant == CALIBRATED_VARIANT else f"/{cell.assistant}"
        operator = "unimpaired" if cell.value is None else f"{cell.operator}={cell.value:g}"
        return self._node("evaluate", cell.task, cell.seed, axes, needs, roots, f"{cell.method}{assistant} {operator}")

    def _calibration(self, task: str, seed: int, method: str, variant: str) -> Node:
        info = METHODS[method]
        axes = {"method": method, "method_config": self.method_config(method, variant)}
        needs = self._inputs("calibration", task, seed, info.needs)
        name = method if variant == CALIBRATED_VARIANT else f"{method}/{variant}"
        return self._node("calibration", task, seed, axes, needs, [module_of(info.target)], f"calibration {name}")

    def _training(self, kind: str, task: str, seed: int) -> Node:
        # A stage that mixes operators finds them by the names in its section.
        named = self.config(kind).get("operators", {})
        roots = [module_of(OPERATORS[name].target) for name in named]
        return self._node(kind, task, seed, {}, self._inputs(kind, task, seed), roots, kind)

    def _inputs(self, kind: str, task: str, seed: int, further: tuple[str, ...] = ()) -> dict[str, Node]:
        return {needed: self.training(needed, task, seed) for needed in dict.fromkeys((*stage_class(kind).needs, *further))}

    def _settings(self, kind: str) -> dict[str, Any]:
        values = {name: getattr(self.spec, name) for name in stage_class(kind).settings}
        return {name: value.model_dump(mode="json") if isinstance(value, Config) else value for name, value in values.items()}

    def _node(
        self, kind: str, task: str, seed: int, axes: Mapping[str, Any], needs: Mapping[str, Node], roots: list[str], label: str
    ) -> Node:
        modules = tuple(sorted({module_of(STAGES[kind].target), *_task_modules(task), *roots}))
        config, settings = self.config(kind), self.settings(kind)
        key = key_of(
            {
                "kind": kind,
                "task": _task_facts(task),
                "seed": seed,
                "axes": axes,
                "config": self.identity(kind),
                "settings": settings,
                "upstream": {name: node.key for name, node in needs.items()},
                "code": closure_hash(modules),
            }
        )
        return Node(kind, task, seed, axes, config, settings, needs, modules, key, f"{task} s{seed} {label}")


@cache
def stage_class(kind: str) -> type[Stage]:
    """The class of a stage (light: heavy imports are inside its `run`)."""
    stage: type[Stage] = load_target(STAGES[kind].target)
    return stage


@cache
def _task_modules(task: str) -> tuple[str, ...]:
    return TASKS[task].modules


@cache
def _task_facts(task: str) -> dict[str, Any]:
    return TASKS[task].facts()
