"""A spec to its cells, cells to the nodes that compute them, and which of them `--select task=race1,method=wasp|ida` means."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from itertools import product
from typing import Any, NamedTuple

from wasp_cli.config import Config
from wasp_cli.errors import UnknownName, UsageError
from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import CLONED, OPERATORS, PERSON, UNIMPAIRED
from wasp_cli.plan.closure import PACKAGE, closure_hash
from wasp_cli.plan.node import Cell, Node, Part, driver_label, key_of, recipe_of, sort_of, with_upstream
from wasp_cli.registry import load_target, module_of
from wasp_cli.spec.model import Spec
from wasp_cli.stages.base import Stage
from wasp_cli.stages.registry import STAGES
from wasp_cli.store.published import Reused
from wasp_cli.tasks.registry import TASKS

CALIBRATED_VARIANT = "full"
"""Ablations share the thresholds of the method that they ablate, unless theirs have another unit (`MethodInfo.own_thresholds`)."""
COUNTERFACTUAL = "counterfactual"  # the stage that runs for every cell whose method may intervene
CLONE, FITTING = "clone", "wasp_cli.learning.clone"
"""The stage of a person's clone, which `wasp clone` makes, and the module that fits it, which is therefore in its key."""
OPERATOR_CLONE = "operator_clone"  # the name under which a node reads the clone of the person who drives in it


@dataclass(frozen=True)
class Grid:
    """What a spec asks for: its cells, each with its evaluation node, what else it trains, and every node behind them."""

    cells: tuple[tuple[Cell, Node], ...]
    nodes: tuple[Node, ...]  # each once, needed ones first
    named: tuple[Node, ...]
    points: int
    """Combinations that the spec writes down; the unimpaired reference counts once for every operator there, and once in `cells`."""
    recipes: Mapping[str, str] = field(default_factory=dict)  # by key, what a node is without the code that computes it: `keys.recipe_of`
    reused: Mapping[str, Reused] = field(default_factory=dict)  # by key, the published results that stand in the place of nodes
    notes: tuple[str, ...] = ()  # published results that cannot be used, each with the reason
    branched: tuple[tuple[Cell, Node], ...] = ()
    """The cells whose interventions are to be judged, each with the node of its counterfactual branches."""
    preset: str = "cpu"  # of the spec: for estimates, and in no key

    @property
    def targets(self) -> frozenset[str]:
        """The keys of what the spec asks for; the other nodes are there for these."""
        return frozenset(
            [*(node.key for _, node in self.cells), *(node.key for node in self.named), *(node.key for _, node in self.branched)]
        )

    @property
    def parts(self) -> list[tuple[Part, Node]]:
        """What is trained, needed parts first."""
        return [(Part(node.task, node.kind, node.seed), node) for node in self.nodes if STAGES[node.kind].unit == "chain"]


def lay_out(spec: Spec, reuse: Mapping[str, str] | None = None) -> Grid:
    """Return every cell of a spec, every stage that it names, and every node behind them, each node once.

    `reuse` has, by recipe, the key of a published result that stands in the place of a node; keys of what is computed from it say so.
    """
    builder = _Builder(spec, reuse or {})
    cells = [(cell, builder.evaluation(cell)) for cell in cells_of(spec)]
    severities = sum(len(values) for values in spec.operators.values())
    per_seed = sum(len(spec.variants_of(method)) for method in spec.methods) * max(severities, 1)
    trained = [kind for kind in spec.stages if STAGES[kind].unit == "chain"]
    named = [builder.training(kind, task, seed) for task, seed, kind in product(spec.tasks, spec.chain_seeds(), trained)]
    judged = [(cell, node) for cell, node in cells if METHODS[cell.method].intervenes] if COUNTERFACTUAL in spec.stages else []
    branched = [(cell, builder.branches(cell, node)) for cell, node in judged]
    nodes = with_upstream([*(node for _, node in cells), *named, *(node for _, node in branched)])
    points = len(spec.tasks) * len(spec.seeds) * per_seed
    return Grid(tuple(cells), tuple(nodes), tuple(named), points, builder.recipes, branched=tuple(branched), preset=spec.preset)


