"""Diagnostics against models whose answers are known, and the stage on small real artifacts."""

import dataclasses
import json
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

from tests.learning.recordings import SOURCES, recording
from tests.learning.test_dataset import REPEAT
from tests.learning.test_dataset import job as dataset_job
from tests.worlds import Corridor
from wasp_cli.learning.behaviours import behaviours
from wasp_cli.learning.configs import DiagnosticsConfig, MixtureConfig, ReturnsConfig
from wasp_cli.learning.diagnostics import Alarm, judge_filter, judge_steps, judge_window
from wasp_cli.learning.forecast import Forecast, forecast, spread_starts, what_followed
from wasp_cli.learning.observations import judge_observations
from wasp_cli.learning.shards import Recording
from wasp_cli.learning.unseen import HALF_TRAINED, unseen_behaviours
from wasp_cli.metrics.ranking import average_precision
from wasp_cli.models.base import Latent
from wasp_cli.report.trained.evidence import open_loop_markdown
from wasp_cli.stages.diagnostics import SHOWN, DiagnosticsStage

HORIZON = 5
LOW, HIGH = 0.15, 0.5
GROUPS = ["all", "motion", "goal", "way", "walls", "things"]


class Rows:
    """Latents of rows that are known outright: h = [value of the row]."""

    def __init__(self, values: Any) -> None:
        self.values = torch.as_tensor(values, dtype=torch.float32).unsqueeze(1)

    def at(self, index: torch.Tensor) -> Latent:
        return Latent(self.values[index], torch.zeros(len(index), 1))


def corridor() -> tuple[Corridor, Recording, Rows]:
    """Episodes of different lengths in a corridor, driven at random."""
    data = recording((60, 9, 5, 80, 3))
    random = np.random.default_rng(1)
    action = np.where(data.first[:, None] > 0, 0, random.uniform(-1, 1, (157, 1))).astype(
        np.float32
    )
    x = np.concatenate([np.cumsum(0.1 * action[data.episode == e, 0]) for e in range(5)])
    cost = ((x > LOW) & (x < HIGH)).astype(np.float32)
    middle = np.median(x[cost > 0])
    sources = np.stack([cost * (x < middle), cost * (x >= middle)], 1).astype(np.int16)
    return (
        Corridor(LOW, HIGH),
        data._replace(action=action, cost=cost, reward=0.1 * action[:, 0], sources=sources),
        Rows(x),
    )


def forecast_of(
    model: Any, data: Recording, latents: Any, count: int = 1000, samples: int = 2
) -> Forecast:
    return forecast(model, data, latents, spread_starts(data, HORIZON, count), HORIZON, samples, 0)


def test_where_a_goal_ends_the_episode_the_goal_is_judged_too():
    """The steps before a terminal row count as far as they go; those before a time limit do not."""
    data = recording((12, 9, 4))
    data.terminal[[11, 24]] = 1
    starts = spread_starts(data, 5, 1000, ended=True)
    assert starts.tolist() == [*range(11), *range(12, 16), *range(21, 24)]
    assert spread_starts(data, 5, 1000).tolist() == [*range(7), *range(12, 16)]
    follow, within = what_followed(data, starts, 5)
    for start, rows, going in zip(starts.tolist(), follow, within, strict=True):
        end = {0: 11, 1: 20, 2: 24}[int(data.episode[start])]
        assert rows.tolist() == [min(start + k, end) for k in range(1, 6)]
        assert going.tolist() == [start + k <= end for k in range(1, 6)]
    data.reward[:] = 0
    data.reward[[11, 24]] = 10.0
    data.cost[:] = 0
    data.cost[24] = 1
    cost, reward, terminal = (
        column[follow] + 5.0 * ~within for column in (data.cost, data.reward, data.terminal)
    )
    perfect = Forecast(starts, cost, reward, terminal, follow, within)
    table = judge_steps(data, perfect, Alarm(0.3, 0.95), SOURCES)
    # At every step there is a start whose episode ends there, and what is imagined after an end
    # does not count.
    assert [row["reward_variance"] > 0 for row in table] == [True] * 5
    assert [row["reward_r2"] for row in table] == [1.0] * 5
    assert [(row["ends_auprc"], row["ends_over_base"]) for row in table] == [
        (1.0, pytest.approx(1.0))
    ] * 5
    assert [row["ends_base"] for row in table] == [
        pytest.approx((1 + (k < 3)) / within[:, k].sum()) for k in range(5)
    ]
    assert [row["base"] for row in table] == [
        pytest.approx(data.cost[follow[:, k]][within[:, k]].mean()) for k in range(5)
    ]
    assert judge_window(data, perfect, Alarm(0.3, 0.95))["cost_correlation"] == pytest.approx(1.0)


