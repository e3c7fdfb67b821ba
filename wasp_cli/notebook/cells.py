"""Which cells a results folder has, from the plans of its runs alone: no table is read, no spec parsed, no plugin imported."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from wasp_cli.errors import ArtifactError, StoreError, UnknownName
from wasp_cli.plan.node import cell_label
from wasp_cli.store.artifact import read_manifest, read_record, stored_keys
from wasp_cli.store.find import KIND
from wasp_cli.store.layout import Layout, is_key
from wasp_cli.store.tables import CellIdentity, cell_file

BRANCHES = "counterfactual"  # the kind of node that tests the interventions of a cell

T = TypeVar("T")
Names = str | Iterable[str] | None
Numbers = float | Iterable[float] | None  # one value, several, or None for all


@dataclass(frozen=True)
class ListedCell(CellIdentity):
    """A cell as its spec names it; the names are those of `--select`."""

    key: str = ""
    spec: str | None = None  # None where the folder has no runs: of published results, or of copies
    severity: str | None = None  # the spec's name of the value
    branches: str | None = None  # key of its counterfactual branches, where they were asked for

    @property
    def label(self) -> str:
        """As `wasp run` prints it."""
        return f"{self.task} s{self.seed} {cell_label(self.method, self.variant, self.operator, self.value)}"

    @property
    def identity(self) -> CellIdentity:
        """As its rows name it."""
        return CellIdentity(self.task, self.method, self.variant, self.operator, self.value, self.seed)


def recorded_plans(layout: Layout) -> dict[str, Mapping[str, Any]]:
    """Read the plan of the last run of each spec, by the spec's name, oldest first. A plan that does not read is passed over."""
    if not layout.root.is_dir():
        raise StoreError(f"no results in '{layout.root}': no such folder", "wasp run SPEC --results DIR writes there")
    found: dict[str, Mapping[str, Any]] = {}
    for path in sorted(layout.within(layout.runs).glob("*/plan.json")):
        with suppress(ArtifactError):
            plan = read_record(layout.within(path)) or {}
            name = plan.get("spec")
            if isinstance(name, str):
                found.pop(name, None)
                found[name] = plan
    return found


def planned_cells(spec: str, plan: Mapping[str, Any]) -> list[ListedCell]:
    """List the cells of a run, computed or not."""
    try:
        judged = {_named(spec, entry): str(entry["key"]) for entry in plan.get("branched", ())}
        cells = [_named(spec, entry) for entry in plan["cells"]]
        keys = [str(entry["key"]) for entry in plan["cells"]]
        if not all(map(is_key, (*keys, *judged.values()))):
            raise ValueError("a key is none")
        return [replace(cell, key=key, branches=judged.get(cell)) for cell, key in zip(cells, keys, strict=True)]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ArtifactError(f"cannot read the plan of the last run of '{spec}': {error}", "run the spec again") from error


def _named(spec: str, entry: Mapping[str, Any]) -> ListedCell:
    """A cell of a plan, without keys."""
    value = None if entry["value"] is None else float(entry["value"])
    severity = None if entry["severity"] is None else str(entry["severity"])
    task, method, variant, operator = (str(entry[name]) for name in ("task", "method", "assistant", "operator"))
    return ListedCell(task, method, variant, operator, value, int(entry["seed"]), spec=spec, severity=severity)


def stored_cells(layout: Layout) -> list[ListedCell]:
    """List every cell in the store of a folder without runs; one whose manifest has another form is passed over."""
    judged: dict[str, str] = {}
    for key in sorted(filter(is_key, stored_keys(layout, BRANCHES))):
        with suppress(ArtifactError, KeyError, TypeError, AttributeError):
            judged[str(read_manifest(layout, BRANCHES, key)["upstream"][KIND])] = key
    cells: list[ListedCell] = []
    for key in sorted(filter(is_key, stored_keys(layout, KIND))):
        with suppress(ArtifactError, KeyError, TypeError, ValueError, AttributeError):
            manifest = read_manifest(layout, KIND, key)
            axes = manifest["axes"]
            value = None if axes["value"] is None else float(axes["value"])
            variant = str(axes["method_config"].get("variant", "full"))
            who = str(manifest["task"]), str(axes["method"]), variant, str(axes["operator"])
            cells.append(ListedCell(*who, value, int(manifest["seed"]), key=key, branches=judged.get(key)))
    return cells


def chosen(items: Sequence[T], wanted: Mapping[str, Any]) -> list[T]:
    """Keep what has one of the wanted values in each field that is not None.

    UnknownName where nothing has a value: a misspelt method gives no empty table.
    """
    found = list(items)
    for name, value in wanted.items():
        if value is None:
            continue
        values = set(_values(value))
        known = {getattr(item, name) for item in items}
        for unknown in sorted(values - known, key=str):
            raise UnknownName(f"{name} in these results", str(unknown), sorted(str(one) for one in known if one is not None))
        found = [item for item in found if getattr(item, name) in values]
    return found


def _values(value: Any) -> Iterator[Any]:
    if isinstance(value, str) or not isinstance(value, Iterable):
        yield value
    else:
        yield from value


def table_of(layout: Layout, cell: ListedCell) -> Path | None:
    """Return the table of a cell; None where it is not computed."""
    path = layout.within(cell_file(layout.artifact(KIND, cell.key)))
    return path if path.is_file() else None
