"""Two results folders side by side: which cells are alike, what changed behind those that are
not, and what is more than noise.
"""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.compare.two_runs import episodes, write_results
from wasp_cli.cells.asked import Asked
from wasp_cli.compare import Compared, State, compare
from wasp_cli.compare.paired import MEASURES
from wasp_cli.compare.text import as_json, headline, page, remarks, tables, write
from wasp_cli.store.layout import Layout
from wasp_cli.store.records import write_record
from wasp_cli.store.tables import EPISODES_FILE, STEPS_FILE, CellIdentity, read_episodes


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> Asked:
    return write_results(tmp_path_factory.mktemp("one") / "results")


def copied(side: Asked, folder: Path) -> Asked:
    """The same results elsewhere."""
    shutil.copytree(side.layout.root, folder)
    return replace(side, layout=Layout(folder))


STATES: tuple[State, ...] = (
    "same",
    "same rows",
    "differs",
    "not compared",
    "only first",
    "only second",
)


def states(compared: Compared) -> dict[str, int]:
    return {
        **{state: len(compared.having(state)) for state in STATES},
        "beyond": len(compared.beyond),
    }


NONE = dict.fromkeys((*STATES, "beyond"), 0)


def test_a_folder_beside_itself_has_no_difference(first: Asked) -> None:
    compared = compare(first, first)
    assert states(compared) == NONE | {"same": 8}
    assert compared.alike
    assert (compared.causes, tables(compared)) == ([], [])
    assert headline(compared) == "8 cells: 8 the same; none differ by more than noise."
    assert {
        estimate.value
        for each in compared.summary
        for estimate in each.estimates.values()
        if estimate
    } == {0.0}


def test_one_altered_cell_of_a_copy_is_found(first: Asked, tmp_path: Path) -> None:
    second = copied(first, tmp_path / "copy")
    altered = CellIdentity("goal1", "wasp", "full", "laggy", 0.5, 1)
    other = write_results(
        tmp_path / "other",
        lambda identity: episodes(identity, risk=0.9 if identity == altered else 0.1),
    )
    key = next(
        cell.key
        for cell in first.cells
        if (cell.method, cell.operator, cell.seed) == ("wasp", "laggy", 1)
    )
    for name in (EPISODES_FILE, STEPS_FILE):
        shutil.copy(
            other.layout.artifact("evaluate", key) / name,
            second.layout.artifact("evaluate", key) / name,
        )
    compared = compare(first, second)
    assert states(compared) == NONE | {"same": 7, "differs": 1, "beyond": 1}
    (cell,) = compared.having("differs")
    assert (cell.identity, cell.keys) == (altered, (key, key))
    assert cell.beyond == ("cost", "viol")
    costs = [
        sum(
            read_episodes([side.layout.artifact("evaluate", key) / EPISODES_FILE])[
                "cost"
            ].to_pylist()
        )
        / 8
        for side in (first, second)
    ]
    assert cell.paired.differences["cost"].value == pytest.approx(costs[1] - costs[0])
    assert cell.paired.differences["return"].value == 0.0
    assert not compared.alike
    text = "\n".join(remarks(compared))
    assert (
        "1 cell has other rows under the same key: computed on another machine, or the "
        "file was changed since" in text
    )
    assert cell.label in text


@pytest.mark.parametrize(
    ("changes", "cause", "reached"),
    [
        ({"wasp": {"tau_c": 0.9}}, "wasp.tau_c 1.0 -> 0.9", 4),
        ({"world_model": {"updates": 30}}, "world_model.updates 20 -> 30", 8),
    ],
)
def test_what_changed_is_named_where_it_began(
    changes: Any, cause: str, reached: int, first: Asked, tmp_path: Path
) -> None:
    compared = compare(first, write_results(tmp_path / "results", **changes))
    assert states(compared) == NONE | {"same": 8 - reached, "same rows": reached}
    assert compared.causes == [(f"spec changed: {cause}", reached)]
    assert compared.alike


