"""What a plan is made of: cells of the grid, trained parts, and the nodes that compute both."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from wasp_cli.plan.keys import digest
from wasp_cli.plan.source import source_hashes


@dataclass(frozen=True, order=True, slots=True)
class Cell:
    """One point of the evaluation grid: who assists whom, where, with which seed."""

    task: str
    method: str
    variant: str  # of the method: 'full', or an ablation
    operator: str  # `UNIMPAIRED` for the reference row
    severity: str | None  # name of the severity in the spec; enters no key
    value: float | Literal["auto"] | None
    seed: int

    def __str__(self) -> str:
        return f"{self.task} {self.who} seed {self.seed}"

    @property
    def who(self) -> str:
        """The assistant with its ablation, and who drives."""
        return cell_label(self.method, self.variant, self.operator, self.value)


def cell_label(method: str, variant: str, operator: str, value: float | str | None) -> str:
    """Return the end of a cell's label: the assistant with its ablation, and who drives."""
    assistant = method if variant == "full" else f"{method}/{variant}"
    return f"{assistant} {driver_label(operator, value)}"


def driver_label(operator: str, value: float | str | None) -> str:
    """Return an operator and its severity as labels show them. `value` is None for the unimpaired
    operator, and `auto` if a stage chooses it.
    """
    if value is None:
        return "unimpaired"
    return f"{operator}={value}" if isinstance(value, str) else f"{operator}={value:g}"


@dataclass(frozen=True, order=True, slots=True)
class Part:
    """One trained part of the grid."""

    task: str
    kind: str
    seed: int  # the seed of the training chain

    def __str__(self) -> str:
        return f"{self.task} s{self.seed} {self.kind}"


@dataclass(frozen=True, eq=False, slots=True)
class Node:
    """One run of one stage. Two nodes with the same key produce the same bytes, so the key is
    the node.
    """

    kind: str
    task: str
    seed: int
    # what else identifies it: method, method_config, operator variant, value (evaluate,
    # calibration)
    axes: Mapping[str, Any]
    config: Mapping[str, Any]
    settings: Mapping[str, Any]
    # the nodes whose artifacts it reads, by the name under which its stage reads them: mostly their
    # kind
    needs: Mapping[str, Node]
    modules: tuple[str, ...]  # where its code begins; its key covers what these import
    key: str
    label: str  # for people: `goal1 s0 world_model`
    # nodes of a sort take about as long: the same stage, task and method at the same sizes,
    # whatever the seed and the operator
    sort: str
    recipe: str = ""  # what it is, whatever code computes it
    without: tuple[str, ...] = ()  # modules that its task imports and that it does not run

    @property
    def sources(self) -> dict[str, str]:
        """The hash by name of every module and data file of its code."""
        return source_hashes(self.modules, self.without)

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Node) and other.key == self.key

    def __str__(self) -> str:
        return self.label


def with_upstream(nodes: Iterable[Node]) -> list[Node]:
    """Return nodes with all nodes that they need, each once, needed ones first."""
    ordered: dict[str, Node] = {}

    def visit(node: Node) -> None:
        for needed in node.needs.values():
            if needed.key not in ordered:
                visit(needed)
        ordered[node.key] = node

    for node in nodes:
        if node.key not in ordered:
            visit(node)
    return list(ordered.values())


def sort_of(kind: str, task: str, config: Mapping[str, Any], axes: Mapping[str, Any]) -> str:
    """Return what `Node.sort` is, from four things that the manifest of a computed node has too."""
    return digest(
        [kind, task, config, axes.get("method"), axes.get("method_config"), axes.get("round")], 16
    )
