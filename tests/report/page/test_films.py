"""Which episode is shown, and that it is the recorded one."""

import io
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from wasp_cli.metrics.episode import Trajectory, episode_metrics
from wasp_cli.report.films import SIZE, TaskFilms, film_page, films_of
from wasp_cli.report.stats import Frame, Wanted, read_frame
from wasp_cli.store.artifact import commit, staging_folder
from wasp_cli.store.layout import Layout
from wasp_cli.store.slim import Slimming, slim
from wasp_cli.store.tables import CellIdentity, Thresholds, write_cell
from wasp_cli.tasks.make import make_task
from wasp_cli.video.film import sprite_of

REPEAT = 100
"""Ten decisions an episode."""
NAN = np.full(10, np.nan)
Stored = tuple[Layout, Frame, dict[CellIdentity, str]]


def driven(seed: int, push: float) -> Trajectory:
    """A real episode of Goal1 under one command throughout."""
    task = make_task("goal1", 1, action_repeat=REPEAT, observe=())
    task.reset([seed])
    steps = [task.step(np.array([[push, 0.1]])) for _ in range(task.max_decisions)]
    a = np.tile([push, 0.1], (len(steps), 1))

    def column(name: str) -> np.ndarray:  # type: ignore[type-arg]
        return np.array([getattr(step, name)[0] for step in steps])

    return Trajectory(
        reward=column("reward"), cost=column("cost"), cost_env=column("cost_env"), env_steps=column("env_steps"), goals=column("goals"),
        a_h=a, a=a, gate=np.zeros(len(steps), int), g_cost=NAN, g_return=NAN, delta_g=NAN, signal=NAN,
    )  # fmt: skip


def store(folder: Path, costs: dict[tuple[str, str, float | None], tuple[int, ...]]) -> Stored:
    """Cells of real episodes, whose rows say that they cost what is asked for."""
    layout, wanted, keys = Layout(folder), [], {}
    layout.prepare()
    for number, ((method, operator, value), own) in enumerate(costs.items()):
        key = f"{number:020x}"
        trajectories = [driven(e, 0.3 * (-1) ** (number // 2)) for e in range(len(own))]
        rows = [episode_metrics(trajectory, 7, 25.0) for trajectory in trajectories]
        for row, cost in zip(rows, own, strict=True):
            object.__setattr__(row, "cost", cost)
        identity = CellIdentity("goal1", method, "full", operator, value, 0)
        staging = staging_folder(layout, key)
        write_cell(staging, identity, trajectories, rows, Thresholds(), [np.ones(10)] * len(own), list(range(len(own))))
        commit(layout, "evaluate", key, staging, {"kind": "evaluate", "key": key, "settings": {"action_repeat": REPEAT}})
        path = layout.artifact("evaluate", key) / "episodes.parquet"
        wanted.append(Wanted(identity, key, path, severity="moderate" if value == 0.4 else "mild"))
        keys[identity] = key
    return layout, read_frame(wanted), keys


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Stored:
    costs = {
        ("human", "noisy", 0.2): (0, 0, 0), ("human", "noisy", 0.4): (9, 30, 4), ("wasp", "noisy", 0.4): (1, 2, 3),
        ("wasp", "laggy", 0.5): (5, 5, 5), ("expert", "none", None): (0, 1, 2),
    }  # fmt: skip
    return store(tmp_path_factory.mktemp("films"), costs)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def films(stored: Stored) -> TaskFilms:
    told: list[str] = []
    (found,) = films_of(*stored, sprite_of, told.append)
    assert told == ["goal1: Human-only", "goal1: WASP", "goal1: Expert"]
    return found


def test_one_episode_under_every_method_at_the_moderate_severity(films: TaskFilms) -> None:
    assert (films.task, films.operator, films.value, films.severity, films.seed) == ("goal1", "noisy", 0.4, "moderate", 0)
    assert [film.method for film in films.films] == ["human", "wasp", "expert"]
    assert films.how == "the one whose cost is the median under Human-only"
    assert films.number == 0  # 4, 9, 30: the median is that of episode 0
    assert {film.episode.row["episode"] for film in films.films} == {0}
    assert films.decisions == 10


def test_the_frames_are_those_of_the_recorded_actions(films: TaskFilms) -> None:
    sheets = []
    for film in films.films:
        assert (film.every, film.sprite.decisions) == (1, list(range(11)))
        image = Image.open(io.BytesIO(film.sprite.data))
        assert image.size == (SIZE * film.sprite.columns, SIZE * -(-11 // film.sprite.columns))
        sheets.append(np.asarray(image.convert("RGB"), float))
    first, ninth = slice(0, SIZE), slice(9 * SIZE, 10 * SIZE)
    start, later = (np.abs(sheets[0][:SIZE, part] - sheets[1][:SIZE, part]).mean() for part in (first, ninth))
    # The same world at the start, where only the command's arrow differs; driving backwards leads elsewhere.
    assert later > 2 * start


def test_an_episode_that_does_not_repeat_has_no_film_but_a_reason(stored: Stored) -> None:
    layout, frame, keys = stored
    cell = layout.artifact("evaluate", keys[frame.cells[1].identity])
    manifest = cell / "_manifest.json"
    text = manifest.read_text()
    manifest.write_text(text.replace(f'"action_repeat": {REPEAT}', '"action_repeat": 50'))
    try:
        (found,) = films_of(layout, frame, keys, sprite_of, lambda text: None)
    finally:
        manifest.write_text(text)
    human, *others = found.films
    assert human.sprite is None
    assert "the same actions lead elsewhere" in human.problem
    assert all(film.sprite is not None for film in others)
    assert "No film: the same actions lead elsewhere" in film_page(found)


def test_a_page_has_a_player_and_every_film(films: TaskFilms) -> None:
    page = film_page(films)
    assert page.count('<figure class="film"') == 3
    assert page.count("url(data:image/webp;base64,") == 3
    assert 'type="range" min="0" max="10"' in page
    assert "Episode 0 of seed 0 under the operator Noisy 0.4: the one whose cost is the median under Human-only." in page


def test_environments_of_others_are_not_imported_for_a_film(stored: Stored, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "evil_module.py").write_text(f"open({str(tmp_path / 'imported')!r}, 'w').close()\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    layout, frame, keys = stored
    cells = tuple(_renamed(frame, "evil_module:Evil-v0"))
    every = {cell.identity: next(iter(keys.values())) for cell in cells}
    found = list(films_of(layout, Frame(cells), every, sprite_of, lambda text: None))
    assert found == []
    assert not (tmp_path / "imported").exists()


def _renamed(frame: Frame, task: str) -> Iterator[object]:
    from dataclasses import replace

    return (replace(cell, identity=replace(cell.identity, task=task)) for cell in frame.cells)


def test_of_published_cells_without_all_their_steps_the_first_episode_is_shown(tmp_path: Path) -> None:
    layout, frame, keys = store(tmp_path, {("human", "noisy", 0.4): (30, 9, 4), ("wasp", "noisy", 0.4): (1, 2, 3)})
    for key in keys.values():
        manifest = layout.manifest("evaluate", key)
        record = {**json.loads(manifest.read_text()), "kind": "evaluate"}
        manifest.write_text(json.dumps({**record, "slim": slim(layout.artifact("evaluate", key), "evaluate", Slimming(steps=1))}))
    (after,) = films_of(layout, frame, keys, sprite_of, lambda _: None)
    assert after.number == 0
    assert all(film.sprite is not None for film in after.films)
    assert "the first, since what is published has the steps of no other" in film_page(after)
