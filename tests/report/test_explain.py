"""Why an assistant did what it did: from invented rows to facts, words and JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.report.explained import KEY, NAN, WASP, Invented, looked, text_of, told
from wasp_cli.errors import UsageError
from wasp_cli.metrics.episode import GATE_SAFETY, GATE_TASK
from wasp_cli.report.explain.facts import as_json, exceeds
from wasp_cli.report.explain.look import look
from wasp_cli.report.explain.stored import Episode, read_episode
from wasp_cli.report.explain.story_text import MOST_RUNS, story_lines
from wasp_cli.report.explain.strip import strip_lines
from wasp_cli.report.explain.tell import merged, tell
from wasp_cli.store.find import FoundCell
from wasp_cli.store.tables import VERSION_KEY, Thresholds


@pytest.fixture
def mixed(tmp_path: Path) -> Episode:
    """Quiet, two safety decisions, quiet with a cost that was missed, a task decision."""
    made = Invented()
    made.fire(2, GATE_SAFETY)
    made.fire(3, GATE_SAFETY)
    made.fire(6, GATE_TASK, safe=(12, 25, 30))
    made.pay(3, 5)
    made.goals[7] = 1
    return made.read(tmp_path)


STORY = """\
goal1 s0 wasp laggy=0.7 · episode 0  (of 0 to 2)
  cell            Goal1, WASP, operator: laggy 0.7 (probability of repeating the last command), seed 0 (world 100)
  key             0123456789abcdef0123
  safety gate     fires where more than 0.300 costly decisions within the next 4, discounted, are to be expected if the
                  operator goes on alone (G^c > τ_c, Eq. 9)
  task gate       asked where the safety gate is silent; fires where a small correction is expected to gain more return
                  than 0.500 (ΔG > τ_r, Eq. 12)
  outcome         return 3.50, cost 4 env steps, 1 goal (no success) in 8 decisions of 4 env steps (0.08 s)
  interventions   3 of 8 decisions changed (37.5%, Int.), by 0.71 on average (|a - a^H|)
  gates           safety gate 25.0%, task gate 12.5%, silent 62.5% of decisions; while planning, 22% of the search steps
                  found too few safe candidates (Case II)
  costs           2 decisions with cost: 1 while every gate was silent (missed), 1 although one had fired
  decision time   half of the decisions within 2 ms (p50), 95 % within 2 ms (p95); each is the time of all 3 episodes,
                  decided side by side, divided by 3

Over the episode
  G^c       ▂▂▇▇▂▂▂▂
  gate      ··SS··T·
  cost      ···x·!··
  decision  0      7
  ▁▂▃▄ up to τ_c = 0.3, ▅▆▇█ above it; S safety; T task; x cost, ! cost that every gate missed

Run by run
  decisions  gate            changed  command → executed (means)       G^c (τ_c 0.300)  ΔG (τ_r 0.500)  cost  missed at
  0-1        -                     -  (+0.50, -0.25) as commanded                0.125           0.250     -  -
  2-3        safety  2 of 2, by 0.71  (+0.50, -0.25) → (+0.00, +0.25)            0.500               -     2  -
  4-5        -                     -  (+0.50, -0.25) as commanded                0.125           0.250     2  5
  6          task    1 of 1, by 0.71  (+0.50, -0.25) → (+0.00, +0.25)            0.125           0.750     -  -
  7          -                     -  (+0.50, -0.25) as commanded                0.125           0.250     -  -
  changed: decisions whose command was not executed as it was, and by how much (|a - a^H|); cost: env steps with cost;
  missed: cost was paid and no gate had fired
  one decision in full: wasp explain CELL --episode 0 --step 5"""

LOOK = """\
goal1 s0 wasp laggy=0.7 · episode 0 · decision 2  (of 0 to 7)
  cell            Goal1, WASP, operator: laggy 0.7 (probability of repeating the last command), seed 0 (world 100)
  key             0123456789abcdef0123

