"""Signals of the gate against plain loops in a corridor, what followed by hand, and the stage on small real artifacts."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pydantic import ValidationError
from scipy.stats import spearmanr
from torch import Tensor

from tests.artifacts import tiny_artifacts
from tests.learning.recordings import recording
from tests.learning.test_critics import Plain, still
from tests.learning.test_rollouts import short_task
from tests.worlds import Corridor, LinearCritics
from wasp_cli.errors import WaspError
from wasp_cli.learning import gate_signals
from wasp_cli.learning.closed_loop import Loop
from wasp_cli.learning.configs import CriticsConfig, GateSignalsConfig, ReturnsConfig
from wasp_cli.learning.dataset import record
from wasp_cli.learning.encoding import encode
from wasp_cli.learning.gate_signals import (
    EXPERT,
    FIRST,
    GATE,
    NOW,
    SUM,
    SignalRecorder,
    bootstrap,
    critic_alone,
    discounted,
    look_ahead,
    one_step,
)
from wasp_cli.learning.gate_signals_judge import SWEEP, SignalRows, judged, reliability_groups, signal_rows
from wasp_cli.learning.latents import save_latents
from wasp_cli.learning.shards import read_shards, write_shard
from wasp_cli.methods.noise import DecisionNoise, gumbel
from wasp_cli.metrics.ranking import average_precision
from wasp_cli.models.base import Latent
from wasp_cli.models.lookahead import LookAhead
from wasp_cli.models.policy import Skills
from wasp_cli.models.world_model import load_world_model
from wasp_cli.operators.base import EpisodeNoise, Operator
from wasp_cli.operators.laggy import LaggyOperator
from wasp_cli.plan.node import Part
from wasp_cli.report.trained.artifacts import Trained
from wasp_cli.report.trained.pages import signals_markdown
from wasp_cli.report.trained.table import training_tables
from wasp_cli.spec.load import load
from wasp_cli.spec.model import DEFAULT_STAGES, validate
from wasp_cli.stages.base import Job, no_progress
from wasp_cli.stages.gate_signals import GateSignalsStage

LOW, HIGH, KEEP = 0.05, 0.4, 0.9
ALL_ROWS = torch.ones(2, dtype=torch.bool)


class Ending(Corridor):
    """A corridor in which every step may be the last one."""

    def continues(self, latent: Latent) -> Tensor:
        return torch.full_like(latent.h[..., 0], KEEP)


class SteepCritics(LinearCritics):
    def value_c(self, latent: Latent) -> Tensor:
        return 2 * super().value_c(latent)


def steady(action: float, batch: int) -> Operator:
    return Operator(lambda features: torch.full((len(features), 1), action), 1, EpisodeNoise([0] * batch), batch)


def test_signals_are_what_plain_loops_over_the_same_rollouts_count() -> None:
    config = GateSignalsConfig(horizon=4, rollouts=3, first_steps=2)
    returns = ReturnsConfig(gamma_r=0.9, gamma_c=0.8, lam=0.7)
    world = Ending(LOW, HIGH, jitter=0.05, dtype=torch.float64)
    critics = {0.8: LinearCritics(), 0.9: SteepCritics()}
    recorder = SignalRecorder(world, critics, critics, steady(-0.3, 2), config, returns)
    recorder.reset(ALL_ROWS, [5, 6])
    starts, a_h = (0.0, 0.3), (0.2, -0.9)
    command = torch.tensor(a_h, dtype=torch.float64).unsqueeze(1)
    decision = recorder.decide(world.at(*starts), command, steady(0.4, 2))
    assert torch.equal(decision.action, command)
    assert decision.record is None
    noise = DecisionNoise()
    noise.reset(ALL_ROWS, [5, 6])
    draws = gumbel(noise.next(), 4, 3, world.noise_size)  # [B, H, M, Z]

    def rollout(row: int, sample: int, then: float) -> tuple[list[float], list[float], list[float]]:
        x, xs, rewards = starts[row], [], []
        for k in range(4):
            rewards.append(0.1 * (a_h[row] if k == 0 else then))
            x += rewards[-1] + 0.05 * float(draws[row, k, sample, 0])
            xs.append(x)
        return xs, [float(LOW < x < HIGH) for x in xs], rewards

    def eq8(costs: list[float], values: list[float], gamma: float) -> float:
        future = values[-1]
        for cost, value in zip(costs[::-1], values[::-1], strict=True):
            future = cost + gamma * KEEP * (0.3 * value + 0.7 * future)
        return future

    expected: dict[str, list[float]] = {}
    promised: dict[str, list[float]] = {}
    for row in range(2):
        sums: dict[str, list[float]] = {}
        promises: dict[str, list[float]] = {}
        for sample in range(3):
            xs, costs, rewards = rollout(row, sample, 0.4)
            _, others, other_rewards = rollout(row, sample, -0.3)
            sums.setdefault(GATE, []).append(sum((0.8 * KEEP) ** k * c for k, c in enumerate(costs)))
            sums.setdefault(SUM, []).append(sum(KEEP**k * c for k, c in enumerate(costs)))
            sums.setdefault(discounted(0.9), []).append(sum((0.9 * KEEP) ** k * c for k, c in enumerate(costs)))
            sums.setdefault(FIRST, []).append(costs[0] + KEEP * costs[1])
            sums.setdefault(EXPERT, []).append(sum((0.8 * KEEP) ** k * c for k, c in enumerate(others)))
            for gamma, slope in ((0.8, 0.25), (0.9, 0.5)):
                values = [slope * abs(x) for x in xs]
                sums.setdefault(one_step(gamma), []).append(costs[0] + gamma * KEEP * values[0])
                sums.setdefault(bootstrap(gamma), []).append(eq8(costs, values, gamma))
                slopes = [0.5 * x for x in xs]  # V_r of both
                promises.setdefault(discounted(gamma), []).append(sum((gamma * KEEP) ** k * r for k, r in enumerate(rewards)))
                promises.setdefault(one_step(gamma), []).append(rewards[0] + gamma * KEEP * slopes[0])
                promises.setdefault(bootstrap(gamma), []).append(eq8(rewards, slopes, gamma))
            promises.setdefault(SUM, []).append(sum(KEEP**k * r for k, r in enumerate(rewards)))
            promises.setdefault(FIRST, []).append(rewards[0] + KEEP * rewards[1])
            promises.setdefault(EXPERT, []).append(sum((0.9 * KEEP) ** k * r for k, r in enumerate(other_rewards)))
        for found, wanted in ((sums, expected), (promises, promised)):
            for name, samples in found.items():
                wanted.setdefault(name, []).append(sum(samples) / 3)
        promised.setdefault(NOW, []).append(0.0)  # a state alone has no reward here
        for gamma in (0.8, 0.9):
            promised.setdefault(critic_alone(gamma), []).append(0.5 * starts[row])
        expected.setdefault(NOW, []).append(float(LOW < starts[row] < HIGH))
        for gamma, slope in ((0.8, 0.25), (0.9, 0.5)):
            expected.setdefault(critic_alone(gamma), []).append(slope * abs(starts[row]))
    for (seen,), all_of_them in ((recorder.seen, expected), (recorder.promised, promised)):
        assert set(seen) == set(all_of_them)
        for name, values in all_of_them.items():
            assert seen[name].tolist() == pytest.approx(values, abs=1e-6), name
    assert len({round(value, 6) for values in expected.values() for value in values}) > 15, "the signals differ"


def test_the_operator_is_imagined_from_its_real_memory() -> None:
    """Forward where the corridor begins, else back: whoever always repeats the first command runs into the costs, whoever does not, not."""
    config = GateSignalsConfig(horizon=5, rollouts=2)
    policy = lambda features: torch.where(features[:, :1] < 0.05, 1.0, -1.0)  # noqa: E731
    laggy = LaggyOperator(policy, 1, EpisodeNoise([1, 2]), 2)
    laggy.p = 1.0
    world = Corridor(0.35, 10.0)
    expert = Operator(policy, 1, EpisodeNoise([1, 2]), 2)
    recorder = SignalRecorder(world, {0.95: LinearCritics()}, {0.99: LinearCritics()}, expert, config, ReturnsConfig())
    recorder.reset(ALL_ROWS, [0, 0])
    start = world.at(0.0, 0.0)
    a_h = laggy.command(start.features)
    before = laggy.snapshot()
    recorder.decide(start, a_h, laggy)
    assert all(torch.equal(value, laggy.snapshot()[name]) for name, value in before.items()), "watching moves no memory and no noise"
    assert recorder.seen[0][GATE].tolist() == pytest.approx([0.95**3 + 0.95**4] * 2)
    assert recorder.seen[0][EXPERT].tolist() == [0.0, 0.0]
    later = world.at(0.3, 0.3)  # here the policy alone would turn back at once
    a_h = laggy.command(later.features)
    recorder.decide(later, a_h, laggy)
    assert recorder.seen[1][SUM].tolist() == [5.0, 5.0]
    assert recorder.seen[1][EXPERT].tolist() == [1.0, 1.0], "the command that was just given is executed, whoever is imagined"


def loop(costs: list[list[int]], ends: list[bool]) -> Loop:
    """Episodes of their own lengths; `ends` are over by the task's rule, the others by the time limit. Rewards are twice the costs."""
    size = (max(map(len, costs)), len(costs))
    cost, alive, terminated = (np.zeros(size, bool) for _ in range(3))
    for row, (values, end) in enumerate(zip(costs, ends, strict=True)):
        cost[: len(values), row], alive[: len(values), row] = values, True
        cost[len(values) :, row] = True  # what stands there after an end means nothing
        terminated[len(values) - 1, row] = end
    empty = np.zeros(size)
    return Loop(2.0 * cost, cost, empty, empty, empty, alive, terminated, empty, empty, [], empty[:, 0], None, None)


