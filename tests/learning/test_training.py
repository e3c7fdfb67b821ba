from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from wasp_cli.errors import ArtifactError, TrainingError
from wasp_cli.learning.checkpoint import restore_training, save_training
from wasp_cli.learning.configs import MixtureConfig, WorldModelConfig
from wasp_cli.learning.dataset import Behaviour, Commander, behaviours
from wasp_cli.learning.denoiser import demonstrations
from wasp_cli.learning.draws import generator, gumbel
from wasp_cli.learning.lagrangian import MultiplierRule
from wasp_cli.learning.latents import encode
from wasp_cli.learning.refit import refit_heads
from wasp_cli.learning.replay import Replay, cost_sources, read_replay, write_shard
from wasp_cli.learning.windows import Context, Windows
from wasp_cli.learning.world_model import build, train
from wasp_cli.models.base import Latent
from wasp_cli.models.policy import PrivilegedPolicy
from wasp_cli.models.world_model import Ahead

TINY = WorldModelConfig(
    deter=16, hidden=16, variables=3, classes=4, depth=2, head=16, batch=3, length=6, updates=8, warmup=2, refit_updates=3, refit_horizon=4,
    checkpoint_every=4, ahead_starts=5, ahead_images=3, ahead_horizon=3,
)  # fmt: skip
SOURCES = ("hazards", "static geoms, contact")

ROWS = np.arange(36)


def replay(lengths: tuple[int, ...] = (12, 9, 15), seed: int = 0) -> Replay:
    random = np.random.default_rng(seed)
    rows = sum(lengths)
    first = np.zeros(rows, np.float32)
    first[np.cumsum([0, *lengths[:-1]])] = 1
    return Replay(
        pixels=random.integers(0, 256, (rows, 6, 64, 64), dtype=np.uint8), action=random.uniform(-1, 1, (rows, 2)).astype(np.float32),
        cost_env=np.zeros(rows, np.float32), reward=random.normal(size=rows).astype(np.float32),
        cost=(random.random(rows) < 0.2).astype(np.float32), sources=random.integers(0, 5, (rows, 2)).astype(np.int16),
        goals=random.integers(0, 2, rows).astype(np.int16),
        terminal=np.zeros(rows, np.float32), first=first, privileged=random.normal(size=(rows, 5)).astype(np.float32),
        episode=np.repeat(np.arange(len(lengths), dtype=np.int32), lengths),
        behaviour=np.repeat([("expert", "noisy")[i % 2] for i in range(len(lengths))], lengths),
    )  # fmt: skip


def test_shards_come_back_as_they_were(tmp_path: Path) -> None:
    whole = replay()
    for number in (0, 1):
        write_shard(tmp_path / f"shard-{number:04d}.parquet", whole.rows(whole.episode < 2 if number == 0 else whole.episode == 2), SOURCES)
    again = read_replay(tmp_path)
    for name, value in whole._asdict().items():
        assert np.array_equal(getattr(again, name), value), name
    assert read_replay(tmp_path, ["reward"]).pixels.size == 0
    assert cost_sources(tmp_path) == SOURCES


def test_a_task_without_cost_sources_has_shards_too(tmp_path: Path) -> None:
    whole = replay()
    write_shard(tmp_path / "shard-0000.parquet", whole._replace(sources=whole.sources[:, :0]), ())
    assert read_replay(tmp_path).sources.shape == (36, 0)
    assert cost_sources(tmp_path) == ()


def test_every_tenth_episode_is_held_out_and_stays_so_when_others_are_appended() -> None:
    data = replay((2,) * 37)
    chosen = data.held_out(0.1)
    assert set(data.episode[chosen]) == {9, 19, 29}
    fewer = data.rows(data.episode < 25)
    np.testing.assert_array_equal(fewer.held_out(0.1), chosen[:50])
    few = data.rows(data.episode < 4)
    assert set(few.episode[few.held_out(0.1)]) == {3}, "with too few episodes the last one is held out"
    light = data._replace(pixels=np.zeros(0, np.uint8)).rows(chosen)
    assert light.pixels.size == 0
    assert len(light.reward) == 6


def test_a_damaged_shard_is_named(tmp_path: Path) -> None:
    with pytest.raises(ArtifactError, match="no shards"):
        read_replay(tmp_path)
    (tmp_path / "shard-0000.parquet").write_bytes(b"PAR1 not really")
    with pytest.raises(ArtifactError, match="cannot read"):
        read_replay(tmp_path)


