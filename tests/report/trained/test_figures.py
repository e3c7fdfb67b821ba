"""Learning and calibration curves from the files of artifacts, whatever these hold."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.report.invented import invent, write
from tests.report.made import NO_CELLS
from tests.report.trained.parts import BINS
from wasp_cli.report.stats import Frame, read_frame
from wasp_cli.report.summarize import draw_figures
from wasp_cli.report.trained.artifacts import Trained
from wasp_cli.report.trained.figures import driving_curves, loss_curves, reliabilities
from wasp_cli.report.trained.series import series_of
from wasp_cli.store.layout import Layout
from wasp_cli.store.tables import CellIdentity

FILES: dict[str, tuple[str, Any]] = {
    "expert": (
        "curve.json",
        [
            {"interactions": 100.0 * i, "return": None if i == 0 else i, "cost_per_1000": 40 - i}
            for i in range(4)
        ],
    ),
    "residual": (
        "curve.json",
        [{"interactions": 50.0 * i, "return": 2 * i, "cost_per_1000": 9} for i in range(3)],
    ),
    "world_model": (
        "curves.json",
        {"beta_o": [8.0, 4.0, 2.0], "beta_c": [0.5, 0.25], "alpha_q": [1, 1], "beta_r": [0.0, 1.0]},
    ),
    "diagnostics": (
        "diagnostics.json",
        {
            "held_out": {"steps": [{"k": k, "reliability": BINS} for k in range(1, 16)]},
            "unseen": {"steps": []},
        },
    ),
}


def artifact(layout: Layout, kind: str, content: str | None = None, seed: int = 0) -> Trained:
    name, document = FILES[kind]
    key = f"{sorted(FILES).index(kind)}{seed:02d}".ljust(20, "0")
    folder = layout.artifact(kind, key)
    folder.mkdir(parents=True)
    (folder / name).write_text(
        json.dumps(document) if content is None else content, encoding="utf-8"
    )
    return Trained(kind, "goal1", seed, key, 1.0, {}, kind)


def test_what_learns_in_the_task(layout: Layout) -> None:
    expert, residual = driving_curves(
        layout, [artifact(layout, kind) for kind in ("expert", "residual", "world_model")]
    )
    assert (expert.task, expert.seed, expert.name) == ("goal1", 0, "Expert")
    np.testing.assert_equal(expert.x, [0, 100, 200, 300])
    # no episode ended in the first rollout
    np.testing.assert_equal(expert.y["return"], [np.nan, 1, 2, 3])
    np.testing.assert_equal(expert.y["cost_per_1000"], [40, 39, 38, 37])
    assert residual.name == "SafeRL-Res"


def test_losses_are_shares_of_the_first_one(layout: Layout) -> None:
    first = loss_curves(layout, [artifact(layout, "world_model")])
    assert {curve.name: curve.y["loss"].tolist() for curve in first} == {
        "observations": [1.0, 0.5, 0.25],
        "cost": [1.0, 0.5],
    }
    assert first[0].x.tolist() == [0, 20, 40]


def test_reliability_at_some_steps(layout: Layout) -> None:
    judged = [
        artifact(layout, "diagnostics"),
        artifact(layout, "diagnostics", content="{}", seed=1),
    ]
    found = list(reliabilities(layout, judged))
    assert [(each.step, each.episodes) for each in found] == [
        (step, "held_out") for step in (1, 5, 10, 15)
    ]
    np.testing.assert_equal(found[0].predicted, [0.05, np.nan, 0.9])
    assert found[0].size.tolist() == [90, 0, 3]


NAMES = st.sampled_from(
    [
        "held_out",
        "steps",
        "k",
        "reliability",
        "predicted",
        "size",
        "interactions",
        "return",
        "beta_o",
    ]
)
JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(NAMES, inner),
    max_leaves=12,
)


@given(kind=st.sampled_from(sorted(FILES)), document=JSON)
def test_what_is_untrusted_is_no_curve_and_no_crash(
    kind: str, document: Any, tmp_path_factory: pytest.TempPathFactory
) -> None:
    layout = Layout(tmp_path_factory.mktemp("odd"))
    one = [artifact(layout, kind, content=json.dumps(document))]
    for curve in (*driving_curves(layout, one), *loss_curves(layout, one)):
        assert len(curve.x) > 1
        assert all(len(values) == len(curve.x) for values in curve.y.values())
    assert all(
        len(each.predicted) == len(each.seen) == len(each.size)
        for each in reliabilities(layout, one)
    )


@pytest.mark.parametrize("content", ["", "{", "[1, 2", "\x00", "[" * 5000 + "]" * 5000])
def test_damaged_files_leave_their_curve_out(content: str, layout: Layout, tmp_path: Path) -> None:
    found = [artifact(layout, kind, content=content) for kind in FILES]
    assert (
        driving_curves(layout, found),
        loss_curves(layout, found),
        list(reliabilities(layout, found)),
    ) == ([], [], [])
    assert draw_figures(layout, Frame(NO_CELLS), found, tmp_path) == []


def test_a_row_of_the_table_is_exported_under_the_name_of_its_task(tmp_path: Path) -> None:
    layout = Layout(tmp_path)
    driven = write(
        layout,
        CellIdentity("formula1", "human", "full", "laggy", 0.5, 0),
        [invent(0, 1, 0.0, 0.1)],
    )
    assert list(series_of(layout, [], read_frame(layout, [driven]))) == [
        "formula1/table/Human-only"
    ]


def test_figures_name_what_they_show(tmp_path: Path) -> None:
    layout = Layout(tmp_path / "results")
    files = draw_figures(
        layout,
        Frame(NO_CELLS),
        [artifact(layout, kind, seed=seed) for kind in FILES for seed in (0, 1)],
        tmp_path,
    )
    assert [path.name for path in files] == [
        "learning.png",
        "learning.svg",
        "reliability.png",
        "reliability.svg",
    ]
    learning, reliability = (files[i].read_text() for i in (1, 3))
    assert all(
        text in learning
        for text in ("Expert", "SafeRL-Res", "observations", "Goal1: return per episode")
    )
    assert all(text in reliability for text in ("Goal1: held-out episodes", "steps ahead"))
    assert "operators not in the data" not in reliability  # nothing was judged there