HALVES = ReturnsConfig(gamma_r=0.5, gamma_c=0.5)


def test_windows_begin_with_the_decision_and_end_with_the_episode() -> None:
    recorded = loop([[0, 1, 1, 0, 0, 0, 1], [0, 0, 1, 0], [1]], [False, True, False])
    seen = [{"x": torch.tensor([t, 10.0 + t, 20.0 + t])} for t in range(7)]
    rows = signal_rows(recorded, seen, [{"y": 2 * row["x"]} for row in seen], 3, HALVES, first=4)
    assert rows.episode.tolist() == [4] * 5 + [5] * 4  # one decision before a time limit says nothing of the next three
    assert rows.signals["x"].tolist() == [0, 1, 2, 3, 4, 10, 11, 12, 13]
    assert rows.ahead.tolist() == [2, 2, 1, 0, 1, 1, 1, 1, 0]
    assert rows.discounted.tolist() == [0.75, 1.5, 1.0, 0.0, 0.25, 0.25, 0.5, 1.0, 0.0]
    assert rows.before.tolist() == [False, False, True, True, False, False, False, False, True]
    assert rows.promised["y"].tolist() == [0, 2, 4, 6, 8, 20, 22, 24, 26]
    assert rows.earned.tolist() == [1.5, 3.0, 2.0, 0.0, 0.5, 0.5, 1.0, 2.0, 0.0]
    # To the end: what lies behind the limit, up to 1 / 2^3.5, is filled up with the mean reward 10/12.
    sums = [2 * (1 / 2 + 1 / 4 + 1 / 64), 2 * (1 + 1 / 2 + 1 / 32), 2 * (1 + 1 / 16), 2 / 8]
    assert rows.rest[:4].tolist() == pytest.approx([value + 0.5 ** (7 - t) * 10 / 12 / (1 - 0.5) for t, value in enumerate(sums)])
    assert np.isnan(rows.rest[4])
    assert rows.rest[5:].tolist() == [0.5, 1.0, 2.0, 0.0]
    assert len(signal_rows(loop([[0, 1]], [False]), seen[:2], seen[:2], 3, HALVES).ahead) == 0


