"""Videos of episodes: what is gathered is what was recorded, and what is drawn is where it
should be.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageColor

from tests.cells import REPEAT, Evaluated, evaluated
from tests.video.test_film import Meter, Painted
from wasp_cli.errors import WaspError
from wasp_cli.learning.rerun import Recorded
from wasp_cli.metrics.episode import GATE_LATE, GATE_SAFETY, GATE_TASK
from wasp_cli.report.explain.episode import Constants, Episode, read_episode
from wasp_cli.report.explain.timeline import LOOKS
from wasp_cli.report.styles import PALETTE
from wasp_cli.stages.base import no_progress
from wasp_cli.store.find import FoundCell
from wasp_cli.store.recorded import read_recorded
from wasp_cli.tasks.camera.appearance import HasScene
from wasp_cli.video import film as video_file
from wasp_cli.video.film import MEANT, film, palette_of, write
from wasp_cli.video.frame import (
    GAP,
    HEADER,
    HEIGHT,
    MAP,
    TIMELINE,
    TITLE,
    WIDTH,
    Correction,
    Painter,
    Timeline,
)
from wasp_cli.video.map import COST, poses_of, things_of
from wasp_cli.video.trace import (
    PARTS,
    PlayedEpisode,
    Source,
    displacements,
    explained,
    fit,
    fit_within,
    integrated,
    play_episode,
)

EPISODE, HORIZON = 1, 4
ROOT = Path(__file__).parents[2]
assert Meter  # registers an environment without a map
assert Painted  # one that draws itself


def source_of(cell: Evaluated) -> Source:
    recorded, models = (
        Recorded(**read_recorded(cell.path)),
        (cell.inputs["world_model"], cell.inputs["policies"]),
    )
    return Source(cell.task, REPEAT, cell.seed, cell.variant, cell.value, recorded, *models)


def played(cell: Evaluated, shown: set[int]) -> PlayedEpisode:
    source = source_of(cell)
    return play_episode(
        source, EPISODE, [None] * len(source.recorded.a[EPISODE]), shown, HORIZON, no_progress
    )


def stored_of(cell: Evaluated, episode: int = EPISODE) -> Episode:
    return replace(
        read_episode(FoundCell(cell.path), episode), constants=Constants(decision_seconds=0.8)
    )


def test_what_is_shown_is_what_the_cameras_saw_and_where_the_robot_was(cell: Evaluated) -> None:
    found = played(cell, {0, 3, 7})
    recorded = Recorded(**read_recorded(cell.path))
    world = cell.world()
    seen = world.reset(recorded.layouts)
    shown = {decision.start.t: decision for decision in found.decisions}
    assert sorted(shown) == [0, 3, 7]
    for t in range(8):
        if t in shown:
            np.testing.assert_array_equal(shown[t].seen, seen.pixels[EPISODE])
            np.testing.assert_array_equal(shown[t].start.a_h, recorded.a_h[EPISODE][t])
            with torch.inference_mode():
                np.testing.assert_array_equal(
                    shown[t].decoded, found.model.decode(shown[t].start.latent)[0].numpy()
                )
        seen = world.step(np.stack([actions[t] for actions in recorded.a])).observation
    a, a_h, reward = recorded.a[EPISODE], recorded.a_h[EPISODE], recorded.reward[EPISODE]
    *_, last = film(cell.task, REPEAT, recorded.layouts[EPISODE], a, a_h, reward, 99, 8)
    np.testing.assert_array_equal(found.places, last.positions[:-1])


def test_the_readout_has_not_seen_the_shown_episode(cell: Evaluated) -> None:
    found = played(cell, set())
    recorded = Recorded(**read_recorded(cell.path))
    world = cell.world()
    assert isinstance(world, HasScene)
    world.reset(recorded.layouts)
    poses = []
    for t in range(25):
        poses.append(poses_of(world.appearance(), world.scene(np.arange(3))))
        world.step(np.stack([actions[t] for actions in recorded.a]))
    others = np.concatenate([displacements(np.array(poses)[:, row]) for row in (0, 2)])
    np.testing.assert_allclose(found.readout.offset, others.mean(0), rtol=1e-9)


def test_a_video_has_a_frame_for_every_so_many_decisions_and_for_the_last(
    cell: Evaluated, tmp_path: Path
) -> None:
    stored = stored_of(cell)
    changed = [
        (stored.a[t] - stored.a_h[t])[None] if stored.numbers["deviation"][t] > 0 else None
        for t in range(stored.decisions)
    ]
    assert any(each is not None for each in changed)
    path = tmp_path / "a.gif"
    shares: list[float] = []
    painter = Painter(
        source_of(cell), stored, Correction(changed, "executed", False), HORIZON, 9, no_progress
    )
    made = painter.film(path, lambda share, text: shares.append(share))
    video: Any = Image.open(path)
    assert (video.n_frames, made.frames) == (4, 4)  # decisions 0, 9, 18 and 24 of 25
    assert video.size == (WIDTH, HEIGHT)
    # Above the map stands what it shows, each with its colour.
    above = np.asarray(video.convert("RGB")).astype(int)[35:52, :448]
    appearance = cell.world().appearance()  # type: ignore[attr-defined]
    assert len(things_of(appearance)) == 1 + len(appearance.kinds)
    for _, colour in things_of(appearance):
        assert (np.abs(above - ImageColor.getrgb(colour)) < 40).all(-1).sum() > 20
    assert sorted(made.r2) == ["forward", "left", "turn"]
    assert shares == sorted(shares)
    assert [path.name for path in tmp_path.iterdir()] == ["a.gif"]
    frames, times = [], []
    for index in range(4):
        video.seek(index)
        times.append(video.info["duration"])
        frames.append(np.asarray(video.convert("RGB")).astype(int))
    assert times == [2 * 9 * 800, 2 * 9 * 800, 2 * 6 * 800, 2000]
    cursors = []
    for frame in frames:
        dark = (np.abs(frame[HEIGHT - TIMELINE + 6 : HEIGHT - TIMELINE + 12] - 105) < 12).all(
            (0, 2)
        )
        cursors.append(np.flatnonzero(dark).mean())
    assert (np.diff(cursors) > 20).all()
    np.testing.assert_allclose(cursors[1] - cursors[0], cursors[2] - cursors[1], atol=2.5)


def test_a_task_without_a_map_shows_its_camera(inputs: Mapping[str, Path], tmp_path: Path) -> None:
    cell = evaluated(inputs, tmp_path / "cell", task="FilmMeter-v0", episodes=2)
    stored = stored_of(cell, 1)
    source = source_of(cell)
    painter = Painter(
        source, stored, Correction([None] * stored.decisions, "", False), HORIZON, 1, no_progress
    )
    assert painter.played.decisions[0].scene is None
    assert (painter.played.readout, painter.played.appearance) == (None, None)
    assert painter.film(tmp_path / "a.gif", no_progress).frames == stored.decisions


def test_a_task_that_draws_itself_is_shown_as_it_does(
    inputs: Mapping[str, Path], tmp_path: Path
) -> None:
    cell = evaluated(inputs, tmp_path / "cell", task="FilmPainted-v0", episodes=2)
    stored = stored_of(cell, 1)
    correction = Correction([None] * stored.decisions, "", False)
    painter = Painter(source_of(cell), stored, correction, HORIZON, 1, no_progress)
    panel = np.asarray(painter.frame(0))[HEADER + TITLE :][:MAP, GAP:][:, :MAP]
    assert panel[MAP // 2, MAP // 2].tolist() == [100, 100, 100]
    assert (painter.played.decisions[0].seen[:3] == 40).all(), "assistants see their camera"


def test_gates_and_costs_stand_over_their_decisions(cell: Evaluated) -> None:
    gate = np.zeros(25, int)
    gate[4], gate[5], gate[20] = GATE_SAFETY, GATE_SAFETY, GATE_TASK
    costly = np.arange(25) == 12
    curve = np.linspace(0, 1, 25)
    stored = stored_of(cell)
    row, numbers = (
        {**stored.row, "tau_c": 0.5, "tau_r": 0.4},
        {**stored.numbers, "g_cost": curve, "delta_g": curve},
    )
    timeline = Timeline(
        replace(stored, gate=gate, costly=costly, row=row, numbers=numbers), 900, 180
    )
    picture = np.asarray(timeline.image).astype(int)
    assert picture.shape == (180, 900, 3)
    marks = {LOOKS[GATE_SAFETY].colour: [4, 5], LOOKS[GATE_TASK].colour: [20], COST: [12]}
    for colour, decisions in marks.items():
        # Above the legend, whose samples have the same colours.
        columns = (np.abs(picture[:-30] - ImageColor.getrgb(colour)) < 4).all(-1).sum(0) > 6
        inside = [t for t in range(25) if columns[round(timeline.x(t + 0.5))]]
        assert inside == decisions


def plain(index: int) -> Image.Image:
    image = Image.new("RGB", (60, 40), "#FFFFFF")
    image.paste(MEANT[index], (10 * index, 0, 10 * index + 10, 10))
    return image


@pytest.mark.parametrize("ending", [".apng", ".webp", ".GIF"])
def test_every_format_brings_the_frames_back(ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{ending}"
    told: list[int] = []
    write(path, 5, plain, [100, 200, 100, 100, 500], told.append)
    video: Any = Image.open(path)
    assert video.n_frames == 5
    assert told == [0, 1, 2, 3, 4]
    for index in range(5):
        video.seek(index)
        shown = np.asarray(video.convert("RGB")).astype(int)
        assert np.abs(shown - np.asarray(plain(index))).mean() < 2
        if ending != ".webp":
            np.testing.assert_array_equal(shown[5, 10 * index + 5], ImageColor.getrgb(MEANT[index]))


def test_colours_that_mean_something_stay_among_many_others() -> None:
    random = np.random.default_rng(0)
    crowd = Image.fromarray(random.integers(0, 255, (80, 80, 3), np.uint8))
    palette = palette_of([crowd])
    for colour in MEANT:
        shown = (
            Image.new("RGB", (4, 4), colour)
            .quantize(palette=palette, dither=Image.Dither.NONE)
            .convert("RGB")
        )
        assert np.abs(np.asarray(shown).astype(int) - ImageColor.getrgb(colour)).max() <= 4
    # nobody confuses these with a colour
    greys = {colour for colour in MEANT if colour[1:3] == colour[3:5] == colour[5:]}
    gates = {look.colour for look in LOOKS.values()}
    assert set(PALETTE) | greys >= gates | set(MEANT[:3])
    assert greys & gates == {LOOKS[GATE_LATE].colour}
    style = (ROOT / "wasp_cli" / "report" / "page" / "style.css").read_text(encoding="utf-8")
    for look in LOOKS.values():
        assert look.kind == "late" or f"--{look.kind}: {look.colour.lower()};" in style, (
            "pages have the same colours"
        )


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (OSError(28, "No space left on device", "a.gif.part"), WaspError),
        (KeyboardInterrupt(), KeyboardInterrupt),
    ],
)
def test_a_file_that_cannot_be_written_leaves_nothing(
    error: BaseException,
    expected: type[BaseException],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def full(*_: Any, **__: Any) -> None:
        (tmp_path / "a.gif.part").write_bytes(b"half")
        raise error

    monkeypatch.setattr(video_file.Image.Image, "save", full)
    with pytest.raises(expected):
        write(tmp_path / "a.gif", 2, plain, [100, 100], lambda index: None)
    assert list(tmp_path.iterdir()) == []


# Paths that are read out of latents: the geometry, and that the fit finds what is linear and
# nothing else.


FEATURES = 12


def world(seed: int, noise: float) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Six episodes whose displacements are linear in the features, but for noise."""
    random = np.random.default_rng(seed)
    weights = random.normal(size=(FEATURES, 3)) * [0.02, 0.01, 0.1]
    features = [random.normal(size=(80, FEATURES)).astype(np.float32) for _ in range(6)]
    moves = [
        x @ weights + [0.05, 0.0, 0.01] + noise * random.normal(size=(80, 3)) * weights.std(0)
        for x in features
    ]
    return features, moves