def test_windows_that_must_stay_in_an_episode_do() -> None:
    data = replay()
    for start in data.window_starts(7):
        assert len(set(data.episode[start : start + 7])) == 1
    assert len(data.window_starts(7)) == (12 - 6) + (9 - 6) + (15 - 6)


def test_sampled_sequences_begin_without_a_past_and_hold_costs() -> None:
    data = replay((200, 200))
    data.cost[:] = 0
    data.cost[137] = 1
    window = Windows(data, np.arange(400), 10, 0.5).sample(8, generator(0))
    assert window.batch.pixels.shape == (8, 10, 6, 64, 64)
    assert (window.batch.cost[:4].sum(1) == 1).all()
    assert (window.rows == window.rows[:, :1] + torch.arange(10)).all()
    assert np.array_equal(window.batch.first.numpy(), data.first[window.rows.numpy()])


def test_sequences_keep_out_of_rows_that_may_not_be_learned_from() -> None:
    data = replay((200, 50, 200))
    allowed = np.flatnonzero(data.episode != 1)
    rows = torch.cat([Windows(data, allowed, 10, 0.5).sample(8, generator(seed)).rows.flatten() for seed in range(40)])
    assert set(data.episode[rows.numpy()]) == {0, 2}
    crossing = Windows(data, allowed, 10, 0.0)
    batch = next(w for seed in range(200) if 250 in (w := crossing.sample(1, generator(seed))).rows[0, 1:])
    # A sequence that leaps over the excluded episode is told of a new start there.
    assert batch.batch.first[0, batch.rows[0] == 250] == 1


def test_a_sequence_goes_on_from_what_was_inferred_before_it() -> None:
    data = replay((30, 30))
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


def test_a_later_training_goes_on_from_what_the_earlier_one_inferred() -> None:
    data = replay((30, 30))
    torch.manual_seed(0)
    model = build(TINY, 2)
    latents = encode(model, data, lambda share, text: None)
    context, window = Context(60, 16, 3), Windows(data, np.arange(60), 5, 0.0).sample(8, generator(0))
    context.fill(latents)
    batch, before = context.enter(window, 4)
    assert torch.equal(batch.first, window.batch.first), "every row has a past"
    wanted = latents.at((window.rows[:, 0] - 1).clamp(min=0))
    torch.testing.assert_close(before.h, wanted.h, atol=1e-3, rtol=1e-2)  # remembered in half precision
    assert torch.equal(before.z, wanted.z)


def test_what_followed_is_looked_up_to_the_end_of_the_episode() -> None:
    data, source = replay((7, 30)), generator(0)
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


MIRROR = np.array([[1, 0], [0, -1]], np.float32)


def test_half_of_the_sequences_are_seen_in_a_mirror_with_what_follows_them() -> None:
    data, source = replay((40, 30)), generator(0)
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


def test_a_row_and_its_mirror_image_are_remembered_apart() -> None:
    data = replay((30, 30))
    context, windows = Context(120, 4, 3), Windows(data, np.arange(60), 5, 0.0, mirror=MIRROR)
    window = windows.sample(1, generator(0))
    begin = int(window.rows[0, 0])
    assert begin % 30 > 0
    latent = Latent(torch.arange(20.0).reshape(1, 5, 4), torch.zeros(1, 5, 6))
    context.keep(window._replace(memory=window.rows - 1), latent)  # the row before, as it is
    other = window._replace(memory=window.rows + 60)
    assert context.enter(window._replace(memory=window.rows), 2)[0].first[0, 0] == 0
    assert context.enter(other, 2)[0].first[0, 0] == 1, "of its mirror image nothing is known"
    context.keep(other._replace(memory=other.memory - 1), latent._replace(h=latent.h + 100))
    assert torch.equal(context.enter(other, 2)[1].h, torch.arange(4.0).reshape(1, 4) + 100)
    assert torch.equal(context.enter(window._replace(memory=window.rows), 2)[1].h, torch.arange(4.0).reshape(1, 4))


