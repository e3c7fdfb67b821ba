"""`wasp gc` and what nobody can compute again: what a person drove, what was fitted to it, and what somebody noted."""

import os
import time
from pathlib import Path
from typing import Any

from tests.commands import run_here
from tests.run.recorded import key, planned, write_run
from wasp_cli.report.notes import Note, add_note
from wasp_cli.store.artifact import commit, staging_folder, write_record
from wasp_cli.store.layout import SESSION_FILE, Layout

LONG_AGO = time.time() - 7200
MODEL, ALONE, OTHER, CLONE, CLONED, BRANCHES, NEWEST, BEGUN, BEGUN_MODEL, NOTED, UNWANTED = range(1, 12)


def stored(layout: Layout, kind: str, number: int, reads: int | None = None, variant: str = "noisy", *, session: bool = False) -> Path:
    staging = staging_folder(layout, key(number))
    (staging / "rows").write_bytes(b"rows")
    if session:
        write_record(staging / SESSION_FILE, {"number": 1})
    upstream = {} if reads is None else {"read": key(reads)}
    manifest = {"kind": kind, "key": key(number), "label": f"n{number}", "axes": {"operator": variant}, "upstream": upstream}
    return commit(layout, kind, key(number), staging, manifest)


def begin(layout: Layout, number: int) -> None:
    write_record(layout.work(key(number)) / SESSION_FILE, {"number": 2})
    (layout.work(key(number)) / "episodes.parquet").write_bytes(b"two episodes")


def drove(layout: Layout, second: int, *nodes: dict[str, Any]) -> str:
    run_id = f"20260501-1200{second:02d}-drive-0001"
    write_run(layout, run_id, list(nodes), spec="drive")
    os.utime(layout.run(run_id), (LONG_AGO, LONG_AGO))
    return run_id


def left(layout: Layout) -> set[int]:
    return {int(path.name, 16) for path in layout.store.glob("*/*")}


def collect(layout: Layout) -> str:
    done = run_here("gc", layout.root, "--yes", "--runs", columns=80)
    assert done.exit_code == 0, done.output
    return done.stdout


def test_the_next_participant_displaces_nobody(layout):
    stored(layout, "world_model", MODEL)
    stored(layout, "evaluate", ALONE, MODEL, "person", session=True)
    damaged = stored(layout, "evaluate", OTHER, MODEL, "person", session=True)
    (damaged / "_manifest.json").write_text("{")
    stored(layout, "clone", CLONE, ALONE, "person")
    stored(layout, "evaluate", CLONED, CLONE, "cloned")
    stored(layout, "counterfactual", BRANCHES, CLONED, "cloned")
    stored(layout, "evaluate", NEWEST, MODEL, "person", session=True)
    stored(layout, "world_model", BEGUN_MODEL)
    stored(layout, "evaluate", UNWANTED)
    begin(layout, BEGUN)
    begun = [planned(BEGUN_MODEL, "model", "cached"), planned(BEGUN, "begun", needs=[BEGUN_MODEL])]
    first = drove(layout, 1, planned(ALONE, "alone"))
    second = drove(layout, 2, *begun)
    nobody = drove(layout, 3, planned(UNWANTED, "a grid of the same name", "cached"))
    newest = drove(layout, 4, planned(NEWEST, "newest"))
    collect(layout)
    assert left(layout) == {MODEL, ALONE, OTHER, CLONE, CLONED, BRANCHES, NEWEST, BEGUN_MODEL}
    assert (layout.work(key(BEGUN)) / "episodes.parquet").read_bytes() == b"two episodes"
    assert {path.name for path in layout.runs.iterdir()} == {first, second, newest} != {nobody}


def test_what_a_note_is_about_stays(layout):
    stored(layout, "world_model", MODEL)
    stored(layout, "evaluate", NOTED, MODEL)
    stored(layout, "evaluate", UNWANTED, MODEL)
    add_note(layout, Note(key(NOTED), "noted", 3, "it starts within a hazard", "invalid"))
    collect(layout)
    assert left(layout) == {MODEL, NOTED}
    (layout.root / "notes.jsonl").unlink()
    (layout.root / "notes.jsonl").mkdir()
    done = run_here("gc", layout.root, "--yes", columns=80)
    assert (done.exit_code, "the notes cannot be read" in done.stderr) == (1, True)
    assert left(layout) == {MODEL, NOTED}
