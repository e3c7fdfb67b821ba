"""Both branches of a decision as they are watched: the same numbers as the counterfactual
stage, and the same paths.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from tests.cells import REPEAT, Evaluated, evaluated
from tests.video.test_film import Painted
from tests.video.test_video import source_of
from wasp_cli.learning.counterfactual import branches
from wasp_cli.learning.rerun import Recorded
from wasp_cli.metrics.necessity import ALONE, ASSISTED
from wasp_cli.stages.base import no_progress
from wasp_cli.store.recorded import read_recorded
from wasp_cli.video.branches import MAP, BranchPair
from wasp_cli.video.film import film

EPISODE, WINDOW = 1, 5
assert Painted  # registers an environment that draws itself


def intervened(cell: Evaluated, wanted: bool = True) -> int:
    recorded = Recorded(**read_recorded(cell.path))
    apart = np.linalg.norm(recorded.a[EPISODE] - recorded.a_h[EPISODE], axis=1) > 1e-3
    return int(np.flatnonzero(apart[:20] == wanted)[0])


def pair(cell: Evaluated, t: int, window: int = WINDOW) -> BranchPair:
    return BranchPair(source_of(cell), EPISODE, t, window, lambda share, text: None)


def test_an_intervention_has_the_branches_of_the_stage(cell: Evaluated) -> None:
    t = intervened(cell)
    found = pair(cell, t)
    for branch in branches(cell.rerun(), [[], [t], []], WINDOW, no_progress):
        np.testing.assert_equal(found.branches[branch.name]._asdict(), branch._asdict())
    assert (found.branches[ASSISTED].reward != found.branches[ALONE].reward).any()


def test_the_assisted_branch_begins_on_the_recorded_path(cell: Evaluated) -> None:
    t, recorded = intervened(cell), Recorded(**read_recorded(cell.path))
    states = pair(cell, t)._states
    parts = (
        recorded.layouts[EPISODE],
        recorded.a[EPISODE],
        recorded.a_h[EPISODE],
        recorded.reward[EPISODE],
    )
    *_, last = film(cell.task, 20, *parts, 99, 8)
    places = last.positions
    for name in (ASSISTED, ALONE):
        assert len(states[name].scenes) == len(states[name].actions) + 1 == WINDOW + 1
        np.testing.assert_array_equal(states[name].scenes[0].position[0, :2], places[t])
    np.testing.assert_array_equal(states[ASSISTED].scenes[1].position[0, :2], places[t + 1])
    np.testing.assert_array_equal(
        states[ASSISTED].actions[0].astype(np.float32), recorded.a[EPISODE][t]
    )
    np.testing.assert_array_equal(
        states[ALONE].actions[0].astype(np.float32), recorded.a_h[EPISODE][t]
    )


def test_where_the_command_stood_both_branches_are_the_same(cell: Evaluated) -> None:
    found = pair(cell, intervened(cell, wanted=False)).branches
    np.testing.assert_equal(found[ASSISTED]._replace(name=ALONE)._asdict(), found[ALONE]._asdict())


def test_a_video_ends_with_the_still(cell: Evaluated, tmp_path: Path) -> None:
    found = pair(cell, intervened(cell))
    for name in ("a.gif", "a.png"):
        found.film("title", ["one line", "another"], tmp_path / name)
    video: Any = Image.open(tmp_path / "a.gif")
    still: Any = Image.open(tmp_path / "a.png")
    assert (video.n_frames, getattr(still, "n_frames", 1)) == (WINDOW + 1, 1)
    video.seek(WINDOW)
    last = np.asarray(video.convert("RGB")).astype(int)
    assert np.abs(last - np.asarray(still.convert("RGB"))).mean() < 4
    video.seek(0)
    assert (np.asarray(video.convert("RGB")) != last).any()


def test_a_task_that_draws_itself_is_shown_as_it_does(
    inputs: Mapping[str, Path], tmp_path: Path
) -> None:
    """It has no snapshots either: its episode is played again for each branch."""
    cell = evaluated(inputs, tmp_path, task="FilmPainted-v0", episodes=3)
    found = pair(cell, 0)
    for name in (ASSISTED, ALONE):
        lengths = len(found.branches[name].cost)
        shown = [np.asarray(found._state(name, step))[MAP // 2, MAP // 2, 0] for step in (0, 1)]
        assert shown == [100, 100 + REPEAT], lengths