def test_code_and_libraries_that_changed_are_named(first: Asked, tmp_path: Path) -> None:
    second = write_results(
        tmp_path / "results", wasp={"tau_c": 0.9}, provenance={"versions": {"torch": "2.14.0<b>"}}
    )
    key = next(
        cell.key
        for cell in second.cells
        if cell.method == "wasp" and cell.operator == "laggy" and cell.seed == 0
    )
    path = second.layout.manifest("evaluate", key)
    record = json.loads(path.read_text())
    write_record(path, {**record, "sources": {"wasp_cli.tasks.base": "other", "wasp_cli.new": "x"}})
    causes = dict((compared := compare(first, second)).causes)
    assert causes["library changed: torch 2.13.0 -> 2.14.0<b>"] == 4
    assert "torch 2.13.0 -> 2.14.0&lt;b>" in page([compared])
    assert causes["code changed: wasp_cli.new, wasp_cli.tasks.base"] == 1
    assert causes["spec changed: wasp.tau_c 1.0 -> 0.9"] == 4


def test_the_machine_is_named_where_one_key_has_other_rows(first: Asked, tmp_path: Path) -> None:
    second = write_results(
        tmp_path / "results",
        lambda identity: episodes(identity, risk=0.2),
        provenance={"processor": "two"},
    )
    compared = compare(first, second)
    assert states(compared)["differs"] == 8
    assert compared.causes == [("processor one -> two", 8)]


def test_cells_of_one_side_only_are_named(first: Asked, tmp_path: Path) -> None:
    second = write_results(tmp_path / "results", operators={"noisy": {"mild": 0.2}}, seeds=[0, 2])
    compared = compare(first, second)
    assert states(compared) == NONE | {"same": 2, "only first": 6, "only second": 2}
    assert not compared.alike
    lines = list(remarks(compared, shown=3))
    assert sum(line.startswith("  in the first only: goal1") for line in lines) == 3
    assert "  and 3 more" in lines


def test_a_cell_that_is_not_computed_or_damaged_is_not_compared(
    first: Asked, tmp_path: Path
) -> None:
    second = copied(first, tmp_path / "copy")
    keys = [cell.key for cell in first.cells]
    paths = [second.layout.artifact("evaluate", key) / EPISODES_FILE for key in keys]
    paths[0].unlink()
    paths[1].write_bytes(b"PAR1 no table PAR1")
    compared = compare(first, second)
    assert states(compared) == NONE | {"same": 6, "not compared": 2}
    assert [cell.reason.partition(":")[0] for cell in compared.having("not compared")] == [
        "second"
    ] * 2
    assert "not computed yet" in compared.cells[0].reason
    assert "damaged" in compared.cells[1].reason
    assert not compared.alike


def test_files_and_json_have_every_cell_that_differs(first: Asked, tmp_path: Path) -> None:
    second = write_results(
        tmp_path / "results",
        lambda identity: episodes(identity, risk=0.1 * (1 + identity.seed) + 0.1),
    )
    compared = compare(first, second)
    differing = compared.having("differs")
    text, facts = page([compared]), as_json(compared)
    assert len(differing) == 8
    assert all(cell.label in text for cell in differing)
    assert json.loads(json.dumps(facts)) == facts
    told_of: list[dict[str, Any]] = facts["cells"]
    for entry, cell in zip(told_of, compared.cells, strict=True):
        assert (entry["label"], entry["state"], entry["beyond"]) == (
            cell.label,
            cell.state,
            list(cell.beyond),
        )
        for name in MEASURES:
            assert entry["paired"]["differences"][name]["value"] == pytest.approx(
                cell.paired.differences[name].value, rel=1e-6
            )
    assert facts["alike"] is compared.alike
    out = tmp_path / "out"
    assert {"tiny-cells.md", "tiny-summary.csv"} <= {path.name for path in write([compared], out)}
    (out / "my-cells.md").write_text("of a person")
    write([compare(first, first)], out)
    assert {path.name for path in out.iterdir()} == {"compare.md", "my-cells.md"}
