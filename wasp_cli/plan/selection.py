"""The nodes of a grid that `--select` means."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from wasp_cli.errors import UnknownName, UsageError
from wasp_cli.plan.grid import Grid
from wasp_cli.spec.own_units import AUTO

FIELDS = ("task", "method", "variant", "operator", "severity", "value", "seed", "stage")
EXAMPLE = "for example --select 'task=race1,method=wasp' or --select 'stage=world_model'"


class Condition(NamedTuple):
    """One `field=value`, several values with `|` between them, or `field!=value`."""

    field: str
    values: tuple[str, ...]
    excluding: bool

    def holds(self, facts: Mapping[str, str]) -> bool:
        """Return whether a node with these facts is selected. A node without the field is not."""
        return self.field in facts and (facts[self.field] in self.values) != self.excluding


def _condition(part: str, text: str) -> Condition:
    name, equals, rest = part.partition("=")
    excluding = name.endswith("!")
    name = name.removesuffix("!").strip()
    values = tuple(value.strip() for value in rest.split("|"))
    if not equals or not name or not all(values):
        raise UsageError(
            f"--select: '{text}' is not of the form FIELD=VALUE,FIELD=VALUE,...", EXAMPLE
        )
    if name not in FIELDS:
        raise UnknownName("field to select by", name, FIELDS)
    return Condition(name, values, excluding)


def select(grid: Grid, texts: Sequence[str]) -> frozenset[str] | None:
    """Return the keys of the nodes that selectors mean: cells with their branches, and what the
    spec trains by name, or with `stage` any node. None without selectors.
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
    selected: set[str] = set()
    for selector in selectors:
        of_any_node = any(condition.field == "stage" for condition in selector)
        meant = (
            key
            for key, facts in candidates
            if all(condition.holds(facts) for condition in selector)
        )
        selected |= {key for key in meant if of_any_node or key in targets}
    if not selected:
        raise UsageError(
            f"--select: no node of the spec matches {' or '.join(texts)}",
            "wasp plan SPEC --all lists them",
        )
    return frozenset(selected)


def _candidates(grid: Grid) -> Iterator[tuple[str, dict[str, str]]]:
    """Each node with the facts that it can be selected by. A cell with two names of one severity is
    there twice.
    """
    of_cells = (*grid.cells, *grid.branched)
    cells = {node.key for _, node in of_cells}
    for cell, node in of_cells:
        facts = {
            "task": cell.task,
            "method": cell.method,
            "variant": cell.variant,
            "operator": cell.operator,
            "seed": str(cell.seed),
        }
        if cell.severity is not None and cell.value is not None:
            value = AUTO if cell.value == AUTO else f"{cell.value:g}"
            facts |= {"severity": cell.severity, "value": value}
        yield node.key, facts | {"stage": node.kind}
    for node in grid.nodes:
        if node.key not in cells:
            facts = {"task": node.task, "seed": str(node.seed), "stage": node.kind}
            facts |= {
                name: str(node.axes[name]) for name in ("method", "operator") if name in node.axes
            }
            yield node.key, facts
