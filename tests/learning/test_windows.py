"""Training sequences, what followed them, and the latents from which they go on."""

import numpy as np
import pytest
import torch

from tests.learning.recordings import MIRROR, ROWS, TINY, recording
from wasp_cli.errors import TrainingError
from wasp_cli.learning.sampling import generator
from wasp_cli.learning.windows import Context, Windows
from wasp_cli.learning.world_model import build
from wasp_cli.models.base import Latent


def test_sampled_sequences_begin_without_a_past_and_hold_costs():
    data = recording((200, 200))
    data.cost[:] = 0
    data.cost[137] = 1
    window = Windows(data, np.arange(400), 10, 0.5).sample(8, generator(0))
    assert window.batch.pixels.shape == (8, 10, 6, 64, 64)
    assert (window.batch.cost[:4].sum(1) == 1).all()
    assert (window.rows == window.rows[:, :1] + torch.arange(10)).all()
    assert np.array_equal(window.batch.first.numpy(), data.first[window.rows.numpy()])


def test_sequences_keep_out_of_rows_that_may_not_be_learned_from():
    data = recording((200, 50, 200))
    allowed = np.flatnonzero(data.episode != 1)
    rows = torch.cat([Windows(data, allowed, 10, 0.5).sample(8, generator(seed)).rows.flatten() for seed in range(40)])
    assert set(data.episode[rows.numpy()]) == {0, 2}
    crossing = Windows(data, allowed, 10, 0.0)
    batch = next(w for seed in range(200) if 250 in (w := crossing.sample(1, generator(seed))).rows[0, 1:])
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
    context.keep(window._replace(memory=window.memory - 1), Latent(torch.arange(20.0).reshape(1, 5, 4), z))
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
                assert (ahead.reward[n, k], ahead.cost[n, k]) == (data.reward[row + 1 + k], data.cost[row + 1 + k])
        if n < 50 and ahead.within[n, k := int(ahead.shown[n])]:
            assert np.array_equal(ahead.pixels[n].numpy(), data.pixels[row + 1 + k])
    assert met == {0, 1, 2, 3, 4, 5}
    assert int((window.rows[ahead.row, ahead.step] + 5 > window.rows[ahead.row, -1]).sum()) > 0, "some lie behind their window"


def test_half_of_the_sequences_are_seen_in_a_mirror_with_what_follows_them():
    data, source = recording((40, 30)), generator(0)
    windows = Windows(data, np.arange(70), 5, 0.0, mirror=MIRROR)
    window = windows.sample(60, source)
    assert 15 < int(window.mirrored.sum()) < 45
    ahead = windows.ahead(window, 100, 4, 100, 12, source)
    for b, (rows, turned) in enumerate(zip(window.rows.numpy(), window.mirrored.tolist(), strict=True)):
        side, sign = (slice(None, None, -1), -1) if turned else (slice(None), 1)
        assert np.array_equal(window.batch.pixels[b].numpy(), data.pixels[rows][..., side])
        assert np.array_equal(window.batch.action[b].numpy(), data.action[rows] * [1, sign])
        assert np.array_equal(window.batch.reward[b].numpy(), data.reward[rows])
        assert np.array_equal(window.memory[b].numpy(), rows + 70 * turned)
    for n, (row, step) in enumerate(zip(ahead.row.tolist(), ahead.step.tolist(), strict=True)):
        turned, begin = bool(window.mirrored[row]), int(window.rows[row, step])
        k = int(ahead.shown[n])
        if ahead.within[n, k]:
            side, sign = (slice(None, None, -1), -1) if turned else (slice(None), 1)
            assert np.array_equal(ahead.pixels[n].numpy(), data.pixels[begin + 1 + k][..., side])
            assert np.array_equal(ahead.action[n, k].numpy(), data.action[begin + 1 + k] * [1, sign])
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
            here = Latent(latent.h[ahead.row[n], ahead.step[n]][None], latent.z[ahead.row[n], ahead.step[n]][None])
            for k in range(3):
                here = model.imagine(here, ahead.action[n : n + 1, k], ahead.noise[k, n : n + 1])
                if ahead.within[n, k]:
                    count += 1
                    reward.append(TINY.reward_scale**2 * (model.reward(here) - ahead.reward[n, k]).square().item())
                    if n < 2 and k == ahead.shown[n]:
                        true = ahead.pixels[n] / 255.0
                        images.append((model.decoder(here.features)[0] + model.mean_image - true).square().sum().item())
    assert losses["ahead_r"].item() == pytest.approx(sum(reward) / count, rel=1e-4)
    assert losses["ahead_o"].item() == pytest.approx(sum(images) / max(1, len(images)), rel=1e-4)


def test_a_dataset_that_is_too_small_says_so():
    with pytest.raises(TrainingError, match="fewer than one sequence"):
        Windows(recording((3,)), np.arange(3), 10, 0.0)
