"""Whole sessions by the scripted driver: what is recorded is what was executed, and every
command works on it.
"""

from __future__ import annotations

import asyncio
import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.commands import run_here
from tests.drive.conftest import asking, harmed, served, swept_before_commit, wanted
from wasp_cli.cells.runs import last_runs
from wasp_cli.drive import record as record_module
from wasp_cli.drive.check import Habits, drive
from wasp_cli.drive.clone import _driven_with
from wasp_cli.drive.command import drive_session
from wasp_cli.drive.desk import END, NEXT, PAUSE, Desk
from wasp_cli.errors import ArtifactError, UnknownName, UsageError
from wasp_cli.learning.playback import play
from wasp_cli.seeds import layout_seed
from wasp_cli.store.artifact import corruption, read_manifest
from wasp_cli.store.layout import Layout
from wasp_cli.store.lock import held_if_free
from wasp_cli.store.people import SESSION_FILE, TIMING_FILE, read_timing
from wasp_cli.store.recorded import read_recorded
from wasp_cli.store.tables import cell_file, read_episodes, read_steps
from wasp_cli.tasks.make import make_task

pytestmark = pytest.mark.slow  # people drive in real time


@pytest.fixture(scope="module")
def driven(imported: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Two episodes with WASP, at twice the speed: some decisions are late."""
    results = shutil.copytree(imported, tmp_path_factory.mktemp("driven") / "results")
    session = wanted(results, "wasp", 2.0, episodes=2, simulated=True).prepared()
    with swept_before_commit(record_module):
        summary = drive_session(session, 0, open_browser=False, scripted=Habits(0))
    (block,) = summary["blocks"]
    assert block["episodes"] == block["of"] == 2
    return results, block["key"]


def cell_of(driven: tuple[Path, str]) -> Path:
    return cell_file(Layout(driven[0]).artifact("evaluate", driven[1]))


def test_a_session_is_a_cell_like_any_other(driven: tuple[Path, str]) -> None:
    layout, key = Layout(driven[0]), driven[1]
    assert corruption(layout, "evaluate", key) is None
    manifest = read_manifest(layout, "evaluate", key)
    assert manifest["label"] == "goal1 s0 wasp person=0"
    assert manifest["axes"]["operator"] == "person"
    assert {"world_model", "policies", "calibration"} <= set(manifest["upstream"])
    episodes = read_episodes([cell_of(driven)])
    assert episodes["episode"].to_pylist() == [0, 1]
    assert episodes["tau_c"].to_pylist() == [0.5, 0.5]
    assert not list(layout.works.glob("*/episodes.parquet")), "what is published is nowhere else"


def test_the_same_actions_lead_to_the_same_bits(driven: tuple[Path, str]) -> None:
    recorded = read_recorded(cell_of(driven))
    for layout, a, reward in zip(
        recorded["layouts"], recorded["a"], recorded["reward"], strict=True
    ):
        world = make_task("goal1", 1, observe=("pixels",))
        moments = list(play(world, [layout], [a], [reward]))  # refuses any other reward
        assert len(moments) == len(a) + 1


def test_the_record_of_the_clock_has_a_row_for_every_decision(driven: tuple[Path, str]) -> None:
    folder = cell_of(driven).parent
    beats, steps = read_timing(folder / TIMING_FILE), read_steps(cell_of(driven))
    assert beats["episode"].to_pylist() == steps["episode"].to_pylist()
    assert beats["t"].to_pylist() == steps["t"].to_pylist()
    at = np.array(beats["at"].to_pylist())
    assert (np.diff(at) > 0).all()
    # 250 decisions of 40 ms each take ten seconds at least, whatever the machine.
    assert at[249] - at[0] > 249 * 0.04 * 0.9
    session = json.loads((folder / SESSION_FILE).read_text())
    assert (session["participant"], session["speed"], session["cut"]) == ("p0", 2.0, [])
    assert np.isfinite(np.array(beats["round_trip_ms"].to_pylist()[5:], float)).all()


def test_commands_are_those_of_the_keys(driven: tuple[Path, str]) -> None:
    beats, steps = read_timing(cell_of(driven).parent / TIMING_FILE), read_steps(cell_of(driven))
    for keys, command in zip(beats["keys"].to_pylist(), steps["a_h"].to_pylist(), strict=True):
        held = set(keys.split())
        expected = [
            float("ArrowUp" in held) - float("ArrowDown" in held),
            float("ArrowLeft" in held) - float("ArrowRight" in held),
        ]
        assert command == expected
    assert len(set(beats["keys"].to_pylist())) > 2


@pytest.mark.parametrize(
    "command",
    [("explain", "-e", "1"), ("explain", "-e", "0", "--step", "7"), ("show",)],
    ids=" ".join,
)
def test_commands_about_cells_take_it(driven: tuple[Path, str], command: tuple[str, ...]) -> None:
    name, *options = command
    assert (
        "person"
        in run_here(
            name, "goal1 s0 wasp person=0", *options, "--results", driven[0], columns=None, code=0
        ).output
    )


def test_a_person_has_no_other_branch(driven: tuple[Path, str], tmp_path: Path) -> None:
    asked = (
        "goal1 s0 wasp person=0",
        "-e",
        "0",
        "--step",
        "7",
        "--out",
        tmp_path / "a.webp",
        "--results",
        driven[0],
    )
    assert "a person drove this cell" in run_here("replay", *asked, columns=200, code=2).output


def test_a_session_that_ends_early_keeps_what_was_finished_and_goes_on_there(
    imported: Path, tmp_path: Path
) -> None:
    results = shutil.copytree(imported, tmp_path / "results")
    session = wanted(results, episodes=2).prepared()
    with served(session) as (desk, server, clock):
        asyncio.run(drive(server.address, driver=asking(desk, {0: NEXT, 1: PAUSE, 2: END})))
        clock.join(300)
    (first,) = session.done
    assert (first["episodes"], first["of"]) == (1, 2)
    layout = Layout(results)
    manifest = read_manifest(layout, "evaluate", first["key"])
    assert manifest["config"]["episodes"] == 1, "it is never taken for whole"
    told = json.loads((layout.artifact("evaluate", first["key"]) / SESSION_FILE).read_text())
    assert [(cut["why"], cut["before_episode"]) for cut in told["cut"]] == [(NEXT, 0), (END, 1)]
    assert (told["cut"][1]["decisions"] > 0, told["sittings"][0]["pauses"], first["decisions"]) == (
        True,
        1,
        250,
    )

    again = wanted(results, episodes=2, session=0).prepared()
    with served(again) as (_, server, clock):
        asyncio.run(drive(server.address))
        clock.join(300)
    (whole,) = again.done
    assert (whole["episodes"], whole["key"] != first["key"]) == (2, True)
    rows = [
        read_steps(cell_file(layout.artifact("evaluate", key)))
        for key in (first["key"], whole["key"])
    ]
    earlier = rows[1].filter(np.array(rows[1]["episode"].to_pylist()) == 0)
    assert earlier.equals(rows[0]), "the finished episode was taken over, not driven again"
    worlds = read_episodes([cell_file(layout.artifact("evaluate", whole["key"]))])[
        "episode_seed"
    ].to_pylist()
    assert worlds == [layout_seed("goal1", 0, 1), layout_seed("goal1", 0, 2)], (
        "none twice, and the first was left out"
    )
    wanted(results, episodes=1, participant=1).record(again)
    assert [cell.key for cell in last_runs(layout).runs["drive"].cells] == [whole["key"]], (
        "whoever drove last"
    )
    models = {
        name: SimpleNamespace(key=manifest["upstream"][name])
        for name in ("world_model", "policies")
    }
    node = SimpleNamespace(task="goal1", needs=models, settings=manifest["settings"])
    assert _driven_with(layout, node, 0) == [whole["key"]], "a clone learns from each episode once"
    assert (
        len(
            json.loads((layout.artifact("evaluate", whole["key"]) / SESSION_FILE).read_text())[
                "sittings"
            ]
        )
        == 2
    )


def test_nobody_drives_what_is_driven_in_another_window(imported: Path) -> None:
    session = wanted(imported).prepared()
    with (
        held_if_free(session.layout.lock(session.blocks[0][1].key)),
        pytest.raises(UsageError, match="driven in another window"),
    ):
        session.run(Desk())


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"method": "expert"}, "expert"),
        ({"method": "wsap"}, "wsap"),
        ({"hide": ("camera",)}, "cameras"),
        ({"what": "quickstart"}, "nobody drives in 'quickstart'"),
        ({"what": "drive", "method": None, "participant": 4}, "no participant 4"),
        ({"settings": ("seeds=[0]",)}, "the seed of a session is its number"),
        ({"what": "drive", "method": "wasp"}, "--method is for a task"),
        (
            {"what": "drive", "method": None, "settings": ("side_by_side=2",)},
            "one episode at a time",
        ),
    ],
)
def test_mistakes_are_told(tmp_path: Path, more: dict[str, Any], message: str) -> None:
    with pytest.raises((UsageError, UnknownName)) as refused:
        wanted(tmp_path / "results", **{"method": None, **more}).everyone()[0].prepared()
    assert message in f"{refused.value.message} {refused.value.hint}"


@pytest.mark.parametrize("kind", ["world_model", "policies", "calibration"])
def test_damaged_models_drive_nobody(kind: str, imported: Path, tmp_path: Path) -> None:
    """Before the page is served; and the next session has the model back."""
    results = shutil.copytree(imported, tmp_path / "results")
    layout = Layout(results)
    (folder,) = layout.kind(kind).iterdir()
    victim = harmed(layout, kind, folder.name)
    options = ("--episodes", "1", "--simulate", "--no-browser", "--results", results, "-j", "0")
    found = run_here("drive", "goal1", *options, columns=200, code=1)
    assert f"'{victim}' has other bytes than were stored" in " ".join(found.output.split())
    assert not list(layout.kind("evaluate").glob("*"))
    assert not list(layout.works.glob("*"))
    wanted(results, "wasp").prepared()
    assert corruption(layout, kind, folder.name) is None


def test_what_a_person_drove_is_never_replaced(driven: tuple[Path, str], tmp_path: Path) -> None:
    results = shutil.copytree(driven[0], tmp_path / "results")
    layout = Layout(results)
    steps = cell_file(layout.artifact("evaluate", driven[1]))
    steps.write_bytes(steps.read_bytes()[:-1])
    with pytest.raises(ArtifactError, match="what a person drove is damaged") as refused:
        wanted(results, "wasp", 2.0, episodes=2, session=0, simulated=True).prepared()
    assert str(steps) in refused.value.message
    assert layout.manifest("evaluate", driven[1]).exists()


def test_a_grid_cannot_compute_a_person(imported: Path, tmp_path: Path) -> None:
    results = shutil.copytree(imported, tmp_path / "results")
    found = run_here(
        "run", "drive", "--method", "human", "--results", results, "-j", "0", columns=None, code=1
    )
    assert "a person has to drive this cell" in found.output


def test_lost_connections_of_sittings_of_one_cell_add_up(tmp_path: Path) -> None:
    layout, node = Layout(tmp_path), SimpleNamespace(kind="evaluate", key="0" * 20)
    for lost in (1, 2):
        record_module.CellRecord(layout, node, None, 1, {}).count(
            lost_connection=lost, lost_focus=0
        )
    told = json.loads((layout.work(node.key) / SESSION_FILE).read_text())
    assert (told["lost_connection"], told["lost_focus"], len(told["sittings"])) == (3, 0, 2)