def together(grids: Sequence[Grid]) -> Grid:
    """Return what several specs ask for: what they share is there once."""
    cells = {node.key: (cell, node) for grid in grids for cell, node in grid.cells}
    nodes = with_upstream([node for grid in grids for node in grid.nodes])
    named = {node.key: node for grid in grids for node in grid.named}
    branched = {node.key: (cell, node) for grid in grids for cell, node in grid.branched}
    return Grid(
        tuple(cells.values()),
        tuple(nodes),
        tuple(named.values()),
        sum(grid.points for grid in grids),
        {key: recipe for grid in grids for key, recipe in grid.recipes.items()},
        {key: reused for grid in grids for key, reused in grid.reused.items()},
        tuple(dict.fromkeys(note for grid in grids for note in grid.notes)),
        tuple(branched.values()),
        grids[0].preset,
    )


def cells_of(spec: Spec) -> Iterable[Cell]:
    """Yield the cells of a spec in its own order."""
    impaired = [(variant, name, value) for variant, severities in spec.operators.items() for name, value in severities.items()]
    for task, method in product(spec.tasks, spec.methods):
        operators = impaired if METHODS[method].impaired else [(UNIMPAIRED, None, None)]
        for assistant, (operator, severity, value), seed in product(spec.variants_of(method), operators, spec.seeds):
            yield Cell(task, method, assistant, operator, severity, value, seed)