@given(st.integers(0, 2**32 - 1), st.integers(1, 30))
def test_displacements_put_together_are_the_way(seed: int, length: int) -> None:
    random = np.random.default_rng(seed)
    poses = np.concatenate(
        [random.normal(size=(length + 1, 2)), random.uniform(-3.1, 3.1, (length + 1, 1))], 1
    )
    found = integrated(poses[0], displacements(poses))
    np.testing.assert_allclose(found, poses[:, :2], atol=1e-9)


def test_displacements_are_seen_from_the_robot() -> None:
    # It looks along +y and goes to the left of where it looks, which is -x, while it turns by a
    # quarter to the left.
    poses = np.array([[1.0, 2.0, np.pi / 2], [0.5, 2.0, np.pi]])
    np.testing.assert_allclose(displacements(poses), [[0.0, 0.5, np.pi / 2]], atol=1e-12)


def test_of_one_episode_alone_each_part_is_predicted_from_the_others() -> None:
    features, moves = world(3, noise=0.0)
    readout, share = fit_within(features[0], moves[0])
    assert (share > 0.99).all()
    assert (explained(readout(features[1]), moves[1]) > 0.99).all()
    shuffled = np.random.default_rng(4).permutation(moves[0])
    # in its own fit, it would look explained
    assert (fit_within(features[0], shuffled)[1] < 0.2).all()
    readout, share = fit_within(features[0][: 2 * PARTS - 1], moves[0][: 2 * PARTS - 1])
    assert readout is None
    assert np.isnan(share).all()


def test_what_never_moves_has_no_share() -> None:
    features, moves = world(4, noise=0.0)
    still = [move * [1.0, 0.0, 1.0] for move in moves]
    shares = explained(fit(features[1:], still[1:])(features[0]), still[0])
    assert np.isnan(shares).tolist() == [False, True, False]
    assert (shares[[0, 2]] > 0.999).all(), "what is linear is found"
