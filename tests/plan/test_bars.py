"""Whether a stage is good enough: every bar on numbers that reach it and on numbers that do not,
and the verdict on stored nodes.
"""

import pytest

from wasp_cli.plan.bars import COSTLY_ROWS, Measured, shortfalls
from wasp_cli.plan.judged import judged
from wasp_cli.store.artifact import commit, staging_folder

CONFIG = {"multiplier_min": 0.05, "multiplier_max": 5.0, "cost_limit": 25.0}


def reference(returned: float, rate: float) -> dict[str, float]:
    return {"return": returned, "return_se": 0.5, "cost": rate / 5, "cost_per_1000": rate}


EXPERT = {
    "return": 12.0,
    "return_se": 0.5,
    "cost_per_1000": 4.0,
    "multiplier": 0.6,
    "zero": reference(0.0, 1.0),
    "random": reference(2.0, 40.0),
}
DATASET = {"steps": 24_000, "costly_share": 0.05, "sources_not_seen": 0}
FORESIGHT = {
    "auprc@1": 0.95,
    "persistence@1": 0.7,
    "base@1": 0.04,
    "reward_r2@1": 0.8,
    "auprc@5": 0.7,
    "persistence@5": 0.2,
    "base@5": 0.04,
    "reward_r2@5": 0.4,
}
POLICIES = {"return": 11.0, "cost": 2.0, "privileged_return": 12.0, "privileged_cost": 1.5}
CALIBRATION = {"safety_rate": 0.05, "tau_c": 1.0, "g_cost_p95": 0.5}
BEHIND = {"expert": {"random": reference(2.0, 40.0)}}


def sentences(kind, summary, config=CONFIG, behind=BEHIND):
    return [found.sentence for found in shortfalls(kind, Measured(summary, config, behind))]


@pytest.mark.parametrize(
    ("kind", "summary"),
    [
        ("expert", EXPERT),
        ("dataset", DATASET),
        ("diagnostics", FORESIGHT),
        ("policies", POLICIES),
        ("calibration", CALIBRATION),
        ("evaluate", {"return": -1e9}),
    ],
)
def test_good_numbers_reach_every_bar_and_absent_ones_are_not_judged(kind, summary):
    assert sentences(kind, summary) == []
    assert sentences(kind, {}, {}, {}) == []
    assert sentences(kind, dict.fromkeys(summary, float("nan")), {}, {}) == []
    assert sentences(kind, dict.fromkeys(summary), {}, {}) == []


@pytest.mark.parametrize(
    ("kind", "summary", "told"),
    [
        ("expert", EXPERT | {"zero": reference(11.9, 1.0)}, ["12", "zero commands 11.9"]),
        # within two standard errors of the difference, 2 * sqrt(.5**2 + .5**2)
        ("expert", EXPERT | {"random": reference(10.7, 40.0)}, ["random commands 10.7"]),
        (
            "expert",
            EXPERT | {"multiplier": 0.05, "cost_per_1000": 21.0},
            ["never constrained", "0.05", "21", "40"],
        ),
        (
            "expert",
            EXPERT | {"multiplier": 5.0, "cost_per_1000": 26.0},
            ["out of its reach", "25", "26"],
        ),
        (
            "expert",
            EXPERT | {"multiplier": 5.0, "cost_limit": 3.0},
            ["out of its reach", "limit of 3 "],
        ),
        (
            "expert",
            EXPERT | {"cost_limit": 13.0, "training_cost_per_1000": 120.0},
            ["does not keep its limit of 13", "120"],
        ),
        ("dataset", DATASET | {"costly_share": 0.00375}, ["90 of 24,000", "0.38%"]),
        (
            "dataset",
            DATASET | {"sources_not_seen": 1, "unseen_sources": "fire"},
            ["1 of", "(fire)"],
        ),
        # of ViZDoom's first table
        (
            "diagnostics",
            FORESIGHT | {"auprc@1": 0.016, "persistence@1": 0.012, "base@1": 0.009},
            ["does not know the cost", "0.02", "0.009"],
        ),
        # sees a cost one decision ahead no better than that it goes on
        ("diagnostics", FORESIGHT | {"auprc@1": 0.72}, ["0.72", "0.70"]),
        ("diagnostics", FORESIGHT | {"auprc@5": 0.047}, ["5 ahead AUPRC 0.05"]),
        ("diagnostics", {"base@1": 0.0}, ["nothing cost"]),
        ("diagnostics", FORESIGHT | {"reward_r2@5": 0.05}, ["5 ahead 0.05"]),
        # (6 - 2) of (12 - 2)
        ("policies", POLICIES | {"return": 6.0}, ["keeps 40%", "6 of 12", "random commands (2)"]),
        ("policies", POLICIES | {"cost": 5.0}, ["costs 5", "1.5", "8"]),
        ("calibration", CALIBRATION | {"safety_rate": 0.97}, ["97%"]),
    ],
)
def test_numbers_below_a_bar_are_told_in_one_sentence_with_a_remedy(kind, summary, told):
    (found,) = shortfalls(kind, Measured(summary, CONFIG, BEHIND))
    for part in told:
        assert part in found.sentence
    assert found.remedy


def test_a_clear_margin_counts_the_spread_of_both():
    close = EXPERT | {"random": reference(10.5, 40.0)}
    assert not sentences("expert", close), "1.5 is more than two standard errors of .71"
    assert sentences("expert", close | {"return_se": 1.0})


def test_a_safety_gate_that_spares_a_safe_expert_is_fine():
    assert not sentences("calibration", CALIBRATION | {"safety_rate": 0.0})


def test_a_multiplier_at_its_floor_is_fine_where_the_expert_costs_little():
    assert not sentences("expert", EXPERT | {"multiplier": 0.05})


def test_without_random_commands_the_share_is_that_of_the_return():
    half = POLICIES | {"return": 6.0, "cost": 100.0}
    (sentence,) = sentences("policies", half, behind={})
    assert "keeps 50%" in sentence


@pytest.mark.parametrize(("rows", "enough"), [(COSTLY_ROWS - 1, False), (COSTLY_ROWS, True)])
def test_costly_rows_are_counted(rows, enough):
    found = sentences("dataset", DATASET | {"steps": 10_000, "costly_share": rows / 10_000})
    assert (not found) == enough


def stored(layout, kind, key, summary, upstream):
    staging = staging_folder(layout, key)
    manifest = {
        "kind": kind,
        "key": key,
        "label": f"a {kind}",
        "summary": summary,
        "config": CONFIG,
        "upstream": dict(upstream),
        "upstream_kinds": {name: name for name in upstream},
    }
    commit(layout, kind, key, staging, manifest)


def test_a_stored_node_is_held_against_what_stands_behind_it(layout):
    expert, policies = "a" * 20, "b" * 20
    stored(layout, "policies", policies, POLICIES | {"return": 6.0}, {"expert": expert})
    (without,) = judged(layout, "policies", policies)
    assert "keeps 50%" in without.sentence, "the expert is not there"
    stored(layout, "expert", expert, EXPERT, {})
    (found,) = judged(layout, "policies", policies)
    assert "keeps 40%" in found.sentence
    assert judged(layout, "policies", "c" * 20) == []


@pytest.mark.parametrize("summary", [None, [], "text", {"steps": "many", "costly_share": []}])
def test_a_manifest_without_a_valid_form_is_not_judged(layout, summary):
    stored(layout, "dataset", "d" * 20, summary, {})
    assert judged(layout, "dataset", "d" * 20) == []