class _Builder:
    """Builds nodes of one spec; what cells share is built once."""

    def __init__(self, spec: Spec, reuse: Mapping[str, str]) -> None:
        self.spec = spec
        self.reuse = reuse
        self.recipes: dict[str, str] = {}
        self.config = cache(lambda kind, task: spec.stage(kind, task).model_dump(mode="json"))
        self.identity = cache(lambda kind, task: spec.stage(kind, task).identity())
        self.settings = cache(lambda kind: self._settings(kind, partial(Config.model_dump, mode="json")))
        self.settings_identity = cache(lambda kind: self._settings(kind, Config.identity))
        self.method_config = cache(lambda method, variant, task: spec.method(method, variant, task).model_dump(mode="json"))
        self.method_identity = cache(lambda method, variant, task: spec.method(method, variant, task).identity())
        self.training = cache(self._training)
        self.calibration = cache(self._calibration)
        self.clone = cache(self._clone)
        self.assisted = cache(self._assisted)

    def evaluation(self, cell: Cell) -> Node:
        """Return the node that computes a cell, from the training chain of its seed."""
        chain, info, targets = self.spec.chain_seed(cell.seed), METHODS[cell.method], _operator_targets([cell.operator])
        axes = {
            "method": cell.method,
            "method_config": self.method_config(cell.method, cell.assistant, cell.task),
            "operator": cell.operator,
            "value": cell.value,
        }
        axes |= _plugins({cell.method: info.target} | targets)
        needs: Mapping[str, Node] = self.assisted(cell.task, chain, cell.method, cell.assistant)
        if cell.operator == CLONED:
            needs = {**needs, OPERATOR_CLONE: self.clone(cell.task, chain, cell.value)}
        roots = (module_of(info.target), *_roots(targets))
        return self._node("evaluate", cell.task, cell.seed, axes, needs, roots, cell.who, cell.assistant)

    def branches(self, cell: Cell, evaluation: Node) -> Node:
        """Return the node that branches the interventions of an evaluated cell."""
        chain = self.spec.chain_seed(cell.seed)
        needs = self._inputs(COUNTERFACTUAL, cell.task, chain) | {evaluation.kind: evaluation}
        if cell.operator in (CLONED, PERSON):  # a person cannot be asked again: in the branches the clone goes on
            needs[OPERATOR_CLONE] = self.clone(cell.task, chain, cell.value)
        label = f"{COUNTERFACTUAL} {cell.who}"
        # The assistant is not asked again: its code is in the key through the evaluation alone.
        roots = _roots(_operator_targets([cell.operator]))
        return self._node(COUNTERFACTUAL, cell.task, cell.seed, evaluation.axes, needs, roots, label, cell.assistant)

    def _assisted(self, task: str, chain: int, method: str, assistant: str) -> Mapping[str, Node]:
        """What all evaluations of one assistant on one training chain read."""
        info = METHODS[method]
        config = self.method_config(method, assistant, task)
        needs = self._inputs("evaluate", task, chain, _known(info.needs_of(config), f"the method '{method}'"))
        if info.calibrated:
            variant = assistant if assistant in info.own_thresholds else CALIBRATED_VARIANT
            needs["calibration"] = self.calibration(task, chain, method, variant)
        return needs

    def _calibration(self, task: str, seed: int, method: str, variant: str) -> Node:
        info = METHODS[method]
        config = self.method_config(method, variant, task)
        axes = {"method": method, "method_config": config} | _plugins({method: info.target})
        needs = self._inputs("calibration", task, seed, _known(info.needs_of(config), f"the method '{method}'"))
        name = method if variant == CALIBRATED_VARIANT else f"{method}/{variant}"
        return self._node("calibration", task, seed, axes, needs, (module_of(info.target),), f"calibration {name}", variant)

    def _training(self, kind: str, task: str, seed: int) -> Node:
        # A stage that mixes operators finds them by the names in its section.
        operators = _operator_targets(self.config(kind, task).get("operators", {}))
        axes = _plugins({kind: STAGES[kind].target} | operators)
        return self._node(kind, task, seed, axes, self._inputs(kind, task, seed), _roots(operators), kind)

    def _clone(self, task: str, seed: int, value: float | None) -> Node:
        """The clone of a participant; it is made by `wasp clone`, not by a run."""
        axes, roots = {"operator": PERSON, "value": value}, (*_roots(_operator_targets([PERSON])), FITTING)
        return self._node(CLONE, task, seed, axes, self._inputs(CLONE, task, seed), roots, f"{CLONE} {driver_label(PERSON, value)}")

    def _inputs(self, kind: str, task: str, seed: int, further: tuple[str, ...] = ()) -> dict[str, Node]:
        stage = stage_class(kind)
        own = (*stage.needs, *(getattr(stage, "needs_informed", ()) if TASKS[task].informed else ()))
        needed = dict.fromkeys((*_known(own, f"the stage '{kind}'"), *further))
        return {name: self.training(name, task, seed) for name in needed}

    def _settings(self, kind: str, form: Callable[[Config], dict[str, Any]]) -> dict[str, Any]:
        values = {name: getattr(self.spec, name) for name in stage_class(kind).settings}
        return {name: form(value) if isinstance(value, Config) else value for name, value in values.items()}

    def _node(
        self,
        kind: str,
        task: str,
        seed: int,
        axes: Mapping[str, Any],
        needs: Mapping[str, Node],
        roots: tuple[str, ...],
        label: str,
        variant: str = "",
    ) -> Node:
        """A node; `roots` are where its code begins beside its stage and its task, `variant` is that of its method."""
        modules = tuple(sorted({module_of(STAGES[kind].target), *TASKS[task].modules, *roots}))
        config = self.config(kind, task)
        named = {**axes, "method_config": self.method_identity(axes["method"], variant, task)} if variant else axes
        identity = {
            "kind": kind,
            "task": _task_facts(task),
            "seed": seed,
            "axes": named,
            "config": self.identity(kind, task),
            "settings": self.settings_identity(kind),
            "upstream": {name: node.key for name, node in needs.items()},
            "code": closure_hash(modules),
        }
        recipe = recipe_of({**identity, "upstream": {name: self.recipes[node.key] for name, node in needs.items()}})
        key = self.reuse.get(recipe) or key_of(identity)
        self.recipes[key] = recipe
        sort = sort_of(kind, task, config, axes)
        return Node(kind, task, seed, axes, config, self.settings(kind), needs, modules, key, f"{task} s{seed} {label}", sort)


def _operator_targets(names: Iterable[str]) -> dict[str, str]:
    """Import strings by operator variant; the unimpaired operator has none."""
    return {name: OPERATORS[name].target for name in names if name in OPERATORS}