def rows_of(episodes: int = 6, length: int = 40) -> SignalRows:
    """A perfect signal, one that is the gate's, a worse one and a constant, on random costs."""
    random = np.random.default_rng(0)
    ahead = np.where(random.random(episodes * length) < 0.3, random.integers(1, 5, episodes * length), 0).astype(float)
    gate = ahead + random.normal(0, 1.0, len(ahead))
    worse = ahead + random.normal(0, 6.0, len(ahead))
    before = random.random(len(ahead)) < 0.2
    signals = {GATE: gate, NOW: np.full(len(ahead), 0.5), SUM: ahead, FIRST: worse}
    promised = {SUM: ahead, FIRST: worse, NOW: np.zeros(len(ahead))}
    rest = np.where(np.arange(len(ahead)) % 2 == 0, 3.0 * ahead, np.nan)
    return SignalRows(signals, promised, before, ahead, 0.9 * ahead, 2.0 * ahead + 1.0, rest, np.repeat(np.arange(episodes), length))


def test_signals_of_the_return_are_correlated_with_what_was_earned() -> None:
    rows = rows_of()
    found = judged(rows, 0.3, FIRST, FIRST)["returns"]
    assert (found["window"]["decisions"], found["rest"]["decisions"]) == (240, 120)
    for span, slope in (("window", 2.0), ("rest", 3.0)):
        table = found[span]["signals"]
        known = ~np.isnan(rows.rest) if span == "rest" else np.ones(240, bool)
        real = slope * rows.ahead + (span == "window")
        perfect, own, silent = table[SUM], table[FIRST], table[NOW]
        assert [perfect[key] for key in ("pearson", "pearson_low", "rank", "rank_high")] == pytest.approx([1.0] * 4)
        score = rows.promised[FIRST][known]
        assert own["pearson"] == pytest.approx(np.corrcoef(score, real[known])[0, 1])
        assert own["rank"] == pytest.approx(spearmanr(score, real[known]).statistic)
        assert own["pearson_low"] < own["pearson"] < own["pearson_high"] < 1.0
        assert own["rank_low"] < own["rank"] < own["rank_high"]
        assert (own["behind"], own["behind_low"], own["behind_high"]) == (0.0, 0.0, 0.0)
        assert perfect["behind_high"] < 0, "surely better"
        assert perfect["predicted_over_real"] == pytest.approx(rows.ahead[known].mean() / real[known].mean())
        assert found[span]["real_mean"] == pytest.approx(real[known].mean())
        assert np.isnan([silent["pearson"], silent["rank"], silent["pearson_low"], silent["behind_low"]]).all()
        assert silent["predicted_over_real"] == 0.0


