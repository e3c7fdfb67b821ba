"""Notes beside the store: reports show them, leave out what is invalid, and say so; no result
changes.
"""

import io
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from tests.commands import run_here
from tests.report.golden_store import STORE, report_of
from wasp_cli.cli.run import require_cells
from wasp_cli.errors import StoreError, UsageError
from wasp_cli.report.notes import FILE, LONGEST, Note, add_note, invalid, notes_of
from wasp_cli.store.layout import Layout


@pytest.fixture
def results(tmp_path: Path) -> Path:
    return shutil.copytree(STORE, tmp_path / "results")


def stored(results: Path) -> dict[str, int]:
    return {
        str(path): path.stat().st_mtime_ns
        for path in sorted((results / "store").rglob("*"))
        if path.is_file()
    }


def test_an_invalid_episode_leaves_every_number_of_its_cell(results: Path) -> None:
    before = report_of(results)
    key = next(iter(before.frame.judged))
    cell = before.frame.cells.where(lambda one: one.key == key)
    bytes_before = stored(results)
    done = run_here(
        "note",
        key,
        "it starts within a <b>hazard</b>",
        "--episode",
        "1",
        "--invalid",
        "--author",
        "Ada",
        "--results",
        results,
        columns=200,
    )
    assert done.exit_code == 0, done.output
    after = report_of(results)
    found = after.frame.cells.where(lambda one: one.key == key)
    others = np.arange(cell.counts[0]) != 1
    assert found.counts[0] == cell.counts[0] - 1
    for name in cell.names:
        np.testing.assert_array_equal(found.episodes(name), cell.episodes(name)[others])
    assert found.pooled("return") == pytest.approx(cell.episodes("return")[others].mean())
    weight = cell.episodes("decisions")[others]
    assert found.pooled("int_rate") == pytest.approx(
        (cell.episodes("int_rate")[others] * weight).sum() / weight.sum()
    )
    assert found.pooled("decision_p50_ms") == pytest.approx(
        np.median(cell.episodes("decision_p50_ms")[others])
    )
    old, new = before.frame.judged[key], after.frame.judged[key]
    kept = old.episode != 1
    np.testing.assert_array_equal(new.worth.rho, old.worth.rho[kept])
    np.testing.assert_array_equal(new.episode, [e - (e > 1) for e in old.episode[kept]])
    if kept.any():
        assert found.pooled("uir") == pytest.approx(old.worth.unnecessary[kept].mean())
    assert "1 episode marked as invalid is not counted in any number here." in after.facts
    assert any(
        "Episode 1 of" in fact and "is left out: marked as invalid by Ada" in fact
        for fact in after.facts
    )
    untouched = np.array([one.key != key for one in before.frame.cells])
    for name in ("return", "cost"):
        numbers = before.frame.cells.pooled(name)
        assert (after.frame.cells.pooled(name) == numbers)[untouched].all()
    page = after.html()
    assert "it starts within a &lt;b&gt;hazard" in page
    assert "<b>" not in page
    assert "it starts within a &lt;b>hazard" in after.markdown()
    assert "<b>" not in after.markdown()
    assert stored(results) == bytes_before

    # Taken back, everything is as it was.
    assert (
        run_here("note", key, "", "-e", "1", "--valid", "--results", results, columns=200).exit_code
        == 0
    )
    again = report_of(results)
    assert not any("left out" in fact for fact in again.facts)
    assert "[invalid] it starts within a &lt;b&gt;hazard" in page
    assert "[invalid, taken back] it starts within a &lt;b&gt;hazard" in again.html()
    assert "\\[invalid, taken back\\] it starts within a &lt;b>hazard" in again.markdown()
    console = Console(record=True, file=io.StringIO(), width=200)
    again.terminal(console)
    assert "[invalid]" not in console.export_text()
    for name in cell.names:
        numbers = before.frame.cells.pooled(name)
        np.testing.assert_array_equal(again.frame.cells.pooled(name), numbers)


