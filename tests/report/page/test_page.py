"""The page as a whole: everything is in it, nothing is fetched, nobody's text becomes markup."""

import io
import json
import re
import shutil
import subprocess
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.plans import trajectory
from tests.report.explained import Invented
from tests.report.made import NO_CELLS, frame_of_tables, renamed
from tests.report.markup import Outline
from wasp_cli.cells.cell import RecordedCell
from wasp_cli.cells.read import Missing
from wasp_cli.metrics.episode import (
    GATE_METHOD,
    GATE_SAFETY,
    GATE_TASK,
    Trajectory,
    episode_metrics,
)
from wasp_cli.report.claims import judge
from wasp_cli.report.explain import CURVE, Episode, timeline
from wasp_cli.report.figures import cost_return_figure
from wasp_cli.report.films import SIZE, TaskFilms, film_page, films_of
from wasp_cli.report.render import rendered
from wasp_cli.report.stats import Frame, read_frame
from wasp_cli.report.summarize import Report
from wasp_cli.report.tables.main import main_table
from wasp_cli.report.trained import Trained
from wasp_cli.spec.paper import load_paper
from wasp_cli.store.artifact import commit, staging_folder
from wasp_cli.store.layout import Layout
from wasp_cli.store.slim import Slimming, slim
from wasp_cli.store.tables import CellIdentity, Thresholds, write_cell
from wasp_cli.tasks.make import make_task
from wasp_cli.video.film import sprite_of

EVIL = "</script><script>document.title='obeyed'</script><img src=http://evil onerror=alert(1)>"
FETCHED = ("src", "srcset", "data", "action", "poster")
CHROMIUM = next(
    (
        path
        for name in ("chromium", "chromium-browser", "google-chrome")
        if (path := shutil.which(name))
    ),
    None,
)


def page_of(frame: Frame, folder: Path, *, word: str = "plain") -> str:
    lost = RecordedCell("goal1", "wasp", "full", "noisy", 0.2, 7)
    missing = Missing(lost, f"failed: {word}", f"goal1 wasp {word}")
    report = Report(
        name=word,
        layout=Layout(folder),
        facts=("a fact", "another", f"a third: {word}"),
        shown=(main_table(frame),),
        frame=replace(frame, missing=(missing,)),
        trained=(Trained(f"expert {word}", "goal1", 0, "0123456789", 61.0, {"note": word}),),
        assumptions=(("wasp.tau_c", 0.3, word),),
        judging=partial(judge, frame, load_paper()),
    )
    return report.html(cost_return_figure(frame, folder))


def test_everything_is_there_and_nothing_is_fetched(frame: Frame, tmp_path: Path) -> None:
    page = page_of(frame, tmp_path)
    outline = Outline(page)
    ids, fetched = outline.values("id"), outline.values(*FETCHED)
    assert {str(link["href"]).removeprefix("#") for link in outline.all("a")} == {
        "results",
        "trained",
        "assumptions",
    }
    assert set(ids) >= {
        "results",
        "trained",
        "assumptions",
        "table1",
        "details",
        "figure-cost_return",
    }
    assert len(set(ids)) == len(ids)
    assert fetched
    assert all(source.startswith("data:image/") for source in fetched)
    assert not re.search(r"@import|url\((?!data:)|<link|<iframe|https?://(?!www\.w3\.org)", page)
    missing = f"1 of {len(frame.cells) + 1} cells is missing"
    for text in ('<section class="verdict">', "SafeRL-Res", missing, "wasp.tau_c", "1 min 01 s"):
        assert text in page
    assert page.index('id="table1"') < page.index('<section class="verdict">')


def test_no_text_becomes_markup(frame: Frame, tmp_path: Path) -> None:
    page = page_of(frame, tmp_path, word=EVIL)
    assert page.count("<script>") == 1
    assert "<img src=http" not in page
    assert all(source.startswith("data:image/") for source in Outline(page).values(*FETCHED))


def test_an_empty_report_is_a_page(tmp_path: Path) -> None:
    report = Report(
        "empty",
        Layout(tmp_path),
        facts=(),
        shown=(),
        frame=Frame(NO_CELLS),
        trained=(),
        assumptions=(),
    )
    assert Outline(report.html()).found


