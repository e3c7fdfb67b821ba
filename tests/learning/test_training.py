"""Shards, the training of the world model and its checkpoints, encoding, the refit of the heads."""

from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from tests.cells import DECISIONS, Evaluated, evaluated
from tests.learning.recordings import MIRROR, ROWS, SOURCES, TINY, Interrupted, recording
from wasp_cli.errors import ArtifactError, TrainingError
from wasp_cli.learning.assistants import build_assistant
from wasp_cli.learning.checkpoint import restore_training, save_training
from wasp_cli.learning.closed_loop import run_episodes
from wasp_cli.learning.encoding import encode
from wasp_cli.learning.lagrangian import LaterLimit, MultiplierRule
from wasp_cli.learning.playback import play, side_by_side
from wasp_cli.learning.privileged_state import Readout, new_readout
from wasp_cli.learning.rerun import Recorded
from wasp_cli.learning.sampling import generator, gumbel
from wasp_cli.learning.shards import Recording, cost_sources, read_shards, write_shard
from wasp_cli.learning.world_model import Report, build, refit_heads, train
from wasp_cli.models.world_model import SafetyWorldModel
from wasp_cli.seeds import layout_seed, method_seed
from wasp_cli.stages.base import no_progress
from wasp_cli.store.recorded import read_recorded
from wasp_cli.tasks.base import Observation, Step


def test_shards_come_back_as_they_were(tmp_path):
    whole = recording()
    for number in (0, 1):
        write_shard(
            tmp_path / f"shard-{number:04d}.parquet",
            whole.rows(whole.episode < 2 if number == 0 else whole.episode == 2),
            SOURCES,
        )
    again = read_shards(tmp_path)
    for name, value in whole._asdict().items():
        assert np.array_equal(getattr(again, name), value), name
    assert read_shards(tmp_path, ["reward"]).pixels.size == 0
    assert cost_sources(tmp_path) == SOURCES


def test_a_task_without_cost_sources_has_shards_too(tmp_path):
    whole = recording()
    write_shard(tmp_path / "shard-0000.parquet", whole._replace(sources=whole.sources[:, :0]), ())
    assert read_shards(tmp_path).sources.shape == (36, 0)
    assert cost_sources(tmp_path) == ()


def test_every_tenth_episode_is_held_out_and_stays_so_when_others_are_appended():
    data = recording((2,) * 37)
    chosen = data.held_out(0.1)
    assert set(data.episode[chosen]) == {9, 19, 29}
    fewer = data.rows(data.episode < 25)
    np.testing.assert_array_equal(fewer.held_out(0.1), chosen[:50])
    few = data.rows(data.episode < 4)
    assert set(few.episode[few.held_out(0.1)]) == {3}, (
        "with too few episodes the last one is held out"
    )
    light = data._replace(pixels=np.zeros(0, np.uint8)).rows(chosen)
    assert light.pixels.size == 0
    assert len(light.reward) == 6


def test_a_damaged_shard_is_named(tmp_path):
    with pytest.raises(ArtifactError, match="no shards"):
        read_shards(tmp_path)
    (tmp_path / "shard-0000.parquet").write_bytes(b"PAR1 not really")
    with pytest.raises(ArtifactError, match="cannot read"):
        read_shards(tmp_path)


