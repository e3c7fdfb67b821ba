"""A cell of a results folder: what it is, where its rows are, and who asked for it."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, replace

from wasp_cli.errors import ArtifactError
from wasp_cli.metrics.severity import AUTO
from wasp_cli.plan.node import Cell, cell_label
from wasp_cli.store.artifact import read_manifest, stored_keys
from wasp_cli.store.find import KIND
from wasp_cli.store.layout import Layout, is_key
from wasp_cli.store.severities import is_auto, severity_of
from wasp_cli.store.tables import CellIdentity

BRANCHES = "counterfactual"  # the kind of node that tests the interventions of a cell


@dataclass(frozen=True)
class RecordedCell(CellIdentity):
    """A cell as its spec names it; the names are those of `--select`."""

    key: str = ""  # of the artifact with its rows
    spec: str | None = None  # None where the folder has no runs: of published results, or of copies
    severity: str | None = None  # the spec's name of the value
    branches: str | None = None  # key of its counterfactual branches, where they were asked for
    # whether its value was chosen (`auto` in the spec): None until it is
    chosen: bool = False
    # the seed of the training whose models it uses; None: the cell's own
    training_seed: int | None = None

    @property
    def identity(self) -> CellIdentity:
        """What its rows have in common."""
        return CellIdentity(
            self.task, self.method, self.variant, self.operator, self.value, self.seed
        )

    @property
    def training(self) -> int:
        """The seed of the training whose models it uses: cells of several seeds share one where
        the spec has `training_seed`.
        """
        return self.seed if self.training_seed is None else self.training_seed

    @property
    def label(self) -> str:
        """As a run prints it: `goal1 s0 wasp laggy=auto`."""
        value = AUTO if self.chosen else self.value
        who = cell_label(self.method, self.variant, self.operator, value)
        return f"{self.task} s{self.seed} {who}"

    @property
    def title(self) -> str:
        """As a report prints it, with the severity that was chosen."""
        value = AUTO if self.chosen and self.value is None else self.value
        who = cell_label(self.method, self.variant, self.operator, value)
        return f"{self.task} {who} seed {self.seed}"


def recorded_cell(
    layout: Layout,
    cell: Cell,
    key: str,
    spec: str,
    branches: str | None = None,
    training_seed: int | None = None,
) -> RecordedCell:
    """Return a cell of a grid as one of a results folder: with the severity that was chosen for it,
    if it is computed.

    Args:
        layout: of the results folder.
        cell: as the grid has it.
        key: of its artifact.
        spec: the name of the spec that asks for it.
        branches: the key of its counterfactual branches, where the spec asks for them.
        training_seed: the seed of the training that all seeds of the spec share; None: each has
            its own.
    """
    chosen = cell.value == AUTO
    value = None if isinstance(cell.value, str) else cell.value
    recorded = RecordedCell(
        cell.task,
        cell.method,
        cell.variant,
        cell.operator,
        value,
        cell.seed,
        key=key,
        spec=spec,
        severity=cell.severity,
        branches=branches,
        chosen=chosen,
        training_seed=training_seed,
    )
    if not chosen or not is_key(key) or not layout.manifest(KIND, key).is_file():
        return recorded
    # A damaged manifest keeps `auto`: who reads the rows says what is wrong.
    with suppress(ArtifactError, LookupError, TypeError, ValueError):
        return replace(recorded, value=severity_of(read_manifest(layout, KIND, key)))
    return recorded


def stored_cells(layout: Layout) -> list[RecordedCell]:
    """List the cells in the store of a results folder, whoever asked for them, by their keys. One
    whose manifest does not read is left out.
    """
    branches = _stored_branches(layout)
    cells: list[RecordedCell] = []
    for key in _keys(layout, KIND):
        with suppress(ArtifactError, KeyError, TypeError, ValueError, AttributeError):
            manifest = read_manifest(layout, KIND, key)
            axes = manifest["axes"]
            cell = RecordedCell(
                task=str(manifest["task"]),
                method=str(axes["method"]),
                variant=str(axes["method_config"].get("variant", "full")),
                operator=str(axes["operator"]),
                value=severity_of(manifest),
                seed=int(manifest["seed"]),
                key=key,
                branches=branches.get(key),
                chosen=is_auto(manifest),
            )
            cells.append(cell)
    return cells


def _stored_branches(layout: Layout) -> dict[str, str]:
    """By key of a cell, the key of its counterfactual branches in the store."""
    branches: dict[str, str] = {}
    for key in _keys(layout, BRANCHES):
        with suppress(ArtifactError, KeyError, TypeError, AttributeError):
            branches[str(read_manifest(layout, BRANCHES, key)["upstream"][KIND])] = key
    return branches


def _keys(layout: Layout, kind: str) -> Iterable[str]:
    return sorted(key for key in stored_keys(layout, kind) if is_key(key))