PROBE = """<script>
  const told = [];
  const numbers = () => Array.from(document.querySelectorAll('#table1 tbody:first-of-type tr'), (row) => row.cells[2].dataset.value);
  document.querySelectorAll('#table1 th button')[2].click();
  const falling = numbers().filter(Boolean).map(Number);
  told.push(falling.length > 3 && falling.every((x, i) => i === 0 || falling[i - 1] >= x));
  document.querySelectorAll('#table1 th button')[2].click();
  const rising = numbers().filter(Boolean).map(Number);
  told.push(rising.length > 3 && rising.every((x, i) => i === 0 || rising[i - 1] <= x));
  const texts = () => Array.from(document.querySelectorAll('#table1 tbody:first-of-type tr'), (row) => row.cells[1].textContent.trim());
  document.querySelectorAll('#table1 th button')[1].click();
  told.push(texts().length > 3 && texts().every((x, i) => i === 0 || texts()[i - 1].localeCompare(x) <= 0));
  told.push(getComputedStyle(document.getElementById('trained')).display === 'none');
  location.hash = '#trained';
  window.addEventListener('hashchange', () => {
    told.push(getComputedStyle(document.getElementById('trained')).display === 'block');
    document.title = 'told ' + told.join(' ');
  });
</script></body>"""


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_a_browser_sorts_turns_pages_and_complains_of_nothing(frame: Frame, tmp_path: Path) -> None:
    assert CHROMIUM is not None
    page = tmp_path / "page.html"
    page.write_text(page_of(frame, tmp_path, word=EVIL).replace("</body>", PROBE), encoding="utf-8")
    options = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--enable-logging=stderr",
        f"--user-data-dir={tmp_path / 'profile'}",
    ]
    command = [CHROMIUM, *options, "--virtual-time-budget=3000", "--dump-dom", page.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    title = re.search(r"<title>(.*?)</title>", done.stdout, re.DOTALL)
    assert title[1] == "told true true true true true"
    assert ":CONSOLE" not in done.stderr


# What a timeline draws: each gate's curve against its threshold, what was done, what it cost.


def lanes(episode: Episode) -> dict[str, str]:
    drawn = rendered("timeline.html", lanes=timeline(episode), decisions=episode.decisions)
    return dict(re.findall(r'<div class="lane"><span>(.*?)</span>(<svg.*?</svg>)</div>', drawn))


def marks(svg: str) -> list[tuple[str, int, int]]:
    return [
        (kind, int(x), int(width))
        for kind, x, width in re.findall(r'<rect class="(\w+)" x="(\d+)" y="0" width="(\d+)"', svg)
    ]


def heights(svg: str) -> list[tuple[float, float]]:
    """Of every decision with a value: its place and its height from above."""
    found = [points.split() for points in re.findall(r'points="(.*?)"', svg)]
    return [
        (float(point.split(",")[0]), float(point.split(",")[1]))
        for line in found
        for point in line[::2]
    ]


def test_gates_interventions_and_costs(tmp_path: Path) -> None:
    it = Invented()
    it.fire(2, GATE_SAFETY)
    it.fire(3, GATE_SAFETY)
    it.fire(5, GATE_TASK)
    it.pay(0, 6, 7)
    drawn = lanes(it.read(tmp_path))
    assert list(drawn) == ["Ḡᶜ", "ΔG", "acts", "cost"]
    assert marks(drawn["acts"]) == [("safety", 2, 2), ("task", 5, 1)]
    assert marks(drawn["cost"]) == [("cost", 0, 1), ("cost", 6, 2)]
    assert all(
        'viewBox="0 0 8 ' in svg and svg.count('class="cursor"') == 1 for svg in drawn.values()
    )


def test_a_curve_is_above_its_threshold_exactly_where_the_gate_fired(tmp_path: Path) -> None:
    it = Invented()
    it.fire(4, GATE_SAFETY)
    svg = lanes(it.read(tmp_path))["Ḡᶜ"]
    (limit,) = re.findall(r'class="limit" x1="0" x2="8" y1="([\d.]+)"', svg)
    assert [t for t, y in heights(svg) if y < float(limit)] == [4]
    assert all(0 <= y <= CURVE for _, y in heights(svg))


def test_other_methods_show_their_own_signal(tmp_path: Path) -> None:
    it = Invented(method="ida", thresholds=Thresholds(tau_q=0.1), config={"vote": 0.5})
    it.signal = np.linspace(-1, 1, it.steps)
    it.gate[6:] = GATE_METHOD
    it.a[6:] += 0.25
    drawn = lanes(it.read(tmp_path))
    assert list(drawn) == ["vote", "acts", "cost"]
    assert marks(drawn["acts"]) == [("method", 6, 2)]
    (limit,) = re.findall(r'class="limit" x1="0" x2="8" y1="([\d.]+)"', drawn["vote"])
    # It takes over above a share of the votes; tau_Q is the margin of each vote.
    assert [t for t, y in heights(drawn["vote"]) if y < float(limit)] == [6, 7]


# Which episode is shown, and that it is the recorded one.


REPEAT = 100
"""Ten decisions an episode."""
Stored = tuple[Layout, Frame]


def driven(seed: int, push: float) -> Trajectory:
    """A real episode of Goal1 under one command throughout."""
    task = make_task("goal1", 1, action_repeat=REPEAT, observe=())
    task.reset([seed])
    steps = [task.step(np.array([[push, 0.1]])) for _ in range(task.max_decisions)]
    a = np.tile([push, 0.1], (len(steps), 1))

    columns = {
        name: [getattr(step, name)[0] for step in steps]
        for name in ("reward", "cost", "cost_env", "env_steps", "goals")
    }
    return trajectory(len(steps), **columns, a_h=a, a=a)


def store(folder: Path, costs: dict[tuple[str, str, float | None], tuple[int, ...]]) -> Stored:
    """Cells of real episodes, whose rows say that they cost what is asked for."""
    layout, cells = Layout(folder), []
    layout.prepare()
    for number, ((method, operator, value), own) in enumerate(costs.items()):
        key = f"{number:020x}"
        trajectories = [driven(e, 0.3 * (-1) ** (number // 2)) for e in range(len(own))]
        rows = [episode_metrics(trajectory, 7, 25.0) for trajectory in trajectories]
        for row, cost in zip(rows, own, strict=True):
            object.__setattr__(row, "cost", cost)
        identity = CellIdentity("goal1", method, "full", operator, value, 0)
        staging = staging_folder(layout, key)
        write_cell(
            staging,
            identity,
            trajectories,
            rows,
            Thresholds(),
            [np.ones(10)] * len(own),
            list(range(len(own))),
        )
        commit(
            layout,
            "evaluate",
            key,
            staging,
            {"kind": "evaluate", "key": key, "settings": {"action_repeat": REPEAT}},
        )
        severity = "moderate" if value == 0.4 else "mild"
        cells.append(RecordedCell(**vars(identity), key=key, severity=severity))
    return layout, read_frame(layout, cells)


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Stored:
    costs = {
        ("human", "noisy", 0.2): (0, 0, 0),
        ("human", "noisy", 0.4): (9, 30, 4),
        ("wasp", "noisy", 0.4): (1, 2, 3),
        ("wasp", "laggy", 0.5): (5, 5, 5),
        ("expert", "none", None): (0, 1, 2),
    }
    return store(tmp_path_factory.mktemp("films"), costs)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def films(stored: Stored) -> TaskFilms:
    told: list[str] = []
    (found,) = films_of(*stored, sprite_of, told.append)
    assert told == ["goal1: Human-only", "goal1: WASP", "goal1: Expert"]
    return found


def test_one_episode_under_every_method_at_the_moderate_severity(films: TaskFilms) -> None:
    assert (films.task, films.operator, films.value, films.seed) == ("goal1", "noisy", 0.4, 0)
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
    start, later = (
        np.abs(sheets[0][:SIZE, part] - sheets[1][:SIZE, part]).mean() for part in (first, ninth)
    )
    # The same world at the start, where only the command's arrow differs; driving backwards leads
    # elsewhere.
    assert later > 2 * start


def test_an_episode_that_does_not_repeat_has_no_film_but_a_reason(stored: Stored) -> None:
    layout, frame = stored
    cell = layout.artifact("evaluate", frame.cells.cells[1].key)
    manifest = cell / "_manifest.json"
    text = manifest.read_text()
    manifest.write_text(text.replace(f'"action_repeat": {REPEAT}', '"action_repeat": 50'))
    try:
        (found,) = films_of(layout, frame, sprite_of, lambda text: None)
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
    assert (
        "Episode 0 of seed 0 under the operator Noisy 0.4: the one whose cost is the "
        "median under Human-only." in page
    )


def test_environments_of_others_are_not_imported_for_a_film(
    stored: Stored, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "evil_module.py").write_text(f"open({str(tmp_path / 'imported')!r}, 'w').close()\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    layout, frame = stored
    cells = renamed(frame.cells, lambda _: {"task": "evil_module:Evil-v0"})
    found = list(films_of(layout, frame_of_tables(cells), sprite_of, lambda text: None))
    assert found == []
    assert not (tmp_path / "imported").exists()


def test_of_published_cells_without_all_their_steps_the_first_episode_is_shown(
    tmp_path: Path,
) -> None:
    layout, frame = store(
        tmp_path, {("human", "noisy", 0.4): (30, 9, 4), ("wasp", "noisy", 0.4): (1, 2, 3)}
    )
    for cell in frame.cells:
        key = cell.key
        manifest = layout.manifest("evaluate", key)
        record = {**json.loads(manifest.read_text()), "kind": "evaluate"}
        manifest.write_text(
            json.dumps(
                {
                    **record,
                    "slim": slim(layout.artifact("evaluate", key), "evaluate", Slimming(steps=1)),
                }
            )
        )
    (after,) = films_of(layout, frame, sprite_of, lambda _: None)
    assert after.number == 0
    assert all(film.sprite is not None for film in after.films)
    assert "the first, since what is published has the steps of no other" in film_page(after)