def test_imagined_steps_after_a_reset_do_not_count() -> None:
    torch.manual_seed(0)
    model, source = build(TINY, 2), generator(0)
    windows = Windows(replay((7, 30)), np.arange(37), 6, 0.0)
    window = windows.sample(4, source)
    ahead = windows.ahead(window, 6, 5, 6, 12, source)
    ahead = ahead._replace(within=torch.tensor([1.0, 1.0, 1.0, 0.0, 0.0]).expand(6, 5), shown=torch.tensor([3] * 5 + [2]))
    noise = torch.randn(4, 6, 3, 4, generator=source)

    def terms(changed: Ahead) -> tuple[float, ...]:
        losses, _ = model.losses(window.batch, noise, torch.tensor([0]), 1.0, ahead=changed)
        return tuple(losses[f"ahead_{term}"].item() for term in "rco")

    late, early = torch.zeros(6, 5), torch.zeros(6, 5)
    late[:, 3:], early[0, 2] = 7.0, 7.0
    assert terms(ahead._replace(reward=ahead.reward + late)) == terms(ahead)
    assert terms(ahead._replace(reward=ahead.reward + early))[0] != terms(ahead)[0]
    hidden, seen = ahead.pixels.clone(), ahead.pixels.clone()
    hidden[:5] = 0
    seen[5] = 0
    assert terms(ahead._replace(pixels=hidden)) == terms(ahead), "the images of the first five lie after the reset"
    assert terms(ahead._replace(pixels=seen))[2] != terms(ahead)[2]


def test_an_imagined_rollout_is_scored_as_its_steps_are() -> None:
    """The terms against the heads and the decoder, called step by step."""
    torch.manual_seed(0)
    model, source = build(TINY, 2), generator(3)
    windows = Windows(replay(), ROWS, 6, 0.5)
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


def test_a_dataset_that_is_too_small_says_so() -> None:
    with pytest.raises(TrainingError, match="fewer than one sequence"):
        Windows(replay((3,)), np.arange(3), 10, 0.0)


@pytest.mark.parametrize("mirror", [None, MIRROR], ids=["straight", "mirror"])
def test_training_resumes_bit_for_bit(tmp_path: Path, mirror: np.ndarray | None) -> None:
    def fresh() -> torch.nn.Module:
        torch.manual_seed(0)
        return build(TINY, 2)

    data, silent = replay(), lambda share, text: None
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    whole = fresh()
    train(whole, data, ROWS, TINY, TINY.updates, 5, tmp_path / "a", silent, mirror=mirror)  # type: ignore[arg-type]

    class Interrupted(Exception):
        pass

    def interrupt(share: float, text: str) -> None:
        if (tmp_path / "b" / "training.safetensors").exists():
            raise Interrupted

    partial = fresh()
    with pytest.raises(Interrupted):
        train(partial, data, ROWS, TINY, TINY.updates, 5, tmp_path / "b", interrupt, mirror=mirror)  # type: ignore[arg-type]
    again = fresh()
    train(again, data, ROWS, TINY, TINY.updates, 5, tmp_path / "b", silent, mirror=mirror)  # type: ignore[arg-type]
    for (name, a), b in zip(whole.state_dict().items(), again.state_dict().values(), strict=True):
        assert torch.equal(a, b), name


def test_a_checkpoint_restores_moments_and_generator(tmp_path: Path) -> None:
    module, source = torch.nn.Linear(3, 2), generator(1)
    optimizer = torch.optim.Adam(module.parameters(), lr=0.1)
    module(torch.ones(1, 3)).sum().backward()
    optimizer.step()
    save_training(tmp_path, module, optimizer, source, {"update": 7})
    wanted = torch.rand(3, generator=source)
    other, again = torch.nn.Linear(3, 2), generator(9)
    fresh = torch.optim.Adam(other.parameters(), lr=0.1)
    assert restore_training(tmp_path, other, fresh, again) == {"update": 7}
    assert torch.equal(torch.rand(3, generator=again), wanted)
    for a, b in zip(optimizer.state_dict()["state"].values(), fresh.state_dict()["state"].values(), strict=True):
        assert all(torch.equal(torch.as_tensor(a[k]), torch.as_tensor(b[k])) for k in a)


def test_a_non_finite_loss_is_skipped_then_stops_with_a_clear_message(tmp_path: Path) -> None:
    data = replay()
    data.reward[:] = np.nan
    with pytest.raises(TrainingError, match=r"non-finite loss.*beta_r nan"):
        train(build(TINY, 2), data, ROWS, TINY, TINY.updates, 0, tmp_path, lambda share, text: None)


def test_updates_that_are_left_out_at_the_very_end_count_too(tmp_path: Path) -> None:
    data = replay()
    train(build(TINY, 2), data, ROWS, TINY, 4, 5, tmp_path, lambda share, text: None)
    data.reward[:] = np.nan
    _, skipped = train(build(TINY, 2), data, ROWS, TINY, 7, 5, tmp_path, lambda share, text: None)
    assert skipped == 3


