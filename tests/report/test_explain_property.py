"""Whatever a table holds can be explained."""

import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.report.explained import NAN, PRINTED, WASP, Invented, text_of
from wasp_cli.metrics.episode import Plans
from wasp_cli.report.explain.facts import decision_json, episode_json, merged_runs, places_of, runs_of
from wasp_cli.report.explain.text import decision_lines, episode_lines
from wasp_cli.store.tables import Thresholds

numbers = st.one_of(st.just(NAN), st.floats(-2, 2), st.sampled_from([0.0, 0.3, 1e6]))
thresholds = st.one_of(st.none(), st.just(NAN), st.floats(-1, 2), st.just(0.0))


@st.composite
def cells(draw: st.DrawFn) -> Invented:
    method = draw(st.sampled_from(["wasp", "printed", "ida", "filter", "human", "diffusion", "theirs"]))
    variant = draw(st.sampled_from(["full", "safety-only", "task-only", "no-case2", "no-rollout", "own"]))
    limits = Thresholds(draw(thresholds), draw(thresholds), draw(thresholds))
    config = draw(st.sampled_from([{}, WASP, PRINTED, {"vote": 0.5}, {"horizon": "long", "feasible": None}]))
    made = Invented(draw(st.integers(1, 6)), method, variant, limits, dict(config), draw(st.integers(1, 2)))

    def series(elements: Callable[[], Any]) -> Any:
        return np.array([elements() for _ in range(made.steps)])

    made.gate = series(lambda: draw(st.integers(0, 3)))
    made.cost_env = series(lambda: draw(st.sampled_from([0, 0, 3])))
    made.a = series(lambda: draw(st.sampled_from([[0.5, -0.25], [0.0, 0.0], [-1.0, 1.0]])))
    for name in ("g_cost", "g_return", "delta_g", "signal"):
        setattr(made, name, series(lambda: draw(numbers)))
    steps, iterations = draw(st.integers(1, 3)), draw(st.integers(1, 3))
    planned, searched = (series(lambda: draw(st.booleans())).astype(bool) for _ in range(2))
    searched &= planned
    made.plans = Plans(
        residuals=np.where(planned[:, None, None], draw(st.sampled_from([0.0, 0.5])), np.full((made.steps, steps, 2), NAN)),
        safe=np.where(searched[:, None], draw(st.integers(0, 30)), np.full((made.steps, iterations), -1)),
        case2=np.broadcast_to(searched[:, None], (made.steps, iterations)) & draw(st.booleans()),
        cost=series(lambda: draw(numbers)),
        reward=series(lambda: draw(numbers)),
        alone_cost=series(lambda: draw(numbers)),
        alone_reward=series(lambda: draw(numbers)),
    )
    return made


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(made=cells(), manifest=st.booleans(), width=st.integers(30, 140))
def test_every_cell_can_be_explained(made: Invented, manifest: bool, width: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        episode = made.read(Path(folder), manifest)
    text = text_of(episode_lines(episode, width))
    json.dumps(episode_json(episode), allow_nan=False)
    assert "nan" not in text.split()
    for most in (1, 3):
        pieces = merged_runs(episode, most)
        assert len(pieces) <= most
        assert [run.first for run in pieces[1:]] == [run.last + 1 for run in pieces[:-1]]
        assert (pieces[0].first, pieces[-1].last) == (0, episode.decisions - 1)
        for name in ("cost", "intervened"):
            assert sum(getattr(run, name) for run in pieces) == sum(getattr(run, name) for run in runs_of(episode))
        assert tuple(t for run in pieces for t in run.missed) == places_of(episode.missed)
    for t in range(episode.decisions):
        assert decision_lines(episode, t, width)
        json.dumps(decision_json(episode, t), allow_nan=False)