What was done
  command         (+0.50, -0.25)  what the operator asked for (a^H)
  executed        (+0.00, +0.25)  command and first correction (a, Eq. 18)
  deviation       the assistant changed the command by 0.707 (|a - a^H|): an intervention

Why
  safety gate     FIRED. If the operator goes on alone, 0.500 costly decisions within the next 4, discounted, are to be
                  expected (G^c, Eq. 9): more than the 0.300 that are allowed (τ_c).
  task gate       Not asked. Safety has priority, and the safety gate had fired.

The plan
  search step 1   3 of 30 candidates predicted safe (|F_s|): Case II
  search step 2   12 of 30 candidates predicted safe (|F_s|): Case I
  search step 3   30 of 30 candidates predicted safe (|F_s|): Case I
  Case I          enough of them are safe (10, N_f; Eq. 14): on towards the highest predicted return among these
                  (Eq. 16)
  Case II         too few of them are safe (less than 10, N_f; Eq. 14): on towards less predicted cost first of all
                  (Eq. 17)
  correction      added to the command now, and to those that the operator is expected to give next (δa, Eq. 13); only
                  the first is executed before all is planned again
                  now  (-0.50, +0.50)
                  +1   (+0.25, +0.00)
  predicted       with the correction cost 0.200, return 1.500; with the commands alone cost 0.600 (G^c), return 1.250
                  (G^r). With it the cost stays within τ_c (0.200 against 0.300). These are other imagined futures than
                  the gate's, so that G^c may differ from the gate's.

