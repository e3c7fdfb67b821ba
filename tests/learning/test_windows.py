"""Training sequences, what followed them, and the latents from which they go on."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from tests.learning.recordings import MIRROR, ROWS, SOURCES, TINY, recording
from wasp_cli.config import Config
from wasp_cli.errors import TrainingError
from wasp_cli.learning import world_model as training
from wasp_cli.learning.configs import LatentsConfig
from wasp_cli.learning.encoding import encode
from wasp_cli.learning.latents import save_latents
from wasp_cli.learning.readout import StateReadout, fit_ridge, imagined_features
from wasp_cli.learning.rounding import rounded
from wasp_cli.learning.sampling import generator
from wasp_cli.learning.shards import write_shard
from wasp_cli.learning.windows import Context, Windows
from wasp_cli.learning.world_model import build
from wasp_cli.models.base import Latent
from wasp_cli.models.weights import load_weights, save_weights
from wasp_cli.stages.base import Job, no_progress
from wasp_cli.stages.latents import LatentsStage
from wasp_cli.stages.world_model import WorldModelStage


def test_sampled_sequences_begin_without_a_past_and_hold_costs():
    data = recording((200, 200))
    data.cost[:] = 0
    data.cost[137] = 1
    window = Windows(data, np.arange(400), 10, 0.5).sample(8, generator(0))
    assert window.batch.seen.shape == (8, 10, 6, 64, 64)
    assert (window.batch.cost[:4].sum(1) == 1).all()
    assert (window.rows == window.rows[:, :1] + torch.arange(10)).all()
    assert np.array_equal(window.batch.first.numpy(), data.first[window.rows.numpy()])


def test_sequences_keep_out_of_rows_that_may_not_be_learned_from():
    data = recording((200, 50, 200))
    allowed = np.flatnonzero(data.episode != 1)
    rows = torch.cat(
        [
            Windows(data, allowed, 10, 0.5).sample(8, generator(seed)).rows.flatten()
            for seed in range(40)
        ]
    )
    assert set(data.episode[rows.numpy()]) == {0, 2}
    crossing = Windows(data, allowed, 10, 0.0)
    batch = next(
        w for seed in range(200) if 250 in (w := crossing.sample(1, generator(seed))).rows[0, 1:]
    )
    # A sequence that leaps over the excluded episode is told of a new start there.
    assert batch.batch.first[0, batch.rows[0] == 250] == 1


def test_a_sequence_goes_on_from_what_was_inferred_before_it():
    data = recording((30, 30))
    context, windows = Context(60, 4, 3), Windows(data, np.arange(60), 5, 0.0)
    window = windows.sample(1, generator(0))
    begin = int(window.rows[0, 0])
    assert begin % 30 > 0, "the test needs a sequence from within an episode"
    batch, before = context.enter(window, 2)
    assert batch.first[0, 0] == 1, "nothing is known yet"
    z = torch.nn.functional.one_hot(torch.tensor([1, 0, 1]), 2).flatten().float().expand(1, 5, 6)
    context.keep(
        window._replace(memory=window.memory - 1), Latent(torch.arange(20.0).reshape(1, 5, 4), z)
    )
    batch, before = context.enter(window, 2)
    assert torch.equal(batch.first, window.batch.first)
    assert torch.equal(before.h, torch.arange(4.0).reshape(1, 4))
    assert torch.equal(before.z, z[:, 0])


def test_what_followed_is_looked_up_to_the_end_of_the_episode():
    data, source = recording((7, 30)), generator(0)
    windows = Windows(data, np.arange(37), 6, 0.0)
    window = windows.sample(40, source)
    ahead = windows.ahead(window, 200, 5, 50, 12, source)
    begin = window.rows[ahead.row, ahead.step]
    met = set()
    for n, row in enumerate(begin.tolist()):
        end = 6 if row < 7 else 36
        met.add(min(end - row, 5))
        for k in range(5):
            assert ahead.within[n, k] == (row + 1 + k <= end)
            if ahead.within[n, k]:
                assert np.array_equal(ahead.action[n, k].numpy(), data.action[row + 1 + k])
                assert (ahead.reward[n, k], ahead.cost[n, k]) == (
                    data.reward[row + 1 + k],
                    data.cost[row + 1 + k],
                )
        if n < 50 and ahead.within[n, k := int(ahead.shown[n])]:
            assert np.array_equal(ahead.seen[n].numpy(), data.pixels[row + 1 + k])
    assert met == {0, 1, 2, 3, 4, 5}
    assert int((window.rows[ahead.row, ahead.step] + 5 > window.rows[ahead.row, -1]).sum()) > 0, (
        "some lie behind their window"
    )


def test_half_of_the_sequences_are_seen_in_a_mirror_with_what_follows_them():
    data, source = recording((40, 30)), generator(0)
    windows = Windows(data, np.arange(70), 5, 0.0, mirror=MIRROR)
    window = windows.sample(60, source)
    assert 15 < int(window.mirrored.sum()) < 45
    ahead = windows.ahead(window, 100, 4, 100, 12, source)
    for b, (rows, turned) in enumerate(
        zip(window.rows.numpy(), window.mirrored.tolist(), strict=True)
    ):
        side, sign = (slice(None, None, -1), -1) if turned else (slice(None), 1)
        assert np.array_equal(window.batch.seen[b].numpy(), data.pixels[rows][..., side])
        assert np.array_equal(window.batch.action[b].numpy(), data.action[rows] * [1, sign])
        assert np.array_equal(window.batch.reward[b].numpy(), data.reward[rows])
        assert np.array_equal(window.memory[b].numpy(), rows + 70 * turned)
    for n, (row, step) in enumerate(zip(ahead.row.tolist(), ahead.step.tolist(), strict=True)):
        turned, begin = bool(window.mirrored[row]), int(window.rows[row, step])
        k = int(ahead.shown[n])
        if ahead.within[n, k]:
            side, sign = (slice(None, None, -1), -1) if turned else (slice(None), 1)
            assert np.array_equal(ahead.seen[n].numpy(), data.pixels[begin + 1 + k][..., side])
            assert np.array_equal(
                ahead.action[n, k].numpy(), data.action[begin + 1 + k] * [1, sign]
            )
    straight = Windows(data, np.arange(70), 5, 0.0).sample(60, generator(0))
    assert not straight.mirrored.any()
    assert torch.equal(straight.memory, straight.rows)


def test_an_imagined_rollout_is_scored_as_its_steps_are():
    """The terms against the heads and the decoder, called step by step."""
    torch.manual_seed(0)
    model, source = build(TINY, 2), generator(3)
    windows = Windows(recording(), ROWS, 6, 0.5)
    window = windows.sample(3, source)
    ahead = windows.ahead(window, 4, 3, 2, 12, source)
    noise = torch.randn(3, 6, 3, 4, generator=source)
    with torch.no_grad():
        losses, latent = model.losses(window.batch, noise, torch.tensor([0]), 1.0, ahead=ahead)
        reward, images, count = [], [], 0.0
        for n in range(4):
            here = Latent(
                latent.h[ahead.row[n], ahead.step[n]][None],
                latent.z[ahead.row[n], ahead.step[n]][None],
            )
            for k in range(3):
                here = model.imagine(here, ahead.action[n : n + 1, k], ahead.noise[k, n : n + 1])
                if ahead.within[n, k]:
                    count += 1
                    reward.append(
                        TINY.reward_scale**2
                        * (model.reward(here) - ahead.reward[n, k]).square().item()
                    )
                    if n < 2 and k == ahead.shown[n]:
                        true = ahead.seen[n] / 255.0
                        images.append(
                            (model.decoder(here.features)[0] + model.mean_image - true)
                            .square()
                            .sum()
                            .item()
                        )
    assert losses["ahead_r"].item() == pytest.approx(sum(reward) / count, rel=1e-4)
    assert losses["ahead_o"].item() == pytest.approx(sum(images) / max(1, len(images)), rel=1e-4)


def test_a_dataset_that_is_too_small_says_so():
    with pytest.raises(TrainingError, match="fewer than one sequence"):
        Windows(recording((3,)), np.arange(3), 10, 0.0)


# What stages store: latents as they were inferred, and weights rounded once, as they ship.


def job(kind: str, config: Config, inputs: dict[str, Path]) -> Job:
    needed = {name: inputs[name] for name in ("dataset", "world_model") if name != kind}
    return Job(
        kind, "goal1", 0, config, {"action_repeat": 4}, {}, needed, inputs[kind], inputs["work"]
    )


def test_stored_latents_are_those_that_the_heads_were_refitted_on_up_to_rounded_weights(
    tmp_path, monkeypatch
):
    inputs = {name: tmp_path / name for name in ("dataset", "world_model", "latents", "work")}
    for folder in inputs.values():
        folder.mkdir()
    write_shard(inputs["dataset"] / "shard-0000.parquet", recording(), SOURCES)
    met: list[Any] = []

    def refit(model: Any, rows: Any, latents: Any, *rest: Any) -> None:
        met.append(latents)
        refit_heads(model, rows, latents, *rest)

    refit_heads = training.refit_heads
    monkeypatch.setattr(training, "refit_heads", refit)
    WorldModelStage().run(job("world_model", TINY, inputs))
    assert not list(inputs["world_model"].glob("latents*"))
    shown = LatentsStage().run(job("latents", LatentsConfig(), inputs))
    assert shown["rows"] == 36
    save_latents(met[0], inputs["work"])
    before, after = (
        load_file(inputs[name] / "latents.safetensors") for name in ("work", "latents")
    )
    assert before.keys() == after.keys() == {"h", "z", "classes"}
    torch.testing.assert_close(before["h"], after["h"], atol=5e-3, rtol=0.0)
    assert float((before["z"] == after["z"]).float().mean()) > 0.98
    assert after["h"].dtype == torch.float16


def test_what_is_stored_what_is_measured_and_what_ships_are_the_same_numbers(tmp_path):
    trained = torch.nn.Sequential(torch.nn.Linear(7, 5), torch.nn.BatchNorm1d(5))
    before = {name: value.clone() for name, value in trained.state_dict().items()}
    save_weights(rounded(trained), tmp_path / "m.safetensors")
    again = torch.nn.Sequential(torch.nn.Linear(7, 5), torch.nn.BatchNorm1d(5))
    load_weights(again, tmp_path / "m.safetensors")
    for name, value in again.state_dict().items():
        assert torch.equal(value, trained.state_dict()[name])
        assert value.dtype == before[name].dtype
        if value.is_floating_point():
            assert torch.equal(value, before[name].half().float())
    assert not torch.equal(again.state_dict()["0.weight"], before["0.weight"])


@pytest.mark.parametrize("value", [1e6, float("nan")])
def test_a_weight_that_16_bits_cannot_hold_ends_the_training(value):
    module = torch.nn.Linear(2, 2)
    torch.nn.init.constant_(module.bias, value)
    with pytest.raises(TrainingError, match="weight 'bias' does not fit into 16 bits"):
        rounded(module)
    assert torch.equal(module.bias.isnan(), torch.full((2,), value != value))


# The readout of the privileged vector against plain numpy.


def test_a_ridge_regression_is_the_textbook_one():
    random = np.random.default_rng(0)
    x, fresh = random.normal(size=(80, 6)), random.normal(size=(50, 6))
    mixing = random.normal(size=(6, 4))
    y, true = (
        (part @ mixing + 0.5 * random.normal(size=(len(part), 4))) * [1, 10, 3, 0] + 7
        for part in (x, fresh)
    )
    ridge = fit_ridge(torch.from_numpy(x).float(), y, 0.3)
    found = ridge.explained(
        torch.from_numpy(fresh).float(),
        true,
        {"all": slice(0, 4), "two": slice(1, 3), "constant": slice(3, 4)},
    )

    x = x - (centre := x.mean(0))
    penalty = 0.3 * (x**2).sum(0).mean()
    share = []
    for j in range(3):
        unit = y[:, j].std()
        weight = (
            np.linalg.inv(x.T @ x + penalty * np.eye(6)) @ x.T @ ((y[:, j] - y[:, j].mean()) / unit)
        )
        told, wanted = (fresh - centre) @ weight, (true[:, j] - y[:, j].mean()) / unit
        share.append((((told - wanted) ** 2).mean(), wanted.var()))
    for name, part in (("all", share), ("two", share[1:])):
        assert found[name] == pytest.approx(
            1 - sum(e for e, _ in part) / sum(v for _, v in part), rel=1e-4
        )
    assert 0.3 < found["all"] < 1
    assert np.isnan(found["constant"]), "an entry that never varies is asked of nobody"


def test_an_imagined_latent_is_held_against_the_row_it_arrives_at(monkeypatch):
    data = recording((40,))
    torch.manual_seed(0)
    model = build(TINY, 2)
    latents = encode(model, data, no_progress)
    starts = np.arange(30)
    exact = imagined_features(model, data, latents, starts, 4, 3, 5)
    asked: list[Any] = []

    class Told:
        def explained(
            self, features: torch.Tensor, privileged: Any, groups: Any
        ) -> dict[str, float]:
            asked.append((features, privileged))
            return {}

    StateReadout(model, {}, Told(), Told()).imagined(data, latents, starts, 4, 3, 5)
    features, privileged = asked[0]
    assert torch.equal(features, exact)
    np.testing.assert_array_equal(privileged, data.privileged[4:34])
    # One sample of one step is the model's own step from the filtered latent under the action that
    # led on.
    one = imagined_features(model, data, latents, starts[:1], 1, 1, 5)
    noise = -(
        -torch.rand((1, 1, model.noise_size), generator=torch.Generator().manual_seed(5))
        .clamp(1e-20, 1 - 1e-7)
        .log()
    ).log()
    wanted = model.imagine(
        latents.at(torch.tensor([0])), torch.from_numpy(data.action[1:2]), noise[0]
    ).features
    assert torch.allclose(one, wanted, atol=1e-6)
