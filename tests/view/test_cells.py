"""The table of a store that grows, and of which somebody notes something meanwhile."""

from __future__ import annotations

import re
import shutil
import time
from pathlib import Path

from tests.commands import run_here
from tests.store.untrusted import UntrustedStore
from tests.view.conftest import brought, viewed
from tests.view.test_server import ask
from tests.view.test_walk import HUMAN, WASP
from wasp_cli.view import cells as module
from wasp_cli.view.server import ViewServer


def numbers(server: ViewServer) -> dict[str, list[str]]:
    """What the table says of every cell."""
    body = ask(server, "/cells")[2]
    rows = re.findall(r'<tr data-k="(\w+)"[^>]*>(.*?)</tr>', body, re.DOTALL)
    return {key: re.findall(r'<td class="(?:number|state)">(.*?)</td>', row) for key, row in rows}


def test_a_cell_that_is_computed_meanwhile_appears(tmp_path: Path) -> None:
    it = UntrustedStore(tmp_path)
    folder = it.layout.artifact("evaluate", it.key)
    folder.rename(tmp_path / "later")
    with viewed(it.layout.root) as server:
        (texts,) = numbers(server).values()
        assert texts[0] == ""
        assert texts[-1] == "not computed yet"
        assert ask(server, f"/cell/{it.key}")[0] == 409
        shutil.copytree(tmp_path / "later", folder)
        (texts,) = numbers(server).values()
        assert texts[0] == "1"
        assert texts[-1] == ""
        status, _, body = ask(server, f"/cell/{it.key}")
        assert status == 200
        assert "<h2>1 episode</h2>" in body


def test_what_is_noted_with_the_command_changes_the_numbers_of_the_page(tmp_path: Path) -> None:
    results = brought(tmp_path / "results", WASP, HUMAN)
    with viewed(results) as server:
        before = numbers(server)
        key = next(cell.key for cell in server.site.cells.listed() if cell.label == HUMAN)
        assert run_here("note", HUMAN, "odd", "-e", "2", "--invalid", "--results", results, columns=200).exit_code == 0
        after = numbers(server)
        assert (before[key][0], after[key][0]) == ("30", "29")
        assert before[key] != after[key]
        assert (before[key][-1], after[key][-1]) == ("", "has invalid episodes")
        assert {other: texts for other, texts in before.items() if other != key} == {o: texts for o, texts in after.items() if o != key}
        assert 'class="invalid"' in ask(server, f"/cell/{key}")[2]
        assert run_here("note", HUMAN, "all", "--invalid", "--results", results, columns=200).exit_code == 0
        assert numbers(server)[key][-1] == "marked as invalid"
        for mark in (("-e", "2"), ()):
            assert run_here("note", HUMAN, "", *mark, "--valid", "--results", results, columns=200).exit_code == 0
        assert numbers(server) == before


def test_a_cell_that_comes_to_a_folder_without_runs_is_listed(tmp_path: Path) -> None:
    results = brought(tmp_path / "results", WASP)
    with viewed(results) as server:
        assert len(numbers(server)) == 1
        brought(tmp_path / "more", HUMAN)
        for folder in (tmp_path / "more" / "store" / "evaluate").iterdir():
            shutil.copytree(folder, results / "store" / "evaluate" / folder.name)
        time.sleep(module.FRESH + 0.1)
        assert len(numbers(server)) == 2