@pytest.mark.parametrize(
    ("mirror", "weight"),
    [(None, 0.0), (MIRROR, 0.0), (MIRROR, 100.0)],
    ids=["straight", "mirror", "with the privileged vector"],
)
def test_training_resumes_bit_for_bit(tmp_path, mirror, weight):
    data, config = recording(), TINY.model_copy(update={"privileged": weight})

    def fresh() -> SafetyWorldModel:
        torch.manual_seed(0)
        return build(config, 2)

    def go_on(model: SafetyWorldModel, name: str, report: Report) -> Readout | None:
        torch.manual_seed(1)
        readout = new_readout(model, data, ROWS, config) if weight else None
        train(
            model,
            data,
            ROWS,
            config,
            config.updates,
            5,
            tmp_path / name,
            report,
            readout=readout,
            mirror=mirror,
        )
        return readout

    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    whole = fresh()
    head = go_on(whole, "a", no_progress)

    def interrupt(share: float, text: str) -> None:
        if (tmp_path / "b" / "training.safetensors").exists():
            raise Interrupted

    with pytest.raises(Interrupted):
        go_on(fresh(), "b", interrupt)
    again = fresh()
    head_again = go_on(again, "b", no_progress)
    for (name, a), b in zip(whole.state_dict().items(), again.state_dict().values(), strict=True):
        assert torch.equal(a, b), name
    if head is not None and head_again is not None:
        assert all(
            torch.equal(a, b)
            for a, b in zip(head.parameters(), head_again.parameters(), strict=True)
        )
    assert (head is None) == (weight == 0)


def test_a_checkpoint_of_another_device_is_an_error_with_a_way_out(tmp_path):
    module, source = torch.nn.Linear(3, 2), generator(1)
    optimizer = torch.optim.Adam(module.parameters())
    save_training(tmp_path, module, optimizer, source, {"update": 1})
    tensors = load_file(tmp_path / "training.safetensors")
    # A GPU's generator has a state of 16 bytes.
    save_file(
        tensors | {"generator": torch.zeros(16, dtype=torch.uint8)},
        tmp_path / "training.safetensors",
        metadata={"counters": "{}"},
    )
    with pytest.raises(ArtifactError, match="written on another device"):
        restore_training(tmp_path, module, optimizer, source)


def test_a_bad_update_is_left_out_and_counted(tmp_path):
    data = recording((60, 60))
    data.reward[30] = np.inf
    torch.manual_seed(0)
    model = build(TINY, 2)
    curves, skipped = train(model, data, np.arange(120), TINY, 24, 3, tmp_path, no_progress)
    assert 1 <= skipped <= 5
    assert all(len(curve) <= 2 for curve in curves.values())
    assert all(torch.isfinite(value).all() for value in model.state_dict().values())


def test_a_training_that_fails_keeps_its_last_good_checkpoint(tmp_path):
    data = recording()
    train(build(TINY, 2), data, ROWS, TINY, 4, 5, tmp_path, no_progress)
    good = (tmp_path / "training.safetensors").read_bytes()
    data.reward[:] = np.nan
    with pytest.raises(TrainingError, match=r"6 updates had a non-finite loss.*beta_r nan"):
        train(build(TINY, 2), data, ROWS, TINY, 40, 5, tmp_path, no_progress)
    assert (tmp_path / "training.safetensors").read_bytes() == good


def test_encoding_is_what_the_closed_loop_filters():
    torch.manual_seed(0)
    model, data = build(TINY, 2), recording()
    with torch.inference_mode():
        latents = encode(model, data, no_progress)
        latent = model.initial(1)
        for row in np.flatnonzero(data.episode == 1):
            one = [
                torch.from_numpy(field[row : row + 1])
                for field in (data.action, data.pixels, data.first)
            ]
            latent = model.filter(latent, *one)
            torch.testing.assert_close(latents.at(torch.tensor([row])).h, latent.h)


def test_the_multiplier_rises_above_the_limit_and_falls_below_it():
    rule = MultiplierRule(initial=0.3, rate=0.1, bound=0.6, limit=25.0)
    assert rule.next(0.3, 50.0) == pytest.approx(0.4)
    assert rule.next(0.3, 0.0) == pytest.approx(0.2)
    assert rule.next(0.05, 0.0) == 0.0
    assert rule.next(0.55, 500.0) == 0.6
    assert (
        MultiplierRule(initial=0.3, rate=0.1, bound=0.6, limit=25.0, floor=0.1).next(0.15, 0.0)
        == 0.1
    )
    staged = MultiplierRule(
        initial=0.3, rate=0.1, bound=5.0, limit=25.0, later=LaterLimit(1000, 5.0)
    )
    assert staged.next(0.3, 25.0, 999) == pytest.approx(0.3)
    assert staged.next(0.3, 25.0, 1000) == pytest.approx(0.7)  # five times the second limit