def test_an_invalid_cell_counts_as_missing(results: Path) -> None:
    before = report_of(results)
    key = before.frame.cells.cells[0].key
    assert (
        run_here(
            "note", key, "<b>wrong</b> weights", "--invalid", "--results", results, columns=200
        ).exit_code
        == 0
    )
    after = report_of(results)
    assert len(after.frame.cells) == len(before.frame.cells) - 1
    (gap,) = after.frame.missing
    assert "marked as invalid by" in gap.reason
    # a run is no failure: what was left out was left out by a person
    require_cells([gap], Layout(results))
    # a terminal shows remarks alone
    assert "1 cell marked as invalid is not counted in any number here." in {*after.facts} & {
        *after.remarks
    }
    assert any("is left out" in fact for fact in after.facts)
    assert "INCOMPLETE" in after.markdown()
    assert "&lt;b&gt;wrong&lt;/b&gt; weights" in after.html()
    assert "<b>wrong</b>" not in after.html()


def test_a_note_alone_excludes_nothing(results: Path) -> None:
    key = report_of(results).frame.cells.cells[0].key
    assert (
        "worth a look"
        in run_here("note", key, "worth a look", "--results", results, columns=200, code=0).stdout
    )
    report = report_of(results)
    assert not report.frame.missing
    assert [note.text for note in report.notes] == ["worth a look"]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("zzz", "text"), "no evaluation 'zzz'"),
        (("KEY", ""), "neither text nor mark"),
        (("KEY", "x", "-e", "99"), "there is no episode 99"),
        (("KEY", "x", "--valid", "--invalid"), "exclude each other"),
        (("KEY", "x" * (LONGEST + 1)), "are allowed"),
    ],
)
def test_what_cannot_be_noted_is_said(
    results: Path, arguments: tuple[str, ...], expected: str
) -> None:
    key = report_of(results).frame.cells.cells[0].key
    done = run_here(
        "note",
        *(key if word == "KEY" else word for word in arguments),
        "--results",
        results,
        columns=300,
        code=2,
    )
    assert expected in done.stderr
    assert not (results / FILE).exists()


def test_lines_of_another_form_are_left_out_and_a_file_that_does_not_read_is_an_error(
    layout: Layout, tmp_path: Path
) -> None:
    good = add_note(
        layout, Note("0123456789abcdef0123", "a cell", 2, "fine\x1b[31m", "invalid", "me")
    )
    records = [{"key": "../../x", "text": "x"}, {"key": good.key, "mark": "root"}]
    records += [{"key": good.key, "episode": episode} for episode in (True, -1, "3")]
    lines = ["not json", "[]", "{}", *map(json.dumps, records), '{"key": "0123', "[" * 5000]
    with (layout.root / FILE).open("a", encoding="utf-8") as file:
        file.write("\n".join(lines) + "\n")
    (found,) = notes_of(layout)
    assert found == good
    assert "\x1b" not in found.text
    assert set(invalid([found])) == {(good.key, 2)}
    (layout.root / FILE).unlink()
    (tmp_path / "elsewhere").write_text("")
    os.symlink(tmp_path / "elsewhere", layout.root / FILE)
    with pytest.raises(StoreError, match="link"):
        notes_of(layout)
    with pytest.raises(StoreError):
        add_note(layout, Note(good.key, "a cell", None, "text"))
    assert (tmp_path / "elsewhere").read_text() == ""
    (layout.root / FILE).unlink()
    os.mkfifo(layout.root / FILE)
    with pytest.raises(StoreError):
        notes_of(layout)
    (layout.root / FILE).unlink()
    add_note(layout, Note(good.key, "a cell", 3, "a\u2028b", "invalid"))
    assert len(notes_of(layout)) == 1
    with pytest.raises(UsageError):
        add_note(Layout(tmp_path / "new"), Note(good.key, "a cell", None, " "))
