"""What `wasp` asks of every assistant and every operator, over those of this package. Copy it,
and put your own in their places.
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from wasp_example.assistant import Careful
from wasp_example.configs import CarefulConfig
from wasp_example.operator import SluggishOperator
from wasp_example.risk import Risk, examples

from wasp_cli.methods.base import Parts, checked
from wasp_cli.models.base import Latent
from wasp_cli.models.policy import Skills
from wasp_cli.models.weights import save_weights
from wasp_cli.operators.base import EpisodeNoise, OperatorContext

H, Z, A, STEPS = 12, 8, 2, 6  # sizes of the latent's parts and of an action; decisions
SEEDS = [7, 8, 9, 10, 11]  # of the episodes


@pytest.fixture
def parts(tmp_path):
    """What an assistant is built from: here an untrained network, where its stage would leave
    the trained one, and no world model.
    """
    torch.manual_seed(0)
    sizes = {"features": H + Z, "action": A, "hidden": [8]}
    save_weights(Risk(**sizes), tmp_path / "risk.safetensors", **sizes)
    return Parts(
        None,
        Skills([1.0], H + Z, [8], A),
        {"risk": tmp_path},
        {},
        gamma_r=0.99,
        gamma_c=0.95,
        lam=0.95,
    )


def operator(parts, seeds):
    context = OperatorContext(skill=parts.skills.at, action_size=A, decision_seconds=0.1)
    return SluggishOperator.build(0.8, context, EpisodeNoise(seeds), len(seeds))


@torch.inference_mode()
def drive(parts, rows):
    """Commands, actions [T, B, A] and fired gates [T, B] of some of the episodes; `checked` is
    what the closed loop asks as well.
    """
    seeds = [SEEDS[row] for row in rows]
    assistant, who = Careful(CarefulConfig(limit=0.5), parts), operator(parts, seeds)
    assistant.reset(torch.ones(len(rows), dtype=torch.bool), seeds)
    found = []
    for t in range(STEPS):
        source = torch.Generator().manual_seed(t)
        latent = Latent(
            torch.randn(len(SEEDS), H, generator=source),
            torch.randn(len(SEEDS), Z, generator=source),
        ).rows(torch.tensor(rows))
        a_h = who.command(latent.features)
        given = a_h.clone()
        decision = checked(assistant.decide(latent, a_h, who), assistant, a_h, given)
        who.observe(decision.action)
        found.append((a_h, decision.action, decision.record.gate > 0))
    return [torch.stack(values) for values in zip(*found, strict=True)]


def test_it_acts_within_bounds_and_only_where_its_gate_fired(parts):
    commands, actions, fired = drive(parts, range(len(SEEDS)))
    assert actions.abs().max() <= 1
    assert fired.any()
    assert not fired.all()
    assert torch.equal(actions[~fired], commands[~fired])


@torch.inference_mode()
def test_it_decides_where_the_models_are(parts):
    """Tensors of the device `meta` have shapes and no values; like those of a GPU they do not
    mix with those of the CPU.
    """
    parts.skills.to("meta")
    who, latent = (
        operator(parts, SEEDS).to(parts.device),
        Latent(torch.zeros(len(SEEDS), H), torch.zeros(len(SEEDS), Z)).to(parts.device),
    )
    decision = Careful(CarefulConfig(limit=0.5), parts).decide(
        latent, who.command(latent.features), who
    )
    assert {tensor.device for tensor in (decision.action, *decision.record)} == {parts.device}


def test_the_same_episodes_go_the_same_way(parts):
    assert torch.equal(drive(parts, range(len(SEEDS)))[1], drive(parts, range(len(SEEDS)))[1])


def test_an_episode_does_not_depend_on_those_beside_it(parts):
    torch.testing.assert_close(drive(parts, [3])[1][:, 0], drive(parts, range(len(SEEDS)))[1][:, 3])


def test_the_operator_goes_on_from_a_snapshot(parts):
    who, features = operator(parts, SEEDS), torch.randn(4, len(SEEDS), H + Z)
    first = who.command(features[0])
    saved = who.snapshot()
    wanted = [who.command(seen) for seen in features[1:]]
    who.restore(saved)
    assert all(
        torch.equal(who.command(seen), command)
        for seen, command in zip(features[1:], wanted, strict=True)
    )
    assert not torch.equal(wanted[0], first)


def test_the_operator_in_imagination_has_the_memory_of_the_real_one(parts):
    who, features = operator(parts, SEEDS), torch.randn(2, len(SEEDS), H + Z)
    who.command(features[0])
    imagined = who.fork(torch.arange(len(SEEDS)), 2, EpisodeNoise([0] * 2 * len(SEEDS)))
    assert torch.equal(
        imagined.command(features[1].repeat_interleave(2, 0)),
        who.command(features[1]).repeat_interleave(2, 0),
    )


def test_examples_of_the_network_are_whole_windows_of_one_episode():
    recorded = SimpleNamespace(
        cost=np.array([0, 0, 1, 0, 0, 0, 0, 1.0]), episode=np.array([0, 0, 0, 0, 1, 1, 1, 1])
    )
    rows, costly = examples(recorded, window=2)
    assert rows.tolist() == [0, 1, 4, 5]  # the state; its action arrives in the next row
    assert costly.tolist() == [True, True, False, True]
