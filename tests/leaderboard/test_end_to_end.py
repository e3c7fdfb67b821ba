"""A submission as its author makes it and as others check it, over one small cell."""

import shutil
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pytest

from tests.commands import wasp
from tests.leaderboard.submissions import EXAMPLES, sign
from wasp_cli.leaderboard.folder import ROWS
from wasp_cli.store.parquet import write_table
from wasp_cli.store.tables import SCHEMA, read_episodes

BOARD = """\
extends: field
name: tiny
tasks: [goal1]
operators: {noisy: null, limited-skill: null, reaction-time: null}
seeds: [313]
episodes: 2
"""
SPEC = 'extends: tiny.yaml\nname: mine\nmethods: ["halfway:Halfway"]\n'
WRITES = """
import os
import pathlib

pathlib.Path(f"written-by-{os.getpid()}").touch()
"""
"""As an environment may do: ViZDoom writes its settings into the current folder."""


@pytest.mark.slow
def test_a_submission_is_verified_and_one_with_a_changed_row_is_refused(tmp_path):
    code = (EXAMPLES / "halfway.py").read_text(encoding="utf-8")
    (tmp_path / "halfway.py").write_text(code + WRITES, encoding="utf-8")
    (tmp_path / "tiny.yaml").write_text(BOARD, encoding="utf-8")
    (tmp_path / "mine.yaml").write_text(SPEC, encoding="utf-8")
    on = ("--board", "tiny.yaml")
    wasp(tmp_path, "submit", "mine.yaml", "--by", "A | B", *on, "-j", "1", code=0)
    folder = tmp_path / "leaderboard" / "mine"
    # Others have the folder alone.
    there = tmp_path / "there"
    there.mkdir()
    shutil.copy(tmp_path / "tiny.yaml", there)
    copy = Path(shutil.copytree(folder, there / "mine"))
    verify = ("verify", "mine", "--yes", "-j", "1", *on)

    listed = wasp(there, "leaderboard", "mine", *on, code=0).stdout
    (line,) = [line for line in listed.splitlines() if "Halfway" in line]
    assert "[Halfway (halfway)](mine)" in line
    assert "A \\| B" in line
    assert "1 of 1 cells are the same" in wasp(there, *verify, code=0).stdout
    assert wasp(there, "leaderboard", "mine", *on, code=0).stdout == listed

    table = read_episodes([copy / ROWS])
    better = pa.array([value + 1.0 for value in table["return"].to_pylist()])
    place = table.column_names.index("return")
    write_table(table.set_column(place, "return", better).cast(SCHEMA), copy / ROWS)
    assert pc.sum(table["return"]).as_py() + 2 == pytest.approx(pc.sum(better).as_py())
    told = wasp(there, *verify, code=1)
    assert "rows.parquet" in told.stderr
    # Somebody who also lists the new digest is found out by the cell that is computed again.
    sign(copy)
    told = wasp(there, *verify, code=1)
    assert "return" in told.stdout
    assert "refused" in told.stderr

    # Rows of one assistant beside the source of another.
    shutil.rmtree(copy)
    shutil.copytree(folder, copy)
    source = copy / "source" / "halfway.py"
    source.write_text(source.read_text(encoding="utf-8").replace("0.7", "0.5"), encoding="utf-8")
    told = wasp(there, *verify, code=1)
    assert "halfway.py" in told.stderr
    sign(copy)
    told = wasp(there, *verify, code=1)
    assert "other code" in told.stderr
