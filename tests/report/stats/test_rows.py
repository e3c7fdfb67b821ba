from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.report.invented import invent, write_rows
from wasp_cli.cells.cell import RecordedCell
from wasp_cli.cells.rows import read_rows
from wasp_cli.errors import StoreError
from wasp_cli.store.tables import SCHEMA, VERSION_KEY, CellIdentity, Thresholds, read_episodes

COLUMNS = ("return", "cost", "success", "mag_int", "episode_seed", "decision_p50_ms")
WASP = CellIdentity("goal1", "wasp", "full", "noisy", 0.2, 3)
EXPERT = CellIdentity("race1", "expert", "full", "none", None, 0)
COST = SCHEMA.get_field_index("cost")
NEUTRAL = CellIdentity("goal1", "human", "full", "noisy", 0.0, 0)


def cell(folder: Path, identity: CellIdentity = WASP) -> Path:
    return write_rows(folder, identity, [invent(e, 3, 0.2 * (e != 1), 0.1) for e in range(5)])


@pytest.mark.parametrize("identity", [WASP, EXPERT, NEUTRAL], ids=lambda identity: identity.method)
def test_the_same_as_reading_all_rows(tmp_path, identity):
    path = cell(tmp_path, identity)
    found = read_rows(path, RecordedCell(**vars(identity)), COLUMNS)
    rows = read_episodes([path])
    assert found.table.equals(rows.select(COLUMNS))
    assert found.thresholds == Thresholds(
        *(rows[name][0].as_py() for name in ("tau_c", "tau_r", "tau_q"))
    )
    assert found.thresholds == (Thresholds(0.3, 3.5) if identity is WASP else Thresholds())


def test_another_cell_is_refused(tmp_path):
    with pytest.raises(StoreError, match="another cell"):
        read_rows(cell(tmp_path, WASP), RecordedCell(**vars(EXPERT)), COLUMNS)


def altered(name: str, values: list[object]) -> Callable[[pa.Table], pa.Table]:
    place = SCHEMA.get_field_index(name)
    return lambda table: table.set_column(
        place, SCHEMA.field(name), pa.array(values, SCHEMA.field(name).type)
    )


@pytest.mark.parametrize(
    ("change", "refused"),
    [
        (altered("method", ["wasp"] * 4 + ["ida"]), "several cells"),
        (altered("value", [0.2] * 4 + [None]), "several cells"),
        (altered("tau_c", [0.3] * 4 + [0.4]), ""),
        (altered("tau_c", [float("nan")] * 5), ""),
        (lambda table: table.drop_columns(["mag_int"]), "no column mag_int"),
        (lambda table: table.replace_schema_metadata({VERSION_KEY: b"1"}), "is damaged"),
        (lambda table: table.replace_schema_metadata({}), "not the table of a cell"),
        (lambda table: table.slice(0, 0), "no episodes"),
        (lambda table: table.cast(table.schema.set(COST, pa.field("cost", pa.int64()))), ""),
    ],
    ids=["methods", "values", "thresholds", "nan", "less", "older", "odd", "empty", "types"],
)
def test_what_is_not_as_written_today_is_read_closely(tmp_path, change, refused):
    path = cell(tmp_path)
    pq.write_table(change(pq.read_table(path)), path, write_page_checksum=True)
    if refused:
        with pytest.raises(StoreError, match=refused):
            read_rows(path, RecordedCell(**vars(WASP)), COLUMNS)
    else:
        found = read_rows(path, RecordedCell(**vars(WASP)), COLUMNS)
        assert found.table.equals(read_episodes([path]).select(COLUMNS))