def test_signals_are_ranked_beside_the_gates_own() -> None:
    rows = rows_of()
    event, calm = rows.ahead > 0, ~rows.before
    table = judged(rows, 0.3, FIRST, SUM)
    found = table["signals"]
    assert (table["episodes"], table["decisions"], table["base"]) == (6, 240, pytest.approx(event.mean()))
    assert (found[SUM]["auprc"], found[SUM]["recall"]) == (1.0, 1.0)
    assert found[NOW]["auprc"] == pytest.approx(event.mean()) == table["base"]
    assert found[NOW]["recall"] == 0.0
    assert found[GATE]["auprc"] == pytest.approx(average_precision(event, rows.signals[GATE]))
    assert found[GATE]["onset_auprc"] == pytest.approx(average_precision(event[calm], rows.signals[GATE][calm]))
    assert table["onset_base"] == pytest.approx(event[calm].mean())
    for row in found.values():
        assert row["auprc_low"] <= row["auprc"] <= row["auprc_high"]
    assert (found[GATE]["behind"], found[GATE]["behind_low"], found[GATE]["behind_high"]) == (0.0, 0.0, 0.0)
    assert found[FIRST]["behind_low"] > 0, "surely worse"
    assert found[SUM]["behind_high"] < 0, "surely better"
    own = rows.signals[GATE]
    assert table["gate"]["fires"] == pytest.approx((own > 0.3).mean())
    assert table["gate"]["precision"] == pytest.approx(event[own > 0.3].mean())
    assert table["gate"]["foreseen"] == pytest.approx((own[event] > 0.3).mean())
    assert table["gate"]["onset_false_alarms"] == pytest.approx((own[~event & calm] > 0.3).mean())
    assert table["rival"]["fires"] == pytest.approx((own > 0.3).mean(), abs=0.01)
    at = table["rival"]["threshold"]
    assert table["rival"]["foreseen"] == pytest.approx((rows.signals[FIRST][event] > at).mean())
    assert [row["fires"] for row in table["sweep"][GATE]] == [pytest.approx((own > value).mean()) for value in SWEEP]
    assert [row["false_alarms"] for row in table["sweep"][FIRST]] == [
        pytest.approx((rows.signals[FIRST][~event] > value).mean()) for value in SWEEP
    ]
    assert table["gate"]["predicted_over_real"] == pytest.approx(own.mean() / rows.discounted.mean())