def test_a_checkpoint_of_another_device_is_an_error_with_a_way_out(tmp_path: Path) -> None:
    module, source = torch.nn.Linear(3, 2), generator(1)
    optimizer = torch.optim.Adam(module.parameters())
    save_training(tmp_path, module, optimizer, source, {"update": 1})
    tensors = load_file(tmp_path / "training.safetensors")
    # A GPU's generator has a state of 16 bytes.
    save_file(tensors | {"generator": torch.zeros(16, dtype=torch.uint8)}, tmp_path / "training.safetensors", metadata={"counters": "{}"})
    with pytest.raises(ArtifactError, match="written on another device"):
        restore_training(tmp_path, module, optimizer, source)


def test_a_bad_update_is_left_out_and_counted(tmp_path: Path) -> None:
    data = replay((60, 60))
    data.reward[30] = np.inf
    torch.manual_seed(0)
    model = build(TINY, 2)
    curves, skipped = train(model, data, np.arange(120), TINY, 24, 3, tmp_path, lambda share, text: None)
    assert 1 <= skipped <= 5
    assert all(len(curve) <= 2 for curve in curves.values())
    assert all(torch.isfinite(value).all() for value in model.state_dict().values())


def test_a_training_that_fails_keeps_its_last_good_checkpoint(tmp_path: Path) -> None:
    data = replay()
    train(build(TINY, 2), data, ROWS, TINY, 4, 5, tmp_path, lambda share, text: None)
    good = (tmp_path / "training.safetensors").read_bytes()
    data.reward[:] = np.nan
    with pytest.raises(TrainingError, match="6 updates had a non-finite loss"):
        train(build(TINY, 2), data, ROWS, TINY, 40, 5, tmp_path, lambda share, text: None)
    assert (tmp_path / "training.safetensors").read_bytes() == good


def test_the_refit_moves_only_the_heads_that_imagination_reads() -> None:
    torch.manual_seed(0)
    model, data = build(TINY, 2), replay()
    model.requires_grad_(False)
    latents = encode(model, data, lambda share, text: None)
    assert latents.h.shape == (36, 16)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    refit_heads(model, data, latents, data.episode < 2, TINY, 0, lambda share, text: None)
    moved = {name.split(".")[0] for name, value in model.state_dict().items() if not torch.equal(value, before[name])}
    assert moved == {"reward_head", "cost_head", "continue_head"}


def test_the_refit_learns_nothing_of_what_lies_behind_the_last_row() -> None:
    data = replay()
    longer = Replay(*(np.concatenate([field, field[:12]]) for field in data))
    longer.episode[36:] = 3
    heads = []
    for rows in (data, longer):
        torch.manual_seed(0)
        model = build(TINY, 2).requires_grad_(False)
        refit_heads(model, rows, encode(model, rows, lambda share, text: None), rows.episode == 2, TINY, 0, lambda share, text: None)
        heads.append({name: value for name, value in model.state_dict().items() if "head" in name})
    for name, value in heads[0].items():
        torch.testing.assert_close(value, heads[1][name], msg=name)


def test_the_refit_teaches_where_episodes_end() -> None:
    data = replay((6,) * 40)
    last = np.arange(240) % 6 == 5
    data.terminal[last] = 1.0
    data.action[:] = np.where(last, 1.0, -1.0)[:, None]  # what led there tells it
    torch.manual_seed(0)
    model = build(TINY, 2).requires_grad_(False)
    latents = encode(model, data, lambda share, text: None)
    refit_heads(model, data, latents, data.episode < 40, TINY.model_copy(update={"refit_updates": 300}), 0, lambda share, text: None)
    with torch.inference_mode():
        rows, noise = np.flatnonzero(~last), gumbel((200, model.noise_size), generator(1))
        arrived = model.imagine(latents.at(torch.from_numpy(rows)), torch.from_numpy(data.action[rows + 1]), noise)
        goes_on = model.continues(arrived).numpy()
    assert goes_on[last[rows + 1]].max() < 0.3
    assert goes_on[~last[rows + 1]].min() > 0.7


def test_encoding_is_what_the_closed_loop_filters() -> None:
    torch.manual_seed(0)
    model, data = build(TINY, 2), replay()
    with torch.inference_mode():
        latents = encode(model, data, lambda share, text: None)
        latent = model.initial(1)
        for row in np.flatnonzero(data.episode == 1):
            one = [torch.from_numpy(field[row : row + 1]) for field in (data.action, data.pixels, data.first)]
            latent = model.filter(latent, *one)
            torch.testing.assert_close(latents.at(torch.tensor([row])).h, latent.h)


