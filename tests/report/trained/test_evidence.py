"""Pictures and pages of trained parts: all that there are, frames pixel by pixel, and nothing
from what is damaged or leads elsewhere.
"""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.learning.recordings import recording
from tests.report.trained.parts import HORIZON, artifact
from wasp_cli.report.trained.artifacts import Trained
from wasp_cli.report.trained.evidence import EVIDENCE, GAP, LABEL, PITCH, SIDE, TEXT, write_evidence
from wasp_cli.store.layout import Layout


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> tuple[Layout, list[Trained]]:
    layout = Layout(tmp_path_factory.mktemp("store"))
    return layout, [artifact(layout, kind) for kind in EVIDENCE]


def test_every_part_has_its_files(store: tuple[Layout, list[Trained]], tmp_path: Path) -> None:
    layout, trained = store
    told: list[str] = []
    files = write_evidence(layout, trained, tmp_path, told.append)
    wanted = {
        f"trained/goal1-s0-{one.kind}-{one.key[:8]}/{file}"
        for one in trained
        for file, _ in EVIDENCE[one.kind]
    }
    assert {str(path.relative_to(tmp_path)) for path in files} == wanted
    assert len(told) == len(EVIDENCE)


def test_what_an_earlier_report_drew_goes(
    store: tuple[Layout, list[Trained]], tmp_path: Path
) -> None:
    layout, trained = store
    critics, denoiser = (
        next(each for each in trained if each.kind == kind) for kind in ("critics", "denoiser")
    )
    write_evidence(layout, [critics, denoiser], tmp_path)
    files = write_evidence(layout, [denoiser], tmp_path)
    assert [path for path in (tmp_path / "trained").rglob("*") if path.is_file()] == files
    assert [path.name for path in files] == ["quality.md"]


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def other(path: Path) -> None:
    path.write_text('{"sets": [1], "held_out": {"steps": {}}, "all": null, "config": []}')


def a_list(path: Path) -> None:
    path.write_text('[{"interactions": "x", "return": []}, 7]')


def pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


@pytest.mark.parametrize("harm", [cut, other, a_list, pipe, folder, Path.unlink])
@pytest.mark.parametrize("kind", ["dataset", "denoiser", "diagnostics", "expert", "critics"])
def test_a_damaged_artifact_breaks_nothing(
    kind: str, harm: Callable[[Path], None], layout: Layout, tmp_path: Path
) -> None:
    one = artifact(layout, kind)
    for path in sorted(layout.artifact(kind, one.key).iterdir()):
        harm(path)
    (tmp_path / "report").mkdir()
    # Of a curve, whatever is a list has rows.
    left = {path.name for path in write_evidence(layout, [one], tmp_path / "report")}
    assert not left


def test_links_are_not_followed_to_read(layout: Layout, tmp_path: Path) -> None:
    trained = [artifact(layout, kind) for kind in EVIDENCE]
    (tmp_path / "outside").mkdir()
    for one in trained:
        for path in sorted(layout.artifact(one.kind, one.key).iterdir()):
            if path.name != "_manifest.json":
                path.rename(tmp_path / "outside" / f"{one.kind}-{path.name}")
                path.symlink_to(tmp_path / "outside" / f"{one.kind}-{path.name}")
    (tmp_path / "report").mkdir()
    assert write_evidence(layout, trained, tmp_path / "report") == []


def test_links_are_not_followed_to_write(
    store: tuple[Layout, list[Trained]], tmp_path: Path
) -> None:
    layout, trained = store
    denoiser = next(each for each in trained if each.kind == "denoiser")
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "quality.md").write_text("mine")
    report = tmp_path / "report"
    report.mkdir()
    (report / "trained").symlink_to(outside)
    (page,) = write_evidence(layout, [denoiser], report)
    page.unlink()
    page.parent.rmdir()
    page.parent.symlink_to(outside)
    write_evidence(layout, [denoiser], report)
    assert page.read_text() != (outside / "quality.md").read_text() == "mine"
    assert [path.name for path in outside.iterdir()] == ["quality.md"]
    page.parent.rename(report / "trained" / "mine")
    assert write_evidence(layout, [denoiser], report, anew=False) == [page]
    assert (report / "trained" / "mine").is_dir()


def test_the_strip_shows_true_and_imagined_frames_in_their_rows(
    layout: Layout, tmp_path: Path
) -> None:
    data = recording()
    (path,) = (
        path
        for path in write_evidence(layout, [artifact(layout, "diagnostics")], tmp_path)
        if path.name == "open_loop.png"
    )
    sheet = np.asarray(Image.open(path).convert("RGB"))
    # a red edge would cover a part of a costly one
    step = int(np.flatnonzero(data.cost[1 : 2 + HORIZON] == 0)[0])
    for row, image in enumerate(
        (data.pixels[1 + step, :3], 255 - data.pixels[1 + step, :3], data.pixels[1 + step, 3:])
    ):
        shown = sheet[TEXT + GAP + row * PITCH :, LABEL + step * PITCH :][:SIDE, :SIDE]
        enlarged = Image.fromarray(np.ascontiguousarray(image.transpose(1, 2, 0))).resize(
            (SIDE, SIDE), Image.Resampling.NEAREST
        )
        np.testing.assert_array_equal(shown[4:-4, 4:-4], np.asarray(enlarged)[4:-4, 4:-4])