def _plugins(targets: Mapping[str, str]) -> dict[str, Any]:
    """What plugins name, as an axis: a key covers a module's source, but not which of its classes an entry point means."""
    named = {name: target for name, target in sorted(targets.items()) if module_of(target).partition(".")[0] != PACKAGE}
    return {"plugins": named} if named else {}


def _roots(targets: Mapping[str, str]) -> tuple[str, ...]:
    """Where the code of what import strings name begins."""
    return tuple(map(module_of, targets.values()))


def _known(needs: tuple[str, ...], whose: str) -> tuple[str, ...]:
    """The stages that a method or a stage needs; a plugin may have one wrong."""
    known = [name for name, info in STAGES.items() if info.unit != "person"]
    for name in needs:
        if name not in known:
            raise UnknownName("stage", name, known, f"{whose} needs an unknown stage '{name}'")
    return needs


@cache
def stage_class(kind: str) -> type[Stage]:
    """Return the class of a stage (light: heavy imports are inside its `run`)."""
    stage: type[Stage] = load_target(STAGES[kind].target)
    return stage


@cache
def _task_facts(task: str) -> Mapping[str, Any]:
    return TASKS[task].facts()


FIELDS = ("task", "method", "variant", "operator", "severity", "value", "seed", "stage")
EXAMPLE = "for example --select 'task=race1,method=wasp' or --select 'stage=world_model'"


class Condition(NamedTuple):
    """One `field=value`, several values with `|` between them, or `field!=value`."""

    field: str
    values: tuple[str, ...]
    excluding: bool

    def holds(self, facts: Mapping[str, str]) -> bool:
        """Return whether a node with these facts is meant; one that has no such field is not."""
        return self.field in facts and (facts[self.field] in self.values) != self.excluding


def _condition(part: str, text: str) -> Condition:
    name, equals, rest = part.partition("=")
    excluding = name.endswith("!")
    name, values = name.removesuffix("!").strip(), tuple(value.strip() for value in rest.split("|"))
    if not equals or not name or not all(values):
        raise UsageError(f"--select: '{text}' is not of the form FIELD=VALUE,FIELD=VALUE,...", EXAMPLE)
    if name not in FIELDS:
        raise UnknownName("field to select by", name, FIELDS)
    return Condition(name, values, excluding)


def select(grid: Grid, texts: Sequence[str]) -> frozenset[str] | None:
    """Return the keys of the nodes that are meant: cells with their branches, and what the spec trains by name, or with `stage` any node.

    Without selectors it is None.
    """
    if not texts:
        return None
    # A node has to meet every condition of one of the texts.
    selectors = [[_condition(part, text) for part in text.split(",")] for text in texts]
    candidates = list(_candidates(grid))
    targets = grid.targets
    for condition in (condition for selector in selectors for condition in selector):
        known = {facts[condition.field] for _, facts in candidates if condition.field in facts}
        for value in condition.values:
            if value not in known:
                raise UnknownName(f"{condition.field} in this spec", value, known)
    selected = frozenset(
        key
        for key, facts in candidates
        for selector in selectors
        if (key in targets or any(condition.field == "stage" for condition in selector))
        and all(condition.holds(facts) for condition in selector)
    )
    if not selected:
        raise UsageError(f"--select: no node of the spec matches {' or '.join(texts)}", "wasp plan SPEC --all lists them")
    return selected


def _candidates(grid: Grid) -> Iterator[tuple[str, dict[str, str]]]:
    """Each node with what it can be selected by; a cell with two names of one severity comes twice."""
    of_cells = (*grid.cells, *grid.branched)
    cells = {node.key for _, node in of_cells}
    for cell, node in of_cells:
        facts = {"task": cell.task, "method": cell.method, "variant": cell.assistant, "operator": cell.operator, "seed": str(cell.seed)}
        if cell.severity is not None and cell.value is not None:
            facts |= {"severity": cell.severity, "value": f"{cell.value:g}"}
        yield node.key, facts | {"stage": node.kind}
    for node in grid.nodes:
        if node.key not in cells:
            facts = {"task": node.task, "seed": str(node.seed), "stage": node.kind}
            yield node.key, facts | ({"method": str(node.axes["method"])} if "method" in node.axes else {})
