"""`wasp explain` from outside."""

import json
from pathlib import Path

import pytest
from click.testing import Result

from tests.commands import run_here
from tests.report.explained import KEY, Invented
from wasp_cli.metrics.episode import GATE_SAFETY

ROOT = Path(__file__).parents[2]


def wasp(*arguments: str | Path) -> Result:
    return run_here(*arguments, columns=200)


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = Invented()
    made.fire(2, GATE_SAFETY)
    folder = tmp_path_factory.mktemp("explain") / "results"
    made.store(folder)
    return folder


def test_the_command_by_key_label_and_path(results: Path) -> None:
    folder = results / "store" / "evaluate" / KEY
    said = [wasp("explain", cell, "-e", "0", "--results", results) for cell in ("0123", "goal1 s0 wasp laggy=0.7", str(folder))]
    browser = f"in a browser: wasp view {results} --open /cell/01234567/episode/0\n"
    assert {(done.exit_code, done.stderr) for done in said} == {(0, browser)}
    assert len({done.stdout for done in said}) == 1
    hint = f"one decision in full: wasp explain 01234567 --results {results} --episode 0 --step 2\n"
    assert said[0].stdout.endswith(hint)
    done = wasp(*hint.split()[5:], "--json")
    assert json.loads(done.stdout)["plan"]["safe"] == [3, 12, 30]
    assert done.stderr == ""


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["0123", "-e", "3"], "this cell has the episodes 0 to 2"),
        (["0123", "-e", "0", "-s", "8"], "episode 0 has the decisions 0 to 7"),
        (["0123", "-e", "0", "-s", "-1"], "episode 0 has the decisions 0 to 7"),
        (["goal1 s0 wasp lagy=0.7", "-e", "0"], "did you mean 'goal1 s0 wasp laggy=0.7'?"),
        (["../../x", "-e", "0"], "no evaluation '../../x'"),
        (["0123"], "Missing option"),
    ],
)
def test_wrong_usage_of_the_command_ends_with_2(arguments: list[str], expected: str, results: Path) -> None:
    done = wasp("explain", *arguments, "--results", results)
    assert (done.exit_code, done.stdout) == (2, "")
    assert expected in done.stderr
    assert "Traceback" not in done.stderr


def test_rows_that_cannot_be_read_end_with_1(results: Path, tmp_path: Path) -> None:
    path = tmp_path / "cell.parquet"
    path.write_bytes(b"PAR1 no table")
    done = wasp("explain", path, "-e", "0")
    assert done.exit_code == 1
    assert "is damaged or was cut off" in done.stderr
    assert "Traceback" not in done.stderr