def test_what_too_few_episodes_or_no_costs_leave_open_is_undefined() -> None:
    one = judged(rows_of(1), 0.3, SUM, SUM)["signals"][SUM]
    assert one["auprc"] == 1.0
    assert np.isnan([one[key] for key in ("auprc_low", "auprc_high", "behind_low", "behind_high")]).all()
    rows = rows_of(2)
    calm = judged(rows._replace(ahead=0 * rows.ahead, discounted=0 * rows.ahead), 0.3, SUM, SUM)
    assert np.isnan([calm["signals"][SUM]["behind_low"], calm["gate"]["predicted_over_real"], calm["gate"]["foreseen"]]).all()
    empty = judged(SignalRows({GATE: np.zeros(0)}, {SUM: np.zeros(0)}, *(np.zeros(0, bool) for _ in range(6))), 0.3, GATE, SUM)
    assert empty["decisions"] == empty["returns"]["rest"]["decisions"] == 0
    assert np.isnan(empty["returns"]["window"]["signals"][SUM]["rank"])
    assert np.isnan(empty["signals"][GATE]["auprc"])


def test_reliability_groups_are_equally_large_and_ordered() -> None:
    random = np.random.default_rng(0)
    predicted = random.random(105)
    groups = reliability_groups(predicted, 2 * predicted, predicted > 0.5)
    assert sum(group["size"] for group in groups) == 105
    assert {group["size"] for group in groups} == {10, 11}
    assert [group["predicted"] for group in groups] == sorted(group["predicted"] for group in groups)
    assert all(group["real"] == pytest.approx(2 * group["predicted"]) for group in groups)
    assert (groups[0]["any"], groups[-1]["any"]) == (0.0, 1.0)
    assert len(reliability_groups(predicted[:4], predicted[:4], predicted[:4] > 0)) == 4


def test_critics_at_other_discounts_are_trained_and_the_known_one_is_kept() -> None:
    known = LinearCritics()
    config = GateSignalsConfig(
        gammas=(0.95, 0.5, 0.8), critics=CriticsConfig(hidden=(8,), updates=150, starts=4, learning_rate=1e-2, horizon=15, recorded=0.0)
    )
    told: list[float] = []
    critics, promises, curves = gate_signals.critics_by_discount(
        Plain(), Skills([1.0], 3, [8], 1), recording(), still(36), known, config, ReturnsConfig(), ("goal1", 0),  # type: ignore[arg-type]
        lambda share, text: told.append(share),
    )  # fmt: skip
    assert list(critics) == [0.5, 0.8, 0.95]
    assert critics[0.95] is known
    assert list(promises) == [0.5, 0.8, 0.95, 0.99]
    assert promises[0.99] is known
    assert list(curves) == ["0.95", "0.5", "0.8"]
    start = still(1).at(torch.zeros(1, dtype=torch.long))
    for gamma in (0.5, 0.8):
        assert critics[gamma].value_c(start).item() == pytest.approx(0.5 / (1 - gamma * 0.9), rel=0.05)
        assert promises[gamma].value_r(start).item() == pytest.approx(1 / (1 - gamma * 0.9), rel=0.05)
    assert told == sorted(told)
    assert told[-1] == 1.0


# -- the stage --------------------------------------------------------------------------------------------------

DECISIONS, WINDOW = 12, 3


