"""Why an assistant did what it did: from invented rows to facts, tables and JSON."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.report.explained import Invented, decision_text, episode_text, text_of
from wasp_cli.metrics.episode import GATE_LATE, GATE_SAFETY, GATE_TASK
from wasp_cli.report.explain.episode import Episode
from wasp_cli.report.explain.facts import (
    decision_json,
    decision_of,
    exceeds,
    merged_runs,
    places_of,
    runs_of,
)
from wasp_cli.report.explain.text import MOST_RUNS, episode_lines
from wasp_cli.store.tables import Thresholds


@pytest.fixture
def mixed(tmp_path: Path) -> Episode:
    """Quiet, two safety decisions, quiet with a cost that was missed, a task decision."""
    made = Invented()
    made.fire(2, GATE_SAFETY)
    made.fire(3, GATE_SAFETY)
    made.fire(6, GATE_TASK, residuals=((-0.5, 0.5), (0.0, 0.0)), safe=(-1, -1, -1))
    made.pay(3, 5)
    made.goals[7] = 1
    return made.read(tmp_path)


GOLDEN = Path(__file__).parents[1] / "golden"


def test_an_episode_and_a_decision_as_printed(mixed: Episode) -> None:
    assert episode_text(mixed) + "\n" == (GOLDEN / "explain_episode.txt").read_text(
        encoding="utf-8"
    )
    assert decision_text(mixed, 2, 120) + "\n" == (GOLDEN / "explain_decision.txt").read_text(
        encoding="utf-8"
    )


def test_a_time_is_shared_by_the_episodes_of_a_batch(tmp_path: Path) -> None:
    first, last = (Invented().read(tmp_path, episode=episode) for episode in (0, 2))
    assert "2 ms: the time of 2 episodes decided side by side, 4 ms, divided by 2" in decision_text(
        first, 0
    )
    assert "side by side" not in decision_text(last, 0) + episode_text(last)


def test_what_came_is_counted_from_the_decision_on(mixed: Episode) -> None:
    facts = decision_of(mixed, 2)
    assert (facts.ahead.first, facts.ahead.last, facts.ahead.costly, facts.ahead.cost) == (
        2,
        5,
        2,
        4,
    )
    assert facts.ahead.discounted == 0.5**1 + 0.5**3
    assert facts.ahead.reward == sum(t / 8 for t in range(2, 6))
    late = decision_of(mixed, 6)
    assert (late.ahead.first, late.ahead.last, late.ahead.goals, late.window) == (6, 7, 1, 4)
    assert "the episode ended before 4 decisions" in decision_text(mixed, 6)


def test_a_correction_without_a_search_is_the_one_that_the_gates_looked_at(mixed: Episode) -> None:
    text = decision_text(mixed, 6)
    assert (
        "  search  none: the correction that the gate compared with the command is "
        "predicted safe, and is carried out\n" in text
    )
    assert "  now   (-0.50, +0.50)          executed\n" in text
    assert "planned again then" not in text
    assert "  with the correction       0.200  yes                      1.500\n" in text
    assert decision_json(mixed, 6)["plan"]["safe"] == []
    assert "Case II   33%" in episode_text(mixed), "of the two decisions that searched"


@pytest.mark.parametrize(
    ("variant", "safety", "task"),
    [
        ("full", "fired", "not asked"),
        ("safety-only", "fired", "off"),
        ("task-only", "off", "silent"),
        ("no-case2", "fired", "not asked"),
    ],
)
def test_gates_that_a_variant_does_without(
    variant: str, safety: str, task: str, tmp_path: Path
) -> None:
    made = Invented(variant=variant)
    if variant == "task-only":
        made.g_cost[2] = 0.5  # computed, and of no consequence
    else:
        made.fire(2, GATE_SAFETY)
    episode = made.read(tmp_path)
    facts = decision_of(episode, 2)
    assert (facts.safety.state, facts.task.state) == (safety, task)
    assert ("has no such gate" in episode_text(episode)) == ("off" in (safety, task))
    assert ("has no such gate" in decision_text(episode, 2)) == ("off" in (safety, task))


@pytest.mark.parametrize(
    ("variant", "alone", "safe", "expected"),
    [
        ("full", 0.25, (3, 3, 3), "the command alone was predicted safe"),
        ("full", 0.6, (3, 3, 3), "no candidate was predicted to be worth its size"),
        ("no-case2", 0.6, (0, 0, 0), "no candidate was safe, and this variant has no recovery"),
    ],
)
def test_a_gate_may_fire_and_the_command_stand(
    variant: str, alone: float, safe: Any, expected: str, tmp_path: Path
) -> None:
    made = Invented(variant=variant)
    made.fire(2, GATE_SAFETY, residuals=np.zeros((2, 2)), safe=safe, cost=alone, alone=alone)
    episode = made.read(tmp_path)
    assert expected in decision_text(episode, 2)
    assert ": the best correction was none, the command was executed." in " ".join(
        decision_text(episode, 2).split()
    )
    assert "  safety  G^c > τ_c 0.300          1  12.5%             1\n" in episode_text(episode)
    assert "command kept: a gate fired, and the command was executed as it was" in episode_text(
        episode
    )


def test_without_a_manifest_constants_are_unknown_and_costs_are_counted_over_15(
    tmp_path: Path,
) -> None:
    made = Invented(steps=30)
    made.fire(2, GATE_SAFETY)
    episode = made.read(tmp_path, manifest=False)
    assert decision_of(episode, 2).window == 15
    assert "  key       none; read from" in decision_text(episode, 2)
    assert "\n  1                     3  II\n" in decision_text(episode, 2)
    assert "observed" not in decision_text(episode, 2)


@pytest.mark.parametrize(
    ("method", "gate", "moved"),
    [("human", 0, 0.0), ("expert", 0, 0.0), ("diffusion", 3, 0.25), ("saferl", 3, 0.25)],
)
def test_methods_without_a_choice_miss_nothing(
    method: str, gate: int, moved: float, tmp_path: Path
) -> None:
    made = Invented(method=method, thresholds=Thresholds(), config={})
    made.gate[:] = gate
    made.a += moved
    made.pay(2, 3)
    episode = made.read(tmp_path)
    assert (episode.gated, episode.selective, places_of(episode.missed)) == (False, False, ())
    assert [(run.first, run.last, run.cost) for run in runs_of(episode)] == [
        (0, 1, 0),
        (2, 3, 4),
        (4, 7, 0),
    ]
    text = episode_text(episode)
    assert "missed" not in text
    assert "Gates" not in text
    assert ("|a - a^H|" in text) == bool(moved)
    assert "Plan\n" not in decision_text(episode, 2)
    made.gate[0] = GATE_LATE
    assert not made.read(tmp_path).selective


def test_gates_compare_in_single_precision_and_a_value_never_prints_like_its_threshold(
    tmp_path: Path,
) -> None:
    assert not exceeds(float(np.float32(0.3)), 0.3)
    assert exceeds(float(np.nextafter(np.float32(0.3), np.float32(1))), 0.3)
    assert not exceeds(None, 0.3)
    assert not exceeds(0.3, None)
    made = Invented()
    made.g_cost[0] = 0.29999
    assert "G^c 0.29999  τ_c 0.30000" in decision_text(made.read(tmp_path), 0)


def test_a_long_restless_episode_stays_readable(tmp_path: Path) -> None:
    steps = 250
    made = Invented(steps=steps)
    for t in range(steps):
        if t % 3:
            made.fire(t, (GATE_SAFETY, GATE_TASK)[t // 7 % 2])
    made.pay(*range(0, steps, 2))
    episode = made.read(tmp_path)
    lines = episode_lines(episode, 120)
    assert len(lines) < 60
    assert max(len(line.plain) for line in lines) <= 120
    assert f"{len(runs_of(episode))} runs in {MOST_RUNS} rows" in " ".join(text_of(lines).split())


def test_a_short_quiet_run_joins_the_gate_around_it(tmp_path: Path) -> None:
    made = Invented(steps=20)
    for t in (5, 6, 8, 9):
        made.fire(t, GATE_SAFETY)
    pieces = merged_runs(made.read(tmp_path), 3)
    assert [(run.first, run.last, run.gate) for run in pieces] == [
        (0, 4, "none"),
        (5, 9, "safety"),
        (10, 19, "none"),
    ]
    assert pieces[1].gates == {"safety": 4, "none": 1}
    assert pieces[1].intervened == 4