def test_the_refit_moves_only_the_heads_that_imagination_reads():
    torch.manual_seed(0)
    model, data = build(TINY, 2), recording()
    model.requires_grad_(False)
    latents = encode(model, data, no_progress)
    assert latents.h.shape == (36, 16)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    refit_heads(model, data, latents, data.episode < 2, TINY, 0, no_progress)
    moved = {
        name.split(".")[0]
        for name, value in model.state_dict().items()
        if not torch.equal(value, before[name])
    }
    assert moved == {"reward_head", "cost_head", "continue_head"}


def test_the_refit_learns_nothing_of_what_lies_behind_the_last_row():
    data = recording()
    longer = Recording(*(np.concatenate([field, field[:12]]) for field in data))
    longer.episode[36:] = 3
    heads = []
    for rows in (data, longer):
        torch.manual_seed(0)
        model = build(TINY, 2).requires_grad_(False)
        refit_heads(
            model, rows, encode(model, rows, no_progress), rows.episode == 2, TINY, 0, no_progress
        )
        heads.append({name: value for name, value in model.state_dict().items() if "head" in name})
    for name, value in heads[0].items():
        torch.testing.assert_close(value, heads[1][name], msg=name)


def test_the_refit_teaches_where_episodes_end():
    data = recording((6,) * 40)
    last = np.arange(240) % 6 == 5
    data.terminal[last] = 1.0
    data.action[:] = np.where(last, 1.0, -1.0)[:, None]  # what led there tells it
    torch.manual_seed(0)
    model = build(TINY, 2).requires_grad_(False)
    latents = encode(model, data, no_progress)
    refit_heads(
        model,
        data,
        latents,
        data.episode < 40,
        TINY.model_copy(update={"refit_updates": 300}),
        0,
        no_progress,
    )
    with torch.inference_mode():
        rows, noise = np.flatnonzero(~last), gumbel((200, model.noise_size), generator(1))
        arrived = model.imagine(
            latents.at(torch.from_numpy(rows)), torch.from_numpy(data.action[rows + 1]), noise
        )
        goes_on = model.continues(arrived).numpy()
    assert goes_on[last[rows + 1]].max() < 0.3
    assert goes_on[~last[rows + 1]].min() > 0.7


# Stored episodes come back bit for bit, recorded actions are carried out again, and what differs is
# noticed.


@pytest.fixture(scope="module")
def cell(inputs, tmp_path_factory) -> Evaluated:
    return evaluated(inputs, tmp_path_factory.mktemp("cell"), "saferl", {})


def test_latents_commands_and_actions_of_an_assisted_cell_come_back(inputs, parts, tmp_path):
    variant, value = "reaction-time", 0.8
    cell = evaluated(inputs, tmp_path, "saferl", {}, variant, value, episodes=2)
    world = cell.world()
    layouts = [layout_seed(cell.task, cell.seed, e) for e in range(cell.episodes)]
    own = [method_seed(cell.task, variant, cell.seed, e, "saferl") for e in range(cell.episodes)]
    assistant = build_assistant("saferl", {}, parts)
    loop = run_episodes(
        world, parts.world_model, cell.operator(world), assistant, layouts, own, keep_latents=True
    )
    decisions = 0
    for moment in cell.rerun():
        alive = moment.alive
        assert alive.tolist() == loop.alive[moment.t].tolist()
        assert moment.t == decisions
        decisions += 1
        for found, expected in (
            (moment.latent.h, loop.h[moment.t]),
            (moment.latent.z, loop.z[moment.t]),
            (moment.a_h, torch.from_numpy(loop.a_h[moment.t])),
            (moment.action, torch.from_numpy(loop.action[moment.t])),
        ):
            assert torch.equal(found[alive], expected[alive])
    assert decisions == len(loop.reward) == DECISIONS


