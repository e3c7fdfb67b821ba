"""What a plan is made of: cells of the grid, trained parts, the nodes that compute both, and their keys.

A key is a hash over everything that decides a node's bytes, and nothing else. In it: what the node is, its resolved configuration, the
keys of what it reads, the source of what it runs, and the major and minor versions of the libraries that compute. Not in it: the name of
the spec and of its severities, the order of lists, paths, workers, devices.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any

SCHEMA = 1  # raised when the meaning of artifacts changes in a way that no other part of the key shows
LIBRARIES = ("mujoco", "numpy", "stable-baselines3", "torch")
LENGTH = 20


def canonical(value: Any) -> str:
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def digest(value: Any, length: int = LENGTH) -> str:
    return hashlib.sha256(canonical(value).encode()).hexdigest()[:length]


def key_of(identity: Mapping[str, Any]) -> str:
    return digest({**identity, "schema": SCHEMA, "libraries": libraries()})


def recipe_of(identity: Mapping[str, Any]) -> str:
    """Return what `identity` describes, whatever code and libraries compute it; its upstream are the recipes of what it reads."""
    return digest({**identity, "schema": SCHEMA})


@cache
def libraries() -> dict[str, str]:
    return {name: minor(_installed(name)) for name in LIBRARIES}


def _installed(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def minor(version: object) -> str:
    return ".".join(version.split(".")[:2]) if isinstance(version, str) else "absent"


@dataclass(frozen=True, order=True, slots=True)
class Cell:
    """One point of the evaluation grid: who assists whom, where, with which seed."""

    task: str
    method: str
    assistant: str  # ablation of the method; 'full' for the method itself
    operator: str  # operator variant; `UNIMPAIRED` for the reference row
    severity: str | None  # name of the severity in the spec; enters no key
    value: float | None
    seed: int

    def __str__(self) -> str:
        return f"{self.task} {self.who} seed {self.seed}"

    @property
    def who(self) -> str:
        return cell_label(self.method, self.assistant, self.operator, self.value)


def cell_label(method: str, variant: str, operator: str, value: float | None) -> str:
    """Say who assists whom: `wasp/no-case2 laggy=0.7`."""
    assistant = method if variant == "full" else f"{method}/{variant}"
    return f"{assistant} {driver_label(operator, value)}"


def driver_label(operator: str, value: float | None) -> str:
    """Say who drives: `laggy=0.7`, or `unimpaired`."""
    return "unimpaired" if value is None else f"{operator}={value:g}"


@dataclass(frozen=True, order=True, slots=True)
class Part:
    task: str
    kind: str
    seed: int  # the seed of the training chain

    def __str__(self) -> str:
        return f"{self.task} s{self.seed} {self.kind}"


@dataclass(frozen=True, eq=False, slots=True)
class Node:
    """One run of one stage. Two nodes with the same key produce the same bytes, so the key is the node."""

    kind: str
    task: str
    seed: int
    axes: Mapping[str, Any]  # what else identifies it: method, method_config, operator variant, value (evaluate, calibration)
    config: Mapping[str, Any]
    settings: Mapping[str, Any]
    needs: Mapping[str, Node]  # the nodes whose artifacts it reads, by the name under which its stage reads them: mostly their kind
    modules: tuple[str, ...]  # where its code begins; its key covers what these import
    key: str
    label: str  # for people: `goal1 s0 world_model`
    sort: str  # nodes of a sort take about as long: the same stage, task and method at the same sizes, whatever the seed and the operator

    recipe: str = ""  # what it is, whatever code computes it

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Node) and other.key == self.key

    def __str__(self) -> str:
        return self.label


def with_upstream(nodes: Iterable[Node]) -> list[Node]:
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
    """Return what `Node.sort` is; a manifest tells the same four things of a node that was computed."""
    return digest([kind, task, config, axes.get("method"), axes.get("method_config"), axes.get("round")], 16)