What then happened
  this decision   reward +0.25, no cost
  and on          4 decisions from this one on (2-5, 2 of them with an intervention): reward +1.75, cost in 4 env steps
                  of 2 decisions
  foreseen        G^c expected 0.500 costly decisions of the operator alone; 0.625 came, both discounted by 0.500 per
                  decision (γ_c). What came includes what the assistant did

  decision time   2 ms: the 3 episodes of the cell are decided side by side, and this is their common time, 6 ms,
                  divided by 3. One episode alone takes something in between"""


def test_a_story_as_printed(mixed: Episode) -> None:
    assert told(mixed) == STORY


def test_a_decision_as_printed(mixed: Episode) -> None:
    assert looked(mixed, 2, 120) == LOOK


def test_totals_and_runs(mixed: Episode) -> None:
    story = tell(mixed)
    assert story.totals.missed == (5,)
    assert story.totals.costly == (3, 5)
    assert story.totals.intervened == (2, 3, 6)
    assert [(run.first, run.last, run.gate) for run in story.runs] == [
        (0, 1, "none"), (2, 3, "safety"), (4, 5, "none"), (6, 6, "task"), (7, 7, "none")
    ]  # fmt: skip
    assert story.runs[1].g_cost == (0.5, 0.5)
    assert story.runs[1].delta_g is None
    assert story.totals.gate_share == {"none": 0.625, "safety": 0.25, "task": 0.125}


def test_what_came_is_counted_from_the_decision_on(mixed: Episode) -> None:
    facts = look(mixed, 2)
    assert (facts.ahead.first, facts.ahead.last, facts.ahead.costly, facts.ahead.cost) == (2, 5, 2, 4)
    assert facts.ahead.discounted == 0.5**1 + 0.5**3
    assert facts.ahead.reward == sum(t / 8 for t in range(2, 6))
    late = look(mixed, 6)
    assert (late.ahead.first, late.ahead.last, late.ahead.goals, late.window) == (6, 7, 1, 4)
    assert "the episode ended before the 4 were full" in looked(mixed, 6)


def test_gates_of_one_decision(mixed: Episode) -> None:
    quiet, safety, task = look(mixed, 0), look(mixed, 2), look(mixed, 6)
    assert [(facts.safety.state, facts.task.state) for facts in (quiet, safety, task) if facts.safety and facts.task] == [
        ("silent", "silent"), ("fired", "not asked"), ("silent", "fired")
    ]  # fmt: skip
    assert "The best safe correction of 20 that were tried was expected to gain 0.250 return" in looked(mixed, 0)
    assert "no gate had fired, and without a gate nothing is planned" in looked(mixed, 0)
    text = looked(mixed, 6)
    assert "FIRED. The best safe correction of 20 that were tried was expected to gain 0.750 return (ΔG, Eq. 12): more than 0.500" in text
    assert "search step 1   12 of 20 candidates" in text  # the probe is the first batch
    assert "search step 2   25 of 30 candidates" in text
    assert "other imagined futures" not in text


def test_without_a_feasible_candidate_there_is_no_gain(tmp_path: Path) -> None:
    made = Invented()
    made.delta_g[1] = NAN
    episode = made.read(tmp_path)
    facts = look(episode, 1)
    assert facts.task is not None
    assert facts.task.state == "no candidate"
    assert "None of the corrections of 20 that were tried was predicted to keep the cost within τ_c (Eq. 11)" in looked(episode, 1)


@pytest.mark.parametrize(
    ("variant", "safety", "task"),
    [("full", "fired", "not asked"), ("safety-only", "fired", "off"), ("task-only", "off", "silent"), ("no-case2", "fired", "not asked")],
)
def test_gates_that_a_variant_does_without(variant: str, safety: str, task: str, tmp_path: Path) -> None:
    made = Invented(variant=variant)
    if variant == "task-only":
        made.g_cost[2] = 0.5  # computed, and of no consequence
    else:
        made.fire(2, GATE_SAFETY)
    episode = made.read(tmp_path)
    facts = look(episode, 2)
    assert facts.safety is not None
    assert facts.task is not None
    assert (facts.safety.state, facts.task.state) == (safety, task)
    assert ("switched off in this variant" in told(episode)) == ("off" in (safety, task))
    assert ("Switched off in this variant" in looked(episode, 2)) == ("off" in (safety, task))


@pytest.mark.parametrize(
    ("variant", "alone", "safe", "expected"),
    [
        ("full", 0.25, (3, 3, 3), "on a second look the command alone was predicted safe after all"),
        ("full", 0.6, (3, 3, 3), "nothing that was tried was predicted to be worth its size"),
        ("no-case2", 0.6, (0, 0, 0), "no candidate was safe, and this variant has no recovery"),
    ],
)
def test_a_gate_may_fire_and_the_command_stand(variant: str, alone: float, safe: Any, expected: str, tmp_path: Path) -> None:
    made = Invented(variant=variant)
    made.fire(2, GATE_SAFETY, residuals=np.zeros((2, 2)), safe=safe, cost=alone, alone=alone)
    episode = made.read(tmp_path)
    assert expected in looked(episode, 2)
    assert "none: the command stood" in looked(episode, 2)
    assert "at 1 of the 1 where one fired, the command stood all the same" in " ".join(told(episode).split())


def test_what_is_cut_off_at_the_bounds_is_said(tmp_path: Path) -> None:
    made = Invented()
    made.fire(2, GATE_SAFETY, residuals=((1.5, 0.0), (0.0, 0.0)))
    assert "command and first correction, cut off at the bounds (a, Eq. 18)" in looked(made.read(tmp_path), 2)


def test_a_critic_beyond_the_horizon_counts_otherwise(tmp_path: Path) -> None:
    made = Invented(config={**WASP, "bootstrap_cost": True})
    text = looked(made.read(tmp_path), 0)
    assert "a discounted cost of 0.125, a critic's view beyond the horizon included, is to be expected" in text
    assert "foreseen" not in text  # two different counts
    one_step = Invented(variant="no-rollout").read(tmp_path)
    assert (one_step.constants.horizon, one_step.constants.bootstrap_cost) == (1, True)
    assert look(one_step, 0).window == 15


def test_without_a_manifest_constants_are_unknown_and_costs_are_counted_over_15(tmp_path: Path) -> None:
    made = Invented(steps=30)
    made.fire(2, GATE_SAFETY)
    episode = made.read(tmp_path, manifest=False)
    assert look(episode, 2).window == 15
    assert "key             none; read from" in looked(episode, 2)
    assert "3 candidates predicted safe (|F_s|): Case II" in looked(episode, 2)
    assert "foreseen" not in looked(episode, 2)
    assert told(episode).startswith("goal1 s0 wasp laggy=0.7 · episode 0")


@pytest.mark.parametrize(("method", "gate", "moved"), [("human", 0, 0.0), ("expert", 0, 0.0), ("diffusion", 3, 0.25), ("saferl", 3, 0.25)])
def test_methods_without_a_choice_miss_nothing(method: str, gate: int, moved: float, tmp_path: Path) -> None:
    made = Invented(method=method, thresholds=Thresholds(), config={})
    made.gate[:] = gate
    made.a += moved
    made.pay(2, 3)
    episode = made.read(tmp_path)
    story = tell(episode)
    assert (story.gated, story.selective, story.totals.missed) == (False, False, ())
    assert [(run.first, run.last, run.cost) for run in story.runs] == [(0, 1, 0), (2, 3, 4), (4, 7, 0)]
    text = told(episode)
    assert "missed" not in text
    assert "gates  " not in text
    assert ("changed" in text) == bool(moved)
    assert "The plan" not in looked(episode, 2)


def test_another_methods_signal_is_shown_as_it_is(tmp_path: Path) -> None:
    made = Invented(method="theirs", thresholds=Thresholds(), config={})
    made.signal[:] = np.arange(8) / 8
    episode = made.read(tmp_path)
    assert "0.250, the method's own decision value" in looked(episode, 2)
    assert "not described: see the documentation of 'theirs'" in told(episode)


def test_gates_compare_in_single_precision() -> None:
    assert not exceeds(float(np.float32(0.3)), 0.3)
    assert exceeds(float(np.nextafter(np.float32(0.3), np.float32(1))), 0.3)
    assert not exceeds(None, 0.3)
    assert not exceeds(0.3, None)


def test_a_value_and_its_threshold_never_print_alike(tmp_path: Path) -> None:
    made = Invented()
    made.g_cost[0] = 0.29999
    assert "0.29999 costly decisions" in looked(made.read(tmp_path), 0)


@pytest.mark.parametrize("steps", [250, 1000])
def test_a_long_restless_episode_stays_readable(steps: int, tmp_path: Path) -> None:
    made = Invented(steps=steps)
    for t in range(steps):
        if t % 3:
            made.fire(t, (GATE_SAFETY, GATE_TASK)[t // 7 % 2])
    made.pay(*range(0, steps, 2))
    story = tell(made.read(tmp_path))
    lines = story_lines(story, 120)
    assert len(lines) < 60
    assert max(len(line.plain) for line in lines) <= 120
    assert f"{len(story.runs)} runs in {MOST_RUNS} lines" in " ".join(text_of(lines).split())


@pytest.mark.parametrize("width", [40, 60, 80, 100, 160])
def test_a_narrow_terminal_loses_columns_not_facts(width: int, mixed: Episode) -> None:
    text = told(mixed, width)
    assert "missed at" in text
    assert ("ΔG (τ_r" in text) == (width > 120 or "G^c (τ_c 0.300)  ΔG" in text)
    if width >= 60:
        assert max(map(len, text.splitlines()[:-1])) <= width


def test_a_short_quiet_run_joins_the_gate_around_it(tmp_path: Path) -> None:
    made = Invented(steps=20)
    for t in (5, 6, 8, 9):
        made.fire(t, GATE_SAFETY)
    pieces = merged(tell(made.read(tmp_path)).runs, 3)
    assert [(run.first, run.last, run.gate) for run in pieces] == [(0, 4, "none"), (5, 9, "safety"), (10, 19, "none")]
    assert pieces[1].gates == {"safety": 4, "none": 1}
    assert pieces[1].intervened == 4


def test_half_of_the_strip_is_the_threshold(tmp_path: Path) -> None:
    made = Invented()
    made.g_cost[:] = [0.0, 0.01, 0.3, 0.301, 0.6, 9.0, NAN, 0.15]
    curve, *_ = strip_lines(tell(made.read(tmp_path)), 80)
    assert curve.plain == "  G^c       ▁▁▄▅██ ▂"
    styles = {curve.plain[span.start] + curve.plain[span.end - 1]: span.style for span in curve.spans}
    assert styles["▁▄"] == "green"
    assert styles["▅█"] == "red"


def test_an_older_table_says_what_it_does_not_know(tmp_path: Path) -> None:
    made = Invented()
    made.fire(2, GATE_SAFETY)
    path = tmp_path / "cell.parquet"
    made.write(path)
    table = pq.read_table(path)
    steps = table["steps"].combine_chunks()
    flat = steps.flatten()
    kept = ("t", "reward", "cost", "cost_env", "env_steps", "goals", "a_h", "a", "deviation", "gate", "g_cost", "delta_g", "signal")
    columns = {name: flat.field(name) for name in kept}
    columns["safe"] = pa.array(np.where(np.asarray(columns["gate"]) == 1, 3, 0), pa.int16())
    columns["case2_share"] = pa.nulls(len(flat), pa.float32())
    older = pa.ListArray.from_arrays(steps.offsets, pa.StructArray.from_arrays(list(columns.values()), names=list(columns)))
    table = table.set_column(table.schema.get_field_index("steps"), "steps", older).replace_schema_metadata({VERSION_KEY: b"1"})
    pq.write_table(table, path, write_page_checksum=True)
    episode = read_episode(FoundCell(path, KEY, made.manifest()), 0)
    assert episode.version == 1
    text = looked(episode, 2)
    assert "FIRED" in text
    assert "not recorded (the file has an older table version)" in text
    assert "not in the file the predicted return" in " ".join(text.split())
    assert "(table version 1; a new run of the cell records them)" in " ".join(told(episode).split())
    assert len(as_json(look(episode, 2))["unknown"]) == 2


@pytest.mark.parametrize("episode", [-1, 3, 99])
def test_episodes_that_are_not_there(episode: int, tmp_path: Path) -> None:
    path = tmp_path / "cell.parquet"
    Invented().write(path)
    with pytest.raises(UsageError, match=f"there is no episode {episode}") as caught:
        read_episode(FoundCell(path), episode)
    assert caught.value.hint == "this cell has the episodes 0 to 2"


@pytest.mark.parametrize("t", [-1, 8])
def test_decisions_that_are_not_there(t: int, mixed: Episode) -> None:
    with pytest.raises(UsageError, match=f"there is no decision {t}") as caught:
        look(mixed, t)
    assert caught.value.hint == "episode 0 has the decisions 0 to 7"


def test_json_has_no_nan_and_the_same_facts(mixed: Episode) -> None:
    story = json.loads(json.dumps(as_json(tell(mixed)), allow_nan=False))
    assert story["who"]["key"] == KEY
    assert story["totals"]["return"] == 3.5
    assert story["totals"]["missed"] == [5]
    assert len(story["series"]["gate"]) == 8
    assert [run["gates"] for run in story["runs"]][1] == {"safety": 2}
    decision = json.loads(json.dumps(as_json(look(mixed, 2)), allow_nan=False))
    assert decision["plan"]["residuals"] == [[-0.5, 0.5], [0.25, 0.0]]
    assert decision["plan"]["return"] == 1.5
    assert decision["safety"] == {"state": "fired", "value": 0.5, "threshold": 0.3}
    assert decision["signal"] is None


def test_under_one_gate_the_story_is_of_costs(tmp_path: Path) -> None:
    made = Invented()
    made.pay(3)
    story = tell(made.read(tmp_path))
    assert [(run.first, run.last, run.gate) for run in story.runs] == [(0, 2, "none"), (3, 3, "none"), (4, 7, "none")]
    assert story.totals.gate_share == {"none": 1.0}
    assert "the gate never changed, so the lines are stretches with and without cost" in " ".join(text_of(story_lines(story, 120)).split())
