"""`wasp show`: what is known of a node."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from tests.commands import run_here
from tests.run.harness import Fakes, fakes, run, written
from wasp_cli.store.layout import Layout

__all__ = ["fakes"]


@pytest.fixture
def results(fakes: Fakes, tmp_path: Path) -> Path:
    """A run of one seed, in which one training failed."""
    fakes.set(behave={"s0 ida_q": "refuse"})
    run(written(tmp_path / "small.yaml", "[0, 1]", "[0]"), tmp_path / "results")
    return tmp_path / "results"


def shown(results: Path, text: str) -> dict[str, Any]:
    done = run_here("show", text, "--results", results, "--json", columns=80, code=0)
    facts: dict[str, Any] = json.loads(done.stdout)
    return facts


def test_an_evaluation_with_all_that_is_known(results: Path) -> None:
    facts = shown(results, "goal1 s0 wasp noisy=0.2")
    manifest = json.loads((Path(facts["folder"]) / "_manifest.json").read_text())
    assert (facts["key"], facts["kind"], facts["label"]) == (
        manifest["key"],
        "evaluate",
        "goal1 s0 wasp noisy=0.2",
    )
    assert (facts["attempt"], facts["seconds"], facts["summary"]) == (
        1,
        manifest["provenance"]["seconds"],
        manifest["summary"],
    )
    changed = {each["name"]: (each["value"], each["default"]) for each in facts["changed"]}
    assert changed["episodes"] == (2, 30)
    assert changed["wasp.candidates"] == (8, 300)
    assert "wasp.horizon" not in changed  # as it is by default
    assert facts["settings"]["action_repeat"] == 4
    assert {each["name"]: each["label"] for each in facts["upstream"]}[
        "world_model"
    ] == "goal1 s0 world_model"
    assert {each["state"] for each in facts["upstream"]} == {"present"}
    assert [(each["name"], each["size"], each["state"]) for each in facts["files"]] == [
        ("data.bin", 32, "whole"),
        ("half.bin", 4, "whole"),
    ]
    assert facts["provenance"]["versions"]["numpy"]
    assert facts["failure"] == {}


def test_harm_is_seen_where_it_is(results: Path) -> None:
    layout = Layout(results)
    facts = shown(results, "goal1 s0 wasp noisy=0.2")
    for upstream in facts["upstream"]:
        place = layout.artifact(upstream["kind"], upstream["key"])
        if upstream["name"] == "critics":
            shutil.rmtree(place)
        if upstream["name"] == "policies":
            (place / "data.bin").unlink()
    folder = Path(facts["folder"])
    (folder / "data.bin").write_bytes(b"x" * 32)  # of the same size
    (folder / "half.bin").unlink()
    facts = shown(results, "goal1 s0 wasp noisy=0.2")
    states = {each["name"]: each["state"] for each in facts["upstream"]}
    assert states == {
        "calibration": "present",
        "critics": "gone",
        "policies": "damaged",
        "world_model": "present",
    }
    assert [each["state"] for each in facts["files"]] == ["changed", "gone"]
    text = run_here("show", facts["key"], "--results", results, columns=80).stdout
    for word in ("CHANGED", "GONE", "DAMAGED"):
        assert word in text


def test_what_failed_says_why(results: Path) -> None:
    facts = shown(results, "goal1 s0 ida_q")
    assert (facts["kind"], facts["failure"]["message"], facts["files"]) == (
        "ida_q",
        "the loss is not finite",
        [],
    )
    text = run_here("show", facts["key"][:8], "--results", results, columns=80).stdout
    assert (
        "Last failure\n  message   the loss is not finite\n  hint      lower the learning rate\n"
        in text
    )