class Sums(LookAhead):
    """Within k decisions a cost is as probable as k times the sum of the commands that it reads, with h."""

    def __init__(self, commands: int) -> None:
        super().__init__(1, 1, 1, commands, [1], 5)

    def forward(self, features: Tensor, commands: Tensor) -> Tensor:
        total: Tensor = features.sum(-1) + commands[:, : self.commands].sum((1, 2))
        return total.unsqueeze(-1) * torch.arange(1, 6)


def test_the_direct_look_ahead_hears_the_operator_s_own_commands_and_changes_no_other_signal() -> None:
    config, returns = GateSignalsConfig(horizon=4, rollouts=3, first_steps=2), ReturnsConfig()
    world = Ending(LOW, HIGH, jitter=0.05, dtype=torch.float64)
    command, seen = torch.tensor([[0.2], [-0.9]], dtype=torch.float64), []
    for head in (None, Sums(3)):
        critics = {0.95: LinearCritics()}, {0.99: LinearCritics()}
        recorder = SignalRecorder(world, *critics, steady(-0.3, 2), config, returns, head)
        recorder.reset(ALL_ROWS, [5, 6])
        latent = world.at(0.0, 0.3)
        recorder.decide(latent, command, steady(0.4, 2))
        seen.append(recorder.seen[0])
    found = seen[1].pop(look_ahead(5))
    assert found == pytest.approx(5 * (latent.features.sum(-1) + command[:, 0] + 0.4 + 0.4))
    assert all(torch.equal(value, seen[1][name]) for name, value in seen[0].items())
    assert set(seen[0]) == set(seen[1])  # a look ahead of five decisions is asked about no longer window
    with pytest.raises(WaspError, match="reads 5 commands"):
        SignalRecorder(world, *critics, steady(-0.3, 2), config, returns, Sums(5))


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folders = tiny_artifacts(tmp_path_factory.mktemp("artifacts"))
    folders["dataset"] = folders["policies"].parent / "dataset"
    folders["dataset"].mkdir()
    driven = record(short_task(2), [0, 5], lambda seen: np.zeros((2, 2), np.float32), ["expert", "noisy"], 0)
    write_shard(folders["dataset"] / "shard-0000.parquet", driven, ("hazards",))
    model = load_world_model(folders["world_model"])
    folders["latents"] = folders["dataset"]
    save_latents(encode(model, read_shards(folders["dataset"]), no_progress), folders["latents"])
    return {kind: folders[kind] for kind in GateSignalsStage.needs}


def costly_task(name: str, batch: int, **options: Any) -> Any:
    """Short episodes in which every fifth decision costs."""
    task = short_task(batch)
    inner, decisions = task.step, [0]

    def step(action: Any) -> Any:
        decisions[0] += 1
        return inner(action)._replace(cost=np.full(batch, decisions[0] % 5 == 0))

    task.step = step
    return task


