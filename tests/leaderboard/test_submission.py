"""The folder of a submission: what it holds, and every change to it that is refused unread."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pytest

from tests.commands import run_here
from tests.leaderboard.submissions import (
    EXAMPLES,
    copied,
    halfway,
    record_of,
    rewrite,
    session_of,
    sign,
    small_board,
    submitted,
)
from wasp_cli.errors import ArtifactError, UsageError, WaspError
from wasp_cli.leaderboard.board import Board, board_of
from wasp_cli.leaderboard.cells import drawn, sample_of
from wasp_cli.leaderboard.check import checked
from wasp_cli.leaderboard.entry import entry_from
from wasp_cli.leaderboard.folder import ROWS
from wasp_cli.leaderboard.submit import write_submission
from wasp_cli.store.layout import Layout
from wasp_cli.store.parquet import write_table
from wasp_cli.store.tables import SCHEMA, read_episodes


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> tuple[Path, Path]:
    return submitted(tmp_path_factory.mktemp("submitted"))


@pytest.fixture(scope="module")
def board(whole) -> Board:
    return board_of(whole[1])


@pytest.fixture
def folder(whole, tmp_path) -> Path:
    return copied(whole[0], tmp_path)


def test_it_is_small_and_has_rows_code_and_sample(whole, board):
    folder, _ = whole
    submission, rows = checked(folder, board)
    names = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert names == {"submission.json", "rows.parquet", "spec.yaml", "source/halfway.py"}
    assert len(rows) == 4
    assert all(table.num_rows == 3 for table in rows.values())
    assert {label.split()[0] for label in submission.sample} == {"race1", "goal1"}
    assert set(submission.modules) == {"halfway"}
    assert sum(path.stat().st_size for path in folder.rglob("*")) < 100_000
    assert "a-private-name" not in json.dumps(record_of(folder))


def with_rows(change: Callable[[pa.Table], pa.Table]) -> Callable[[Path], None]:
    """Change the rows, and list their new digest."""

    def changed(folder: Path) -> None:
        table = read_episodes([folder / ROWS])
        write_table(change(table).cast(SCHEMA), folder / ROWS)
        sign(folder)

    return changed


def cheaper(table: pa.Table) -> pa.Table:
    cost = pc.cast(pc.multiply(table["cost"], 0), pa.int32())
    return table.set_column(table.column_names.index("cost"), "cost", cost)


def elsewhere(table: pa.Table) -> pa.Table:
    seeds = pc.add(table["episode_seed"], 1)
    return table.set_column(table.column_names.index("episode_seed"), "episode_seed", seeds)


def edited(folder: Path) -> None:
    source = folder / "source" / "halfway.py"
    source.write_text(source.read_text(encoding="utf-8").replace("0.7", "0.5"), encoding="utf-8")


def unsigned(folder: Path) -> None:
    table = read_episodes([folder / ROWS])
    write_table(cheaper(table).cast(SCHEMA), folder / ROWS)


CHANGES: dict[str, tuple[Callable[[Path], None], str]] = {
    "a changed row": (unsigned, "rows.parquet"),
    "a changed row whose digest is listed": (with_rows(cheaper), "sample"),
    "a missing cell": (with_rows(lambda table: table.slice(0, 9)), "s314 halfway:Halfway laggy"),
    "a missing episode": (with_rows(lambda table: table.slice(0, 11)), "2 episodes"),
    "other worlds": (with_rows(elsewhere), "other worlds"),
    "other source": (edited, "halfway.py"),
    "another hash of the code": (lambda folder: rewrite(folder, code="0" * 64), "hash"),
    "a missing file": (lambda folder: (folder / ROWS).unlink(), "rows.parquet"),
    "a file too many": (lambda folder: (folder / "more.py").touch(), "more.py"),
    "a link": (
        lambda folder: (folder / "source" / "link.py").symlink_to("/etc/passwd"),
        "link.py",
    ),
    "another sample": (lambda folder: rewrite(folder, sample=[]), "sample"),
    "another board": (lambda folder: rewrite(folder, board="0" * 20), "board"),
    "a shipped assistant": (lambda folder: rewrite(folder, assistant="wasp"), "wasp"),
    "a name that leads out": (
        lambda folder: rewrite(folder, files={"../rows.parquet": "0" * 64}),
        "../rows.parquet",
    ),
    "no record": (
        lambda folder: (folder / "submission.json").write_text("[]", encoding="utf-8"),
        "submission.json",
    ),
    "a newer form": (lambda folder: rewrite(folder, form=99), "newer"),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_changed_submission_is_refused_and_the_message_names_what(change, folder, board):
    alter, named = CHANGES[change]
    alter(folder)
    with pytest.raises(WaspError) as refused:
        checked(folder, board)
    assert named in refused.value.message
    assert refused.value.exit_code == 1


def test_verify_ends_with_its_documented_code_and_runs_nothing_unasked(whole, folder):
    _, spec = whole
    told = run_here("verify", folder, "--board", spec, columns=200, code=2)
    assert "4 of 4 cells" in told.stdout
    assert "--yes" in told.stderr
    unsigned(folder)
    told = run_here("verify", folder, "--board", spec, "--yes", columns=200, code=1)
    assert "rows.parquet" in told.stderr


def test_a_damaged_submission_is_on_no_leaderboard(whole, folder, tmp_path):
    unsigned(folder)
    page = tmp_path / "page.md"
    run_here("leaderboard", folder, "--board", whole[1], "--out", page, columns=200, code=1)
    assert not page.exists()


def test_without_its_source_a_submission_keeps_the_hashes(tmp_path):
    board = board_of(small_board(tmp_path))
    entry = halfway(board)
    session = session_of(entry, board, tmp_path / "results")
    place = tmp_path / "closed"
    write_submission(session, entry, board, place, by="Somebody", source=False)
    submission, _ = checked(place, board)
    assert list(submission.sources) == ["halfway.py"]
    assert not (place / "source").exists()

    # An unfinished run writes nothing, and leaves what is there.
    before = record_of(place)
    layout = Layout(tmp_path / "results")
    _, node = session.plan.grid.cells[0]
    shutil.rmtree(layout.artifact(node.kind, node.key))
    with pytest.raises(ArtifactError, match="unfinished"):
        write_submission(session, entry, board, place, by="Somebody else", force=True)
    with pytest.raises(UsageError, match="already"):
        write_submission(session, entry, board, place, by="Somebody else")
    assert record_of(place) == before
    assert {path.name for path in tmp_path.iterdir()} == {"closed", "results", "small.yaml"}


def test_what_was_trained_for_it_goes_along_and_what_is_published_does_not(tmp_path, monkeypatch):
    text = (EXAMPLES / "halfway.py").read_text(encoding="utf-8")
    text = text.replace("class Halfway:", 'class Reader:\n    needs = ("heldout", "critics")\n')
    (tmp_path / "reader.py").write_text(text, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    board = board_of(small_board(tmp_path))
    entry = entry_from('name: mine\nmethods: ["reader:Reader"]\n', "spec.yaml", board)
    place = tmp_path / "mine"
    session = session_of(entry, board, tmp_path / "results")
    write_submission(session, entry, board, place, by="Somebody")
    checked(place, board)
    assert {path.parent.name for path in place.glob("store/*/*")} == {"heldout"}
    assert len(list(place.glob("store/heldout/*/numbers.json"))) == 2
    assert not any("a-private-name" in path.read_text() for path in place.rglob("*.json"))
    # More than git should hold is refused.
    monkeypatch.setattr("wasp_cli.leaderboard.submit.LARGEST", 3)
    with pytest.raises(UsageError, match="heldout"):
        write_submission(session, entry, board, place, by="Somebody", force=True)


def test_samples_have_a_cell_of_each_task_and_follow_the_rows(board):
    cells = board.cells("halfway:Halfway")
    samples = {tuple(sample_of(cells, f"{number:064x}")) for number in range(20)}
    assert len(samples) > 1
    assert all([cell.task for cell in sample] == ["race1", "goal1"] for sample in samples)
    assert drawn(cells, 99, 0) == cells
    assert drawn(cells, 2, 7) == drawn(cells, 2, 7)
