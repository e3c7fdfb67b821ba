"""From a spec to its nodes and their keys, in one pass: each cell asks for its evaluation, each
node for the nodes that it needs, and then gets its key.

Begin to read at `lay_out`. `_Builder` has a method for each sort of node, and `_Builder.node` makes
every key. `plan.selection` finds the nodes that `--select task=race1,method=wasp|ida` names.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import product
from typing import Any, NamedTuple

from wasp_cli.config import Config
from wasp_cli.errors import UnknownName
from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import CLONED, OPERATORS, PERSON, UNIMPAIRED
from wasp_cli.plan.keys import key_of, recipe_of
from wasp_cli.plan.node import Cell, Node, Part, driver_label, sort_of, with_upstream
from wasp_cli.plan.source import PACKAGE, closure_hash, data_hashes
from wasp_cli.plan.syntax import keep_sources
from wasp_cli.registry import load_target, module_of
from wasp_cli.spec.model import Spec
from wasp_cli.spec.own_units import AUTO
from wasp_cli.stages.base import Stage
from wasp_cli.stages.registry import STAGES
from wasp_cli.store.published import Reused
from wasp_cli.store.severities import SEVERITY
from wasp_cli.tasks.declared import ENVIRONMENT
from wasp_cli.tasks.registry import TASKS

CALIBRATED_VARIANT = "full"
"""Ablations share the thresholds of the method that they ablate, unless theirs have another
unit (`MethodInfo.own_thresholds`).
"""
OPERATING = "operating"  # the stage that chooses an operating point before a cell is evaluated
REFERENCES = "references"
"""The name under which a node that chooses a severity reads what random commands and the
unimpaired expert return.
"""
SILENT = "human"
ALONE = "alone"
"""The method that executes the commands as they are, and the name under which the operating points
of all others read its held-out episodes.
"""
COUNTERFACTUAL = "counterfactual"  # the stage that runs for every cell whose method may intervene
CLONE = "clone"
FITTING = "wasp_cli.learning.clone"
"""The stage of a person's clone, which `wasp clone` makes, and the module that fits it, which
is therefore in its key.
"""
# the name under which a node reads the clone of the person who drives in it
OPERATOR_CLONE = "operator_clone"


@dataclass(frozen=True)
class Grid:
    """What a spec asks for: its cells, each with its evaluation node, what else it trains, and
    every node behind them.
    """

    cells: tuple[tuple[Cell, Node], ...]
    nodes: tuple[Node, ...]  # each once, needed ones first
    named: tuple[Node, ...]  # what the spec trains by name
    # the cells whose interventions are to be judged, each with the node of its branches
    branched: tuple[tuple[Cell, Node], ...]
    # combinations that the spec writes down: the unimpaired reference counts for every operator
    # there, and once in `cells`
    points: int
    presets: Mapping[str, str]  # by key of a node, that of its spec: for estimates, and in no key
    # by key, the published results that stand in the place of nodes
    reused: Mapping[str, Reused] = field(default_factory=dict)
    # what plans and runs tell of it: sizes that a preset replaces, published results that cannot
    # be used
    notes: tuple[str, ...] = ()

    @property
    def targets(self) -> frozenset[str]:
        """The keys of what the spec asks for. The other nodes are there because these need them."""
        return frozenset(
            node.key for node in (*self.named, *(node for _, node in (*self.cells, *self.branched)))
        )

    @property
    def parts(self) -> list[tuple[Part, Node]]:
        """The trained parts of the grid, each with its node; without evaluations."""
        return [
            (Part(node.task, node.kind, node.seed), node)
            for node in self.nodes
            if STAGES[node.kind].unit == "chain"
        ]


def lay_out(spec: Spec, reuse: Mapping[str, str] | None = None) -> Grid:
    """Return every cell of a spec, every stage that it names, and all nodes that these need, each
    node once.

    `reuse` has, by recipe, the key of a published result that replaces a node; the keys of nodes
    that are computed from it contain that key.
    """
    spec.declare_tasks()
    builder = _Builder(spec, reuse or {})
    cells = [(cell, builder.evaluation(cell)) for cell in cells_of(spec)]
    branched = []
    if COUNTERFACTUAL in spec.stages:
        branched = [
            (cell, builder.branches(cell, node))
            for cell, node in cells
            if METHODS[cell.method].intervenes
        ]
    trained = [kind for kind in spec.stages if STAGES[kind].unit == "chain"]
    seeds = dict.fromkeys(map(spec.chain_seed, spec.seeds))
    named = [
        builder.training(kind, task, seed)
        for task, seed, kind in product(spec.tasks, seeds, trained)
    ]
    nodes = with_upstream([*(node for _, node in cells), *named, *(node for _, node in branched)])
    severities = sum(map(len, spec.operators.values()))
    assistants = sum(len(spec.variants_of(method)) for method in spec.methods)
    points = len(spec.tasks) * len(spec.seeds) * assistants * max(severities, 1)
    keep_sources()
    return Grid(
        cells=tuple(cells),
        nodes=tuple(nodes),
        named=tuple(named),
        branched=tuple(branched),
        points=points,
        presets={node.key: spec.preset for node in nodes},
    )


def together(grids: Sequence[Grid]) -> Grid:
    """Return what several specs ask for as one grid, with every node once."""
    cells = {node.key: (cell, node) for grid in grids for cell, node in grid.cells}
    branched = {node.key: (cell, node) for grid in grids for cell, node in grid.branched}
    named = {node.key: node for grid in grids for node in grid.named}
    return Grid(
        cells=tuple(cells.values()),
        nodes=tuple(with_upstream(node for grid in grids for node in grid.nodes)),
        named=tuple(named.values()),
        branched=tuple(branched.values()),
        points=sum(grid.points for grid in grids),
        presets={key: preset for grid in grids for key, preset in grid.presets.items()},
        reused={key: reused for grid in grids for key, reused in grid.reused.items()},
        notes=tuple(dict.fromkeys(note for grid in grids for note in grid.notes)),
    )


def cells_of(spec: Spec) -> Iterable[Cell]:
    """Yield the cells of a spec. A method to which the operator's errors make no difference has one
    for each seed, with the unimpaired operator.
    """
    impaired = [
        (operator, name, value)
        for operator, severities in spec.operators.items()
        for name, value in severities.items()
    ]
    for task, method in product(spec.tasks, spec.methods):
        operators = impaired if METHODS[method].impaired else [(UNIMPAIRED, None, None)]
        for variant, (operator, severity, value), seed in product(
            spec.variants_of(method), operators, spec.seeds
        ):
            yield Cell(task, method, variant, operator, severity, value, seed)


class Section(NamedTuple):
    """Settings as a stage reads them, and as a key has them: without defaults, and without settings
    that change no result.
    """

    values: dict[str, Any]
    identity: dict[str, Any]


def _section(config: Config) -> Section:
    return Section(config.model_dump(mode="json"), config.identity())


class _Builder:
    """Builds the nodes of one spec; nodes that cells share are built once.

    Each method says what its node reads, and which `code` (import strings by name) computes it
    besides its stage and its task.
    """

    def __init__(self, spec: Spec, reuse: Mapping[str, str]) -> None:
        self.spec = spec
        self.reuse = reuse
        self.config = cache(lambda kind, task: _section(spec.stage(kind, task)))
        self.method = cache(
            lambda method, variant, task: _section(spec.method(method, variant, task))
        )
        self.settings = cache(self._settings)
        self.training = cache(self._training)
        self.calibration = cache(self._calibration)
        self.operating = cache(self._operating)
        self.severity = cache(self._severity)
        self.clone = cache(self._clone)
        self.assistant = cache(self._assistant)

    def evaluation(self, cell: Cell) -> Node:
        """Return the node that evaluates a cell."""
        chain = self.spec.chain_seed(cell.seed)
        code = {cell.method: METHODS[cell.method].target} | _operators([cell.operator])
        config = self.method(cell.method, cell.variant, cell.task).values
        axes = {
            "method": cell.method,
            "method_config": config,
            "operator": cell.operator,
            "value": cell.value,
            **_plugins(code),
        }
        needs: Mapping[str, Node] = self.assistant(cell.task, chain, cell.method, cell.variant)
        if cell.operator == CLONED:
            needs = {**needs, OPERATOR_CLONE: self.clone(cell.task, chain, cell.value)}
        if cell.value == AUTO:
            needs = {**needs, SEVERITY: self.severity(cell.task, chain, cell.operator)}
        return self.node(
            "evaluate", cell.task, cell.seed, axes, needs, code, cell.who, cell.variant
        )

    def branches(self, cell: Cell, evaluation: Node) -> Node:
        """Return the node that judges the interventions of a cell by counterfactual branches."""
        chain = self.spec.chain_seed(cell.seed)
        needs = self._inputs(COUNTERFACTUAL, cell.task, chain) | {evaluation.kind: evaluation}
        # a person cannot be asked again: in the branches the clone goes on
        if cell.operator in (CLONED, PERSON):
            needs[OPERATOR_CLONE] = self.clone(cell.task, chain, cell.value)
        if cell.value == AUTO:
            needs[SEVERITY] = self.severity(cell.task, chain, cell.operator)
        # The assistant is not asked again: its code is in the key through the evaluation alone.
        code = _operators([cell.operator])
        label = f"{COUNTERFACTUAL} {cell.who}"
        axes = evaluation.axes
        return self.node(
            COUNTERFACTUAL, cell.task, cell.seed, axes, needs, code, label, cell.variant
        )

    def _assistant(self, task: str, chain: int, method: str, variant: str) -> Mapping[str, Node]:
        info = METHODS[method]
        needs = self._inputs("evaluate", task, chain, method, variant)
        # Ablations share the operating point of what they ablate as they share its thresholds.
        shared = variant if variant in info.own_thresholds else CALIBRATED_VARIANT
        if info.calibrated:
            needs["calibration"] = self.calibration(task, chain, method, shared)
        if self.spec.chooses_point(task, method):
            needs[OPERATING] = self.operating(task, chain, method, shared)
        return needs

    def _operating(self, task: str, seed: int, method: str, variant: str) -> Node:
        info = METHODS[method]
        drivers = self.config(OPERATING, task).values["operators"]
        code = {method: info.target} | _operators(drivers)
        axes = {
            "method": method,
            "method_config": self.method(method, variant, task).values,
            **_plugins(code),
        }
        needs = self._inputs(OPERATING, task, seed, method, variant)
        if method == SILENT:
            label = f"{OPERATING} operators alone"
            return self.node(OPERATING, task, seed, axes, needs, code, label, variant)
        knob = self.spec.knob(task, method)
        if knob is not None:
            axes["knob"] = {
                "symbol": knob.symbol,
                "turns": knob.turns,
                "name": knob.name,
                "values": list(knob.values),
            }
        if info.calibrated:
            needs["calibration"] = self.calibration(task, seed, method, variant)
        needs[ALONE] = self.operating(task, seed, SILENT, CALIBRATED_VARIANT)
        label = f"{OPERATING} {method if variant == CALIBRATED_VARIANT else f'{method}/{variant}'}"
        return self.node(OPERATING, task, seed, axes, needs, code, label, variant)

    def _severity(self, task: str, seed: int, operator: str) -> Node:
        code = _operators([operator])
        axes: dict[str, Any] = {"operator": operator, **_plugins(code)}
        needs = self._inputs(SEVERITY, task, seed)
        if operator == UNIMPAIRED:
            label = f"{SEVERITY} expert and random commands"
            return self.node(SEVERITY, task, seed, axes, needs, code, label)
        info = OPERATORS[operator]
        tried = list(info.ladder())
        if info.between == "checkpoints":
            earlier = self.config("expert", task).values["checkpoints"][:-1]
            tried = sorted(earlier, reverse=True)
        # Registries are in no key: what is tried is, in this way.
        axes["ladder"] = {
            "tried": tried,
            "harmless": info.harmless,
            "between": info.between,
            "high": info.high,
        }
        needs[REFERENCES] = self.severity(task, seed, UNIMPAIRED)
        return self.node(SEVERITY, task, seed, axes, needs, code, f"{SEVERITY} {operator}")

    def _calibration(self, task: str, seed: int, method: str, variant: str) -> Node:
        code = {method: METHODS[method].target}
        axes = {
            "method": method,
            "method_config": self.method(method, variant, task).values,
            **_plugins(code),
        }
        label = f"calibration {method if variant == CALIBRATED_VARIANT else f'{method}/{variant}'}"
        needs = self._inputs("calibration", task, seed, method, variant)
        if axes["method_config"].get("tau_c") == AUTO:  # it follows from what incidents there are
            needs |= {"dataset": self.training("dataset", task, seed)}
        return self.node("calibration", task, seed, axes, needs, code, label, variant)

    def _training(self, kind: str, task: str, seed: int) -> Node:
        # A stage that mixes operators finds them by the names in its section.
        operators = self.config(kind, task).values.get("operators", {})
        code = {kind: STAGES[kind].target} | _operators(operators)
        needs = self._inputs(kind, task, seed)
        return self.node(kind, task, seed, _plugins(code), needs, code, kind)

    def _clone(self, task: str, seed: int, value: float | str | None) -> Node:
        axes = {"operator": PERSON, "value": value}
        code = _operators([PERSON]) | {CLONE: FITTING}
        label = f"{CLONE} {driver_label(PERSON, value)}"
        return self.node(CLONE, task, seed, axes, self._inputs(CLONE, task, seed), code, label)

    def _inputs(
        self, kind: str, task: str, seed: int, method: str = "", variant: str = ""
    ) -> dict[str, Node]:
        """The trained parts that a stage reads, by kind, with those that a method asks for; a
        plugin may name one wrong.
        """
        stage = stage_class(kind)
        asked = [(name, f"the stage '{kind}'") for name in stage.needs]
        if TASKS[task].informed:
            asked += [
                (name, f"the stage '{kind}'") for name in getattr(stage, "needs_informed", ())
            ]
        if AUTO in self.config(kind, task).values.values():
            asked += [(name, f"the stage '{kind}'") for name in getattr(stage, "needs_auto", ())]
        if method:
            config = self.method(method, variant, task).values
            asked += [(name, f"the method '{method}'") for name in METHODS[method].needs_of(config)]
        known = [name for name, info in STAGES.items() if info.unit == "chain"]
        for name, whose in asked:
            if name not in known:
                raise UnknownName("stage", name, known, f"{whose} needs an unknown stage '{name}'")
        return {name: self.training(name, task, seed) for name, _ in asked}

    def _settings(self, kind: str) -> Section:
        values = {name: getattr(self.spec, name) for name in stage_class(kind).settings}
        sections = {
            name: _section(value) if isinstance(value, Config) else Section(value, value)
            for name, value in values.items()
        }
        return Section(
            *({name: section[form] for name, section in sections.items()} for form in (0, 1))
        )

    def _of_task(self, settings: Section, task: str, reads_images: bool) -> Section:
        """The shared settings as they are on a task, with what the spec says of its environment."""
        declaration = self.spec.environments.get(task)
        if declaration is None:
            return settings
        own: dict[str, Any] = {}
        if "action_repeat" in settings.values:
            own["action_repeat"] = self.spec.repeat_of(task)
        if declaration.is_bare:
            return Section({**settings.values, **own}, {**settings.identity, **own})
        values = {**settings.values, **own, ENVIRONMENT: declaration.plain()}
        if reads_images:
            own[ENVIRONMENT] = declaration.plain()
        else:
            own[ENVIRONMENT] = TASKS[task].identity_without_image(declaration)
        return Section(values, {**settings.identity, **own})

    def node(
        self,
        kind: str,
        task: str,
        seed: int,
        axes: Mapping[str, Any],
        needs: Mapping[str, Node],
        code: Mapping[str, str],
        label: str,
        variant: str = "",
    ) -> Node:
        """Return a node with its key; `variant` is that of its method, where it has one."""
        info = TASKS[task]
        roots = {module_of(STAGES[kind].target), *info.modules, *map(module_of, code.values())}
        modules = tuple(sorted(roots))
        # Who reads no image is not trained again for another camera.
        without = () if STAGES[kind].reads_images else info.image_modules
        config = self.config(kind, task)
        settings = self._of_task(self.settings(kind), task, STAGES[kind].reads_images)
        axes_of_key = dict(axes)
        if variant:  # a key has the values that differ from the defaults
            axes_of_key["method_config"] = self.method(axes["method"], variant, task).identity
        identity = {
            "kind": kind,
            "task": info.facts(without),
            "seed": seed,
            "axes": axes_of_key,
            "config": config.identity,
            "settings": settings.identity,
        }
        data = data_hashes(modules, without)
        if data:  # what a world is made of is no version of the code
            identity["data"] = data
        recipe = recipe_of(
            {**identity, "upstream": {name: needed.recipe for name, needed in needs.items()}}
        )
        key = self.reuse.get(recipe)
        if key is None:
            upstream = {name: needed.key for name, needed in needs.items()}
            code_hash = closure_hash(modules, without)
            key = key_of({**identity, "upstream": upstream, "code": code_hash})
        sort = sort_of(kind, task, config.values, axes)
        return Node(
            kind=kind,
            task=task,
            seed=seed,
            axes=axes,
            config=config.values,
            settings=settings.values,
            needs=needs,
            modules=modules,
            key=key,
            label=f"{task} s{seed} {label}",
            sort=sort,
            recipe=recipe,
            without=without,
        )


def _operators(names: Iterable[str]) -> dict[str, str]:
    return {name: OPERATORS[name].target for name in names if name in OPERATORS}


def _plugins(code: Mapping[str, str]) -> dict[str, Any]:
    """What plugins name, as an axis: a key covers a module's source, but not which of its
    classes an entry point means.
    """
    plugins = {
        name: target
        for name, target in sorted(code.items())
        if module_of(target).partition(".")[0] != PACKAGE
    }
    return {"plugins": plugins} if plugins else {}


@cache
def stage_class(kind: str) -> type[Stage]:
    """Return the class of a stage. It is imported, so a plugin's code runs."""
    stage: type[Stage] = load_target(STAGES[kind].target)
    return stage