def test_the_stage_judges_every_operator_that_can_be_built(
    inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("wasp_cli.tasks.make.make_task", costly_task)
    config = GateSignalsConfig(
        operators={"noisy": (0.4,), "limited-skill": (0.25, 0.5)}, episodes=2, window=WINDOW, horizon=3, rollouts=2, gammas=(0.95, 0.99),
        critics=CriticsConfig(hidden=(8,), updates=2, starts=4, horizon=3, q_updates=2, q_batch=4),
    )  # fmt: skip
    job = Job("gate_signals", "goal1", 1, config, {"action_repeat": 4, "returns": ReturnsConfig()}, {}, inputs, tmp_path, tmp_path)
    summaries = []
    for name in ("first", "again"):
        (tmp_path / name).mkdir()
        summaries.append(GateSignalsStage().run(dataclasses.replace(job, out_dir=tmp_path / name)))
    files = {name: {path.name: path.read_bytes() for path in (tmp_path / name).iterdir()} for name in ("first", "again")}
    assert files["first"] == files["again"]
    assert summaries[0] == pytest.approx(summaries[1], nan_ok=True)
    assert set(files["first"]) == {"signals.json"}
    found = json.loads(files["first"]["signals.json"], parse_constant=pytest.fail)
    assert list(found["sets"]) == ["all", "unimpaired", "limited-skill 0.25", "noisy 0.4"]
    assert found["left_out"] == ["limited-skill 0.5"]
    names = {NOW, GATE, SUM, FIRST, EXPERT} | {kind(gamma) for kind in (critic_alone, one_step, bootstrap) for gamma in (0.95, 0.99)}
    names.add(discounted(0.99))
    ahead = set(map(look_ahead, (5, 10, 15)))  # of the cost alone
    for name, table in found["sets"].items():
        assert set(table["signals"]) == names | ahead
        assert table["decisions"] == 2 * (DECISIONS - WINDOW + 1) * (3 if name == "all" else 1)
        assert table["episodes"] == (6 if name == "all" else 2)
    unimpaired = found["sets"]["unimpaired"]["signals"]
    assert unimpaired[EXPERT] == unimpaired[GATE], "the unimpaired operator is the expert"
    for table in found["sets"].values():
        for span in ("window", "rest"):
            promised = set(table["returns"][span]["signals"])
            assert promised == names - {GATE} | {discounted(0.95)}
    assert list(found["curves"]) == ["0.95", "0.99"]
    pooled = found["sets"]["all"]["returns"]["rest"]["signals"]
    assert summaries[0]["return_rest_bootstrap"] == pytest.approx(pooled[bootstrap(0.99)]["pearson"] or float("nan"), abs=5e-4, nan_ok=True)
    assert summaries[0]["auprc"] == pytest.approx(found["sets"]["all"]["signals"][GATE]["auprc"], abs=5e-4)
    assert summaries[0]["auprc_bootstrap"] == pytest.approx(found["sets"]["all"]["signals"][bootstrap(0.95)]["auprc"], abs=5e-4)
    assert "limited-skill 0.5" in signals_markdown(found)


def test_the_report_shows_the_gate_where_it_was_judged() -> None:
    parts = [(Part("goal1", kind, 0, 1), kind) for kind in ("critics", "gate_signals")]
    judge = Trained("gate_signals", "goal1", 0, "gate_signals", 1.0, {"auprc": 0.71, "auprc_bootstrap": 0.64})
    critics = Trained("critics", "goal1", 0, "critics", 1.0, {"rank_r": 0.5, "rank_c": 0.4})
    (table,) = training_tables(parts, [critics, judge])
    shown = {column.key: value.mean for column, value in zip(table.columns, table.rows[0].values, strict=True)}
    assert (shown["gate_signals.auprc"], shown["gate_signals.auprc_bootstrap"]) == (0.71, 0.64)
    (table,) = training_tables(parts[:1], [critics])
    assert not [column for column in table.columns if column.key.startswith("gate_signals")]
    assert len(table.meanings) == 1


# -- how a spec asks for it -------------------------------------------------------------------------------------


def test_no_spec_runs_it_unless_asked() -> None:
    assert "gate_signals" not in DEFAULT_STAGES
    folder = Path(__file__).parents[2] / "specs"
    stages = {path.stem: load(path).spec.stages for path in folder.glob("*.yaml") if path.stem != "paper"}
    asking = {name: named for name, named in stages.items() if "gate_signals" in named}
    assert set(asking) == {"smoke", "worldmodel"}
    assert all(set(DEFAULT_STAGES) < set(stages) for stages in asking.values())


def test_a_skill_that_is_not_there_is_no_error_but_an_unknown_operator_is() -> None:
    document: dict[str, Any] = {"name": "x", "tasks": ["goal1"], "methods": [], "stages": ["gate_signals"], "seeds": [0], "preset": "smoke"}
    asked = validate({**document, "gate_signals": {"operators": {"limited-skill": [0.3]}}})
    assert asked.stage("gate_signals").operators == {"limited-skill": (0.3,)}  # type: ignore[attr-defined]
    with pytest.raises(ValidationError) as refused:
        validate({**document, "expert": {"checkpoints": [0.5, 1.0]}})
    assert {error["loc"][0] for error in refused.value.errors()} == {"residual", "rollouts"}
    with pytest.raises(ValidationError) as refused:
        validate({**document, "gate_signals": {"operators": {"nosy": [0.1], "noisy": [2.0], "limited-skill": [0.3]}}})
    assert [error["type"] for error in refused.value.errors()] == ["unknown_name", "severity_range"]