def test_a_model_that_knows_the_future_is_perfect_at_every_step():
    model, data, latents = corridor()
    seen = forecast_of(model, data, latents)
    np.testing.assert_array_equal(seen.cost, data.cost[seen.follow])
    rows = judge_steps(data, seen, Alarm(0.3, 0.95), SOURCES)
    assert [row["k"] for row in rows] == [1, 2, 3, 4, 5]
    for row in rows:
        for key in (
            "auprc",
            "onset_auprc",
            "recall",
            "onset_recall",
            "foreseen",
            "onset_foreseen",
            "predicted_over_base",
        ):
            assert row[key] == pytest.approx(1.0), key
        assert row["foreseen_by_source"] == dict.fromkeys(SOURCES, 1.0)
        assert row["reward_r2"] == pytest.approx(1.0, abs=1e-5)
        assert row["calibration_error"] == pytest.approx(0.0)
        assert row["persistence"] < 1.0
    window = judge_window(data, seen, Alarm(0.3, 0.95))
    assert window["auprc"] == window["onset_auprc"] == window["recall"] == window["foreseen"] == 1.0
    assert window["false_alarms"] == 0.0
    assert window["cost_correlation"] == pytest.approx(1.0)


def test_numbers_are_what_loops_over_the_starts_count():
    """A jittery corridor and random predictions: persistence, onsets, foreseen shares and sums
    against plain loops.
    """
    _, data, latents = corridor()
    seen = forecast_of(Corridor(LOW, HIGH, jitter=0.1), data, latents, count=70)
    threshold, gamma = 0.7, 0.9
    table = judge_steps(data, seen, Alarm(threshold, gamma), SOURCES)
    expected = [sum(gamma**k * p for k, p in enumerate(row)) for row in seen.cost.tolist()]
    for k, row in enumerate(table, 1):
        events = [bool(data.cost[start + k]) for start in seen.starts]
        now = [bool(data.cost[start]) for start in seen.starts]
        hits = sum(e and n for e, n in zip(events, now, strict=True))
        base = sum(events) / 70
        # The two thresholds of a score of zeros and ones.
        assert row["persistence"] == pytest.approx(
            hits / sum(events) * hits / sum(now) + (1 - hits / sum(events)) * base
        )
        calm = [i for i in range(70) if not now[i]]
        assert row["onset_base"] == pytest.approx(sum(events[i] for i in calm) / len(calm))
        assert row["onset_auprc"] == pytest.approx(
            average_precision(np.array([events[i] for i in calm]), seen.cost[calm, k - 1])
        )
        alarm = [expected[i] > threshold for i in range(70)]
        assert row["foreseen"] == pytest.approx(
            sum(a and e for a, e in zip(alarm, events, strict=True)) / sum(events)
        )
        first = [i for i in range(70) if data.sources[seen.starts[i] + k, 0] > 0]
        assert row["foreseen_by_source"][SOURCES[0]] == pytest.approx(
            sum(alarm[i] for i in first) / len(first)
        )
    window = judge_window(data, seen, Alarm(threshold, gamma))
    sums = [sum(data.cost[start + 1 : start + 1 + HORIZON]) for start in seen.starts]
    assert window["base"] == pytest.approx(sum(s > 0 for s in sums) / 70)
    scores = [1 - float(np.prod([1 - p for p in seen.cost[i].tolist()])) for i in range(70)]
    assert window["auprc"] == pytest.approx(average_precision(np.array(sums) > 0, np.array(scores)))
    assert window["cost_correlation"] == pytest.approx(np.corrcoef(sums, seen.cost.sum(1))[0, 1])
    quiet = [i for i in range(70) if sums[i] == 0]
    assert window["false_alarms"] == pytest.approx(
        sum(expected[i] > threshold for i in quiet) / len(quiet)
    )


class Film:
    """h = [row]; every imagined step moves one row on, and what is decoded is the recorded
    image of the row.
    """

    action_size, noise_size = 2, 1

    def __init__(self, data: Recording, lag: int = 0) -> None:
        self.data, self.lag, self.mean_image = data, lag, torch.zeros(6, 64, 64)

    def imagine(self, latent: Latent, action: torch.Tensor, noise: torch.Tensor) -> Latent:
        return Latent(latent.h + 1, latent.z)

    def cost(self, latent: Latent) -> torch.Tensor:
        return torch.from_numpy(self.data.cost[latent.h[..., 0].long().numpy()])

    def decode(self, latent: Latent) -> torch.Tensor:
        rows = (latent.h[..., 0].long() - self.lag).clamp(min=0).numpy()
        return torch.from_numpy(self.data.pixels[rows].astype(np.float32) / 255)