def test_a_changed_action_is_noticed(cell):
    recorded = Recorded(**read_recorded(cell.path))
    changed = [actions.copy() for actions in recorded.a]
    changed[1][5] = -changed[1][5]
    with pytest.raises(
        ArtifactError, match=r"episode 1 is not the recorded one from decision [56] on"
    ):
        list(cell.rerun(a=changed))


def test_a_changed_command_is_noticed_at_once_and_counted_within_its_cell(cell):
    changed = [commands.copy() for commands in Recorded(**read_recorded(cell.path)).a_h]
    changed[2][4, 0] = np.nextafter(changed[2][4, 0], np.float32(2.0))
    with pytest.raises(
        ArtifactError,
        match="episode 12 is not the recorded one from decision 4 on: the command of the operator",
    ):
        list(cell.rerun(a_h=changed, first=10))


LENGTHS = (4, 2, 3)


class Counting:
    """Rows that end after LENGTHS decisions; a reward is the sum of the actions so far."""

    batch = len(LENGTHS)

    def reset(self, seeds: list[int]) -> Observation:
        self.seeds, self.t, self.sums = seeds, 0, np.zeros(self.batch)
        return Observation(None, None, None)

    def step(self, action: Any) -> Step:
        self.t += 1
        self.sums = self.sums + action.sum(1)
        ended, nothing = (
            np.array([self.t >= length for length in LENGTHS]),
            np.zeros(self.batch, np.int64),
        )
        return Step(
            Observation(None, None, None),
            self.sums,
            nothing > 0,
            nothing,
            {},
            nothing,
            nothing,
            ended,
            ended,
        )


@pytest.fixture
def recorded() -> tuple[list[Any], list[Any]]:
    random = np.random.default_rng(0)
    actions = [random.uniform(-1, 1, (length, 2)).astype(np.float32) for length in LENGTHS]
    return actions, [
        np.cumsum(episode.sum(1).astype(np.float64)).astype(np.float32) for episode in actions
    ]


def played(actions: list[Any], rewards: list[Any], tolerance: float = 0.0) -> list[Any]:
    task: Any = Counting()
    return list(play(task, range(5, 5 + task.batch), actions, rewards, tolerance))


def test_there_is_a_moment_before_every_decision_and_one_after_the_last(recorded):
    moments = played(*recorded)
    assert [moment.t for moment in moments] == [0, 1, 2, 3, 4]
    assert [moment.alive.tolist() for moment in moments] == [
        [t < length for length in LENGTHS] for t in range(5)
    ]
    np.testing.assert_array_equal(
        [moment.action for moment in moments[:-1]], side_by_side(recorded[0])
    )
    assert not moments[-1].action.any()
    assert moments[0].last is None
    assert [moment.last.ended.sum() for moment in moments[1:]] == [0, 1, 2, 3]


def test_a_reward_may_differ_by_the_tolerance_and_no_more(recorded):
    actions, rewards = recorded
    rewards[2][1] += 3e-5
    assert len(played(actions, rewards, 1e-4)) == 5
    with pytest.raises(
        ArtifactError, match="episode 2 is not the recorded one from decision 1 on: the reward is"
    ) as caught:
        played(actions, rewards)
    assert "other libraries" in str(caught.value.hint)


@pytest.mark.parametrize(("by", "what", "at"), [(-1, "goes on", 0), (1, "ends", 1)])
def test_an_episode_of_another_length_is_refused(by, what, at, recorded):
    actions, rewards = recorded
    actions[1], rewards[1] = np.resize(actions[1], (2 + by, 2)), np.resize(rewards[1], 2 + by)
    with pytest.raises(
        ArtifactError,
        match=f"episode 1 is not the recorded one from decision {at} on: the episode {what} here",
    ):
        played(actions, rewards)
