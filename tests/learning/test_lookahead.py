"""The direct look ahead: what counts as known, what it learns in a world that is known, and the stage."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.artifacts import SIZES, tiny_artifacts
from tests.learning.recordings import SOURCES, recording
from wasp_cli.errors import TrainingError
from wasp_cli.learning.configs import LookaheadConfig, ReturnsConfig
from wasp_cli.learning.latents import Latents, save_latents
from wasp_cli.learning.lookahead import decisions, foreseen, judged, rolled_out, train_lookahead, what_followed
from wasp_cli.learning.shards import HELD_OUT, Recording, write_shard
from wasp_cli.models.lookahead import LookAhead
from wasp_cli.models.weights import load_module
from wasp_cli.models.world_model import load_world_model
from wasp_cli.stages.base import Job, no_progress
from wasp_cli.stages.lookahead import LookaheadStage


def costly(*rows: int, terminal: int | None = None) -> Recording:
    """Two episodes of six rows; these rows cost."""
    data = recording((6, 6))
    data.cost[:] = 0
    data.cost[list(rows)] = 1
    if terminal is not None:
        data.terminal[terminal] = 1
    return data


def test_a_cost_is_that_of_the_decision_and_never_of_the_next_episode() -> None:
    ahead = what_followed(costly(2, 6), np.array([0, 1, 2, 4]), 3)
    assert ahead.cost.tolist() == [[False, True, False], [True, False, False], [False] * 3, [False] * 3]
    assert ahead.known.tolist() == [[True] * 3, [True] * 3, [True] * 3, [True, False, False]]
    assert ahead.command[3, 1:].tolist() == [[0.0, 0.0]] * 2  # nothing was executed there
    assert ahead.command[0].tolist() == recording((6, 6)).action[1:4].tolist()


def test_what_a_time_limit_cuts_off_is_unknown_and_what_follows_an_end_costs_nothing() -> None:
    cut, over = what_followed(costly(5), np.array([3, 4]), 4), what_followed(costly(5, terminal=5), np.array([3, 4]), 4)
    assert cut.known.tolist() == [[True, True, False, False], [True, False, False, False]]
    assert over.known.all()
    # A cost before the limit is enough to know that there was one.
    assert [known.tolist() for known in cut.any_within(4)] == [[True, True], [True, True]]
    event, known = what_followed(costly(), np.array([1, 2]), 4).any_within(4)
    assert (event.tolist(), known.tolist()) == ([False, False], [True, False])


def test_after_the_first_cost_nothing_is_at_risk() -> None:
    ahead = what_followed(costly(2, 4), np.array([0]), 5)
    assert ahead.at_risk.tolist() == [[True, True, False, False, False]]
    assert decisions(costly()).tolist() == [0, 1, 2, 3, 4, 6, 7, 8, 9, 10]


def test_longer_windows_are_never_less_probable_and_follow_from_the_hazards() -> None:
    torch.manual_seed(0)
    model = LookAhead(3, 4, 2, 2, [8], 6).eval()
    seen, commands = torch.randn(5, 4), torch.randn(5, 4, 2)
    hazard = model.logits(seen, commands).sigmoid()
    found = model(seen, commands)
    assert torch.allclose(found, (1 - (1 - hazard).cumprod(-1)).mean(0), atol=1e-6)
    assert (found.diff(dim=-1) >= 0).all()
    assert torch.equal(found, model(seen, torch.cat([commands[:, :2], torch.randn(5, 2, 2)], 1)))  # the first K alone are read


def world(episodes: int = 40, length: int = 30) -> tuple[Recording, Latents]:
    """h says how many decisions are left until a cost, unless the next command turns it away; every other row is calm."""
    random = np.random.default_rng(0)
    data = recording((length,) * episodes)
    rows = np.arange(episodes * length)
    left = (7 - rows % length) % 15  # a cost at rows 7 and 22 of every episode, announced by h
    turn = random.random(episodes * length) < 0.5
    data.action[:, 0] = np.where(turn, 1.0, -1.0)
    data.cost[:] = ((left == 0) & (data.action[:, 0] < 0)).astype(np.float32)
    data.cost[data.first > 0] = 0
    h = torch.nn.functional.one_hot(torch.from_numpy(left), 15).float()
    return data, Latents(h, torch.zeros(len(rows), 1, dtype=torch.uint8), 2)


CONFIG = LookaheadConfig(hidden=(32,), updates=600, batch=128, dropout=0.0, horizon=6, commands=2, learning_rate=3e-3)


def test_it_learns_the_probability_and_what_the_next_command_changes() -> None:
    data, latents = world()
    torch.manual_seed(0)
    model, curve = train_lookahead(data, latents, CONFIG, 0, no_progress)
    assert curve[-1]["loss"] < 0.5 * curve[0]["loss"]
    rows = decisions(data)
    held = what_followed(data, rows[data.held_out(HELD_OUT)[rows]], 6)
    found = foreseen(model, latents, held)
    announced = latents.h[torch.from_numpy(held.rows)].argmax(-1).numpy()
    # Three decisions before, the command that decides is not among the two that are read: a coin.
    assert found[announced == 3, 2].mean() == pytest.approx(0.5, abs=0.12)
    assert found[announced == 3, 1].max() < 0.1
    # One before, the next command decides.
    sure = held.command[announced == 1, 0, 0] < 0
    assert found[announced == 1, 0][sure].min() > 0.8
    assert found[announced == 1, 0][~sure].max() < 0.2


def test_held_out_rows_teach_nothing() -> None:
    data, latents = world()
    told, odd = data._replace(cost=data.cost.copy(), action=data.action.copy()), latents.h.clone()
    held = data.held_out(HELD_OUT)
    told.cost[held], told.action[held], odd[torch.from_numpy(held)] = 1, 0, -5.0
    found = []
    for one, of in ((data, latents), (told, latents._replace(h=odd))):
        torch.manual_seed(0)
        found.append(train_lookahead(one, of, CONFIG.model_copy(update={"updates": 5}), 0, no_progress)[0].state_dict())
    assert all(torch.equal(value, found[1][name]) for name, value in found[0].items())
    only = data.rows(data.episode == 0)  # the one episode is held out
    with pytest.raises(TrainingError, match="no decision to learn from"):
        train_lookahead(only, latents, CONFIG, 0, no_progress)


def test_a_perfect_look_ahead_is_judged_perfect_and_a_constant_one_at_the_base_rate() -> None:
    data, _ = world()
    ahead = what_followed(data, decisions(data), 6)
    truth = np.cumsum(ahead.cost, 1) > 0
    row = judged(data, ahead, truth.astype(float), np.full(truth.shape, 0.3))["5"]
    assert (row["auprc"], row["onset_auprc"], row["predicted_over_base"], row["calibration_error"]) == (1.0, 1.0, 1.0, 0.0)
    assert row["sum_auprc"] == pytest.approx(row["base"])
    assert row["rows"] == ahead.any_within(5)[1].sum() < len(ahead.rows)


def test_the_rolled_out_sum_is_that_of_the_heads(tmp_path: Path) -> None:
    model = load_world_model(tiny_artifacts(tmp_path)["world_model"])
    model.cost_head[-1].weight.data.zero_()
    model.continue_head[-1].weight.data.zero_()
    cost, keep = (head[-1].bias.data for head in (model.cost_head, model.continue_head))
    cost.fill_(np.log(SIZES.cost_weight))  # its logarithm is taken off: the probability is a half
    keep.fill_(0.0)
    data = recording()
    latents = Latents(torch.zeros(36, SIZES.deter), torch.zeros(36, SIZES.variables, dtype=torch.uint8), SIZES.classes)
    found = rolled_out(model, latents, what_followed(data, np.array([0, 3]), 3), 0.8, 2, 0)
    assert found == pytest.approx(np.tile([0.5, 0.5 + 0.5 * 0.4, 0.5 + 0.5 * 0.4 + 0.5 * 0.16], (2, 1)), abs=1e-6)


def test_the_stage_leaves_a_look_ahead_and_what_it_is_worth(tmp_path: Path) -> None:
    folders = tiny_artifacts(tmp_path / "parts")
    data = recording((20,) * 12)
    (tmp_path / "dataset").mkdir()
    write_shard(tmp_path / "dataset" / "shard-0000.parquet", data, SOURCES)
    (tmp_path / "latents").mkdir()
    rows = len(data.first)
    z = torch.randint(SIZES.classes, (rows, SIZES.variables), dtype=torch.uint8)
    save_latents(Latents(torch.randn(rows, SIZES.deter), z, SIZES.classes), tmp_path / "latents")
    config = LookaheadConfig(hidden=(8,), updates=60, batch=16, members=2)
    inputs = {"dataset": tmp_path / "dataset", "latents": tmp_path / "latents", "world_model": folders["world_model"]}
    out = tmp_path / "out"
    out.mkdir()
    job = Job("lookahead", "goal1", 0, config, {"action_repeat": 4, "returns": ReturnsConfig()}, {}, inputs, out, tmp_path)
    summary = LookaheadStage().run(job)
    quality = json.loads((out / "quality.json").read_text())
    assert [*quality] == ["5", "10", "15"]
    assert summary["auprc@10"] == round(quality["10"]["auprc"], 3)
    assert [row["update"] for row in json.loads((out / "curve.json").read_text())] == [50, 60]
    model = load_module(LookAhead, out / "lookahead.safetensors")
    assert (model.members, model.horizon, model.commands) == (2, 15, 5)