def test_the_multiplier_rises_above_the_limit_and_falls_below_it() -> None:
    rule = MultiplierRule(initial=0.3, rate=0.1, bound=0.6, limit=25.0)
    assert rule.next(0.3, 50.0) == pytest.approx(0.4)
    assert rule.next(0.3, 0.0) == pytest.approx(0.2)
    assert rule.next(0.05, 0.0) == 0.0
    assert rule.next(0.55, 500.0) == 0.6
    assert MultiplierRule(initial=0.3, rate=0.1, bound=0.6, limit=25.0, floor=0.1).next(0.15, 0.0) == 0.1


def test_behaviours_follow_their_shares() -> None:
    chosen = behaviours(MixtureConfig().model_dump(), 50, 4, np.random.default_rng(0))
    assert len(chosen) == 50
    counts = {name: sum(b.name == name for b in chosen) for name in MixtureConfig.model_fields}
    assert counts == {"expert": 12, "noisy": 5, "laggy": 6, "delayed": 7, "early": 2, "bursts": 4, "careless": 10, "random": 4}
    assert {b.skill for b in behaviours(MixtureConfig().model_dump(), 50, 1, np.random.default_rng(0))} == {-1, 0}


@pytest.mark.parametrize("seed", range(5))
def test_held_out_episodes_have_the_shares_of_all(seed: int) -> None:
    chosen = behaviours(MixtureConfig().model_dump(), 400, 4, np.random.default_rng(seed))
    held = chosen[9::10]
    for name, share in MixtureConfig().model_dump().items():
        assert abs(sum(b.name == name for b in held) - share * len(held)) <= 1
    assert {b.repeat for b in held if b.name == "careless"} == {0.9, 0.95}
    names = [b.name for b in chosen]
    assert len({"".join(names[i : i + 10]) for i in range(0, 400, 10)}) > 30, "the order is random all the same"


def commander(*rows: Behaviour) -> Commander:
    torch.manual_seed(0)
    skills = [PrivilegedPolicy(5, [4], 2), PrivilegedPolicy(5, [4], 2)]
    return Commander(skills, rows, 2, np.random.default_rng(0))


def test_commands_do_what_their_behaviour_says() -> None:
    rows = (
        Behaviour("plain"), Behaviour("early", skill=0), Behaviour("frozen", repeat=1.0), Behaviour("random", replace=1.0),
        Behaviour("delayed", delay=2),
    )  # fmt: skip
    driver = commander(*rows)
    random = np.random.default_rng(1)
    seen = [random.normal(size=(5, 5)).astype(np.float32) for _ in range(6)]
    issued = np.stack([driver.command(s) for s in seen])
    expert, early = (driver._skills[i](torch.from_numpy(np.stack(seen))).detach().numpy() for i in (-1, 0))
    np.testing.assert_allclose(issued[:, 0], expert[:, 0], rtol=1e-5)
    np.testing.assert_allclose(issued[:, 1], early[:, 1], rtol=1e-5)
    assert (issued[:, 2] == issued[0, 2]).all()  # a lag repeats from the second command on
    assert len({tuple(a) for a in issued[:, 3]}) == 6
    assert (issued[:2, 4] == 0).all()
    np.testing.assert_allclose(issued[2:, 4], expert[:-2, 4], rtol=1e-5)
    assert np.abs(issued).max() <= 1


def test_bursts_are_held() -> None:
    driver = commander(Behaviour("bursts", burst=1.0))
    issued = [tuple(driver.command(np.zeros((1, 5), np.float32))[0]) for _ in range(60)]
    runs = [len(list(group)) for _, group in itertools.groupby(issued)][:-1]
    assert min(runs[::2]) >= 2
    assert max(runs[::2]) <= 11
    assert set(runs[1::2]) == {1}  # the intended command stands for one step before the next burst may begin


def test_demonstrations_are_the_careful_near_expert_episodes() -> None:
    data = replay()  # near-expert: episodes 0 and 2
    data.cost_env[data.episode == 2] = 2  # 30 env steps
    assert set(data.episode[demonstrations(data, 30.0)]) == {0, 2}
    assert set(data.episode[demonstrations(data, 29.0)]) == {0}
    data.cost_env[data.episode == 0] = 4
    assert set(data.episode[demonstrations(data, 25.0)]) == {2}  # none is careful: the least costly one
    with pytest.raises(TrainingError, match="no near-expert episode"):
        demonstrations(data.rows(data.episode == 1), 25.0)