def test_imagined_images_are_held_against_the_true_ones_and_a_copy():
    data, rows = recording((12, 20)), Rows(np.arange(32))
    starts = spread_starts(data, 4, 11)
    perfect = judge_observations(Film(data), data, rows, starts, 4, 2, 0)
    assert [row["image_error"] for row in perfect] == pytest.approx([0] * 4)
    assert [row["image_explained"] for row in perfect] == pytest.approx([1] * 4)
    late = judge_observations(Film(data, lag=1), data, rows, starts, 4, 1, 0)
    assert late[0]["image_over_copy"] == pytest.approx(1.0), (
        "one step late is a copy at the first step"
    )
    for k, row in enumerate(late, 1):
        pairs = [
            (data.pixels[s + k] / 255.0, data.pixels[s + k - 1] / 255.0, data.pixels[s] / 255.0)
            for s in starts
        ]
        assert row["image_error"] == pytest.approx(
            np.mean([(a - b) ** 2 for a, b, _ in pairs]), rel=1e-5
        )
        assert row["copy_error"] == pytest.approx(
            np.mean([(a - c) ** 2 for a, _, c in pairs]), rel=1e-5
        )
    filtered = judge_filter(Film(data), data, rows, 7)
    assert filtered["auprc"] == pytest.approx(1.0) == filtered["predicted_over_base"]
    assert filtered["image_error"] == pytest.approx(0.0)
    assert filtered["base"] == pytest.approx(data.cost[data.first == 0].mean())


def test_the_unseen_operators_are_not_in_the_mixture():
    known = {
        dataclasses.replace(b, name="")
        for b in behaviours(
            dict.fromkeys(MixtureConfig.model_fields, 1 / 8), 520, 4, np.random.default_rng(0)
        )
    }
    unseen = unseen_behaviours(4)
    assert not {dataclasses.replace(b, name="") for b in unseen} & known
    held: dict[str, set[float]] = {
        "delay": {4},
        "drift": {0.5, -0.5},
        "sticky": {1.0},
        "skill": {HALF_TRAINED},
    }
    for name, kept_out in held.items():
        assert not kept_out & {getattr(b, name) for b in known}, (
            f"{name} is not judged with a value that the dataset has"
        )
    assert {b.name for b in unseen[:4]} == {
        "sticky noise",
        "delay with noise",
        "drift",
        "half trained",
    }
    assert "half trained" not in {b.name for b in unseen_behaviours(3)}, (
        "the third of three checkpoints is the expert"
    )


def test_the_stage_leaves_its_numbers_and_images_and_the_same_again(root, chain):
    config = DiagnosticsConfig(episodes=3, starts=40, samples=2, image_starts=6)
    summaries = []
    for name in ("first", "again"):
        settings = {"action_repeat": REPEAT, "returns": ReturnsConfig()}
        job = dataclasses.replace(
            dataset_job(root, name),
            kind="diagnostics",
            config=config,
            settings=settings,
            inputs=chain,
        )
        summaries.append(DiagnosticsStage().run(job))
    files = {
        name: {path.name: path.read_bytes() for path in (root / name).iterdir()}
        for name in ("first", "again")
    }
    assert files["first"] == files["again"]
    assert summaries[0] == pytest.approx(summaries[1], nan_ok=True)
    assert set(files["first"]) == {"diagnostics.json", "images.parquet"}
    found = json.loads(files["first"]["diagnostics.json"])
    assert set(found) == {"held_out", "unseen"}
    assert sum(found["held_out"]["episodes"].values()) == 1, (
        "of six episodes the last one is held out"
    )
    assert set(found["unseen"]["episodes"]) == {"sticky noise", "delay with noise", "drift"}
    for table in found.values():
        assert [row["k"] for row in table["steps"]] == list(range(1, 16))
        assert all(
            list(table["readout"][place]) == GROUPS
            for place in ("filtered", "embedding", "imagined")
        )
    wanted = {
        f"{key}@{k}"
        for key in ("auprc", "persistence", "predicted_over_base", "recall", "reward_r2", "base")
        for k in SHOWN
    }
    wanted |= {f"readout_{place}{group}" for place in ("", "embedding_") for group in GROUPS}
    wanted |= {f"unseen_auprc@{k}" for k in SHOWN} | {
        "auprc_any",
        "unseen_auprc_any",
        "image_over_copy@15",
    }
    assert set(summaries[0]) == wanted
    page = open_loop_markdown(found)
    assert page.count("\n# ") == 2
    assert "hazards" in page
    assert (
        page.count("| read from | all | motion | goal | way | walls | things |")
        == page.count("| imagined, step 5 |")
        == 2
    )
    assert "nan" not in page
    images = pq.read_table(root / "first" / "images.parquet")
    assert images["window"].to_pylist().count(-1) == 10
