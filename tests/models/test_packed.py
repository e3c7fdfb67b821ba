"""The packed step and the networks that look rows up, against the model's own one-hot products."""

import pytest
import torch
from torch.nn import functional as F

from wasp_cli.errors import ArtifactError
from wasp_cli.models.base import Latent
from wasp_cli.models.coded import Coded, first_layer
from wasp_cli.models.critics import LatentCritics, TwoHot
from wasp_cli.models.nets import mlp
from wasp_cli.models.packed import PackedModel
from wasp_cli.models.policy import LatentPolicy
from wasp_cli.models.weights import load_weights, read_arguments, save_weights
from wasp_cli.models.world_model import SafetyWorldModel, Sizes

H, B, COPIES = 6, 5, 7
R = B * COPIES


def world(classes: int = 5) -> SafetyWorldModel:
    """Weights of the size of trained ones: a step of them changes the latent."""
    torch.manual_seed(0)
    sizes = Sizes(
        action=2,
        deter=24,
        hidden=20,
        variables=6,
        classes=classes,
        depth=2,
        head=16,
        unimix=0.01,
        reward_scale=5.0,
        cost_weight=5.0,
        action_scales=(1.0, 0.1),
    )
    model = SafetyWorldModel(sizes).eval().requires_grad_(False)
    for head in (model.reward_head, model.cost_head, model.continue_head):
        torch.nn.init.normal_(head[-1].weight, std=0.3)
    for weight in model.rssm.parameters():
        weight.mul_(2.0)
    return model


def one_hot(model: SafetyWorldModel, rows: int) -> Latent:
    drawn = torch.randint(0, model.rssm.classes, (rows, model.rssm.variables))
    return Latent(
        torch.randn(rows, model.rssm.deter).tanh(),
        F.one_hot(drawn, model.rssm.classes).float().flatten(1),
    )


def as_latent(coded: Coded, deter: int) -> Latent:
    return Latent(coded.h, coded.features[..., deter:])


@pytest.mark.parametrize("classes", [2, 5, 16])
@torch.inference_mode()
def test_a_packed_rollout_is_that_of_the_model(classes):
    model = world(classes)
    packed = PackedModel(model)
    start = one_hot(model, B)
    actions = 3 * torch.randn(H, R, 2)
    noise = -(-torch.rand(H, R, model.noise_size).clamp(1e-20, 1 - 1e-7).log()).log()
    latent, here, room = start.expand_rows(COPIES), start, packed.room(H, R)
    wanted = []
    for k in range(H):
        latent = model.imagine(latent, actions[k], noise[k])
        here = packed.imagine(
            here, actions[k], packed.chances(noise[k]), room.step(k), COPIES if k == 0 else 1
        )
        wanted.append(latent)
    whole = Latent(
        torch.stack([step.h for step in wanted]), torch.stack([step.z for step in wanted])
    )
    found = as_latent(room, model.rssm.deter)
    assert (found.z == whole.z).all(), "another class was drawn"
    assert found.z.sum() == H * R * model.rssm.variables
    torch.testing.assert_close(found.h, whole.h, atol=2e-6, rtol=0)
    assert not torch.allclose(whole.h[-1], whole.h[-2], atol=0.1), "the rollout stands still"
    critics = LatentCritics(model.feature_size, [12, 12]).requires_grad_(False)
    torch.nn.init.normal_(critics.cost_net[-1].weight)
    for function in (model.reward, model.cost, model.continues, critics.value_r, critics.value_c):
        torch.testing.assert_close(function(room), function(whole), atol=2e-5, rtol=1e-4)


@torch.inference_mode()
def test_a_policy_reads_joined_features_by_their_classes_and_copies_of_them_as_they_are():
    model = world()
    policy = LatentPolicy(model.feature_size, (16, 16), 2).requires_grad_(False)
    packed = PackedModel(model)
    coded = packed.imagine(
        one_hot(model, R),
        torch.zeros(R, 2),
        torch.ones(R, model.noise_size),
        packed.room(1, R).step(0),
    )
    features = coded.features
    assert features.latent is coded
    assert not hasattr(features * 1.0, "latent")
    torch.testing.assert_close(policy(features), policy(features * 1.0), atol=1e-6, rtol=1e-5)
    # A part of the features is another tensor: nothing may be answered from the whole.
    torch.testing.assert_close(
        policy(features[3:5]), policy(features * 1.0)[3:5], atol=1e-6, rtol=1e-5
    )


def test_weights_that_have_changed_are_laid_out_anew():
    net = mlp(10, [8], 3)
    coded = Coded.of(
        torch.randn(4, 4), torch.tensor([[0, 3], [1, 5], [2, 4], [0, 5]], dtype=torch.int32), 6
    )
    with torch.no_grad():
        torch.testing.assert_close(coded.through(net), net(coded.features), atol=1e-6, rtol=1e-5)
        held = first_layer(net[0], 4)
        assert first_layer(net[0], 4) is held
        net[0].weight.mul_(3.0)
        coded.answers.clear()
        torch.testing.assert_close(coded.through(net), net(coded.features), atol=1e-6, rtol=1e-5)


def values() -> torch.Tensor:
    source = torch.Generator().manual_seed(0)
    spread = torch.randn(200, generator=source) * torch.logspace(-4, 2, 200)
    return torch.cat([spread, torch.tensor([0.0, -1e-6, 1.0, 999.9, -1000.0, 1000.0])])


@pytest.mark.parametrize("bins", [3, 63, 255])
def test_a_number_comes_back_from_its_two_bins(bins):
    scale = TwoHot(bins, 1000.0)
    weights = scale.encode(values())
    assert (weights >= 0).all()
    torch.testing.assert_close(weights.sum(-1), torch.ones(len(values())))
    assert ((weights > 0).sum(-1) <= 2).all()
    decoded = scale.decode(weights.double().clamp(min=1e-30).log())
    torch.testing.assert_close(decoded, values(), rtol=1e-4, atol=1e-4)


def test_bins_in_their_own_places_and_beyond_the_reach():
    scale = TwoHot(5, 8.0)  # symlog 9 = ln 9; halfway lies ln 3
    torch.testing.assert_close(scale.bins, torch.tensor([-8.0, -2.0, 0.0, 2.0, 8.0]))
    weights = scale.encode(torch.tensor([[-8.0, 0.0, 3.5], [2.0, 8.0, 1e9]]))
    wanted = torch.tensor(
        [
            [[1.0, 0, 0, 0, 0], [0, 0, 1, 0, 0], [0, 0, 0, 0.75, 0.25]],
            [[0, 0, 0, 1, 0], [0, 0, 0, 0, 1], [0, 0, 0, 0, 1]],
        ]
    )
    torch.testing.assert_close(weights, wanted)
    torch.testing.assert_close(scale.encode(torch.tensor(-1e9)), torch.tensor([1.0, 0, 0, 0, 0]))


def test_opposite_logits_have_opposite_values_and_equal_ones_exactly_zero():
    scale = TwoHot(63, 1000.0)
    logits = torch.randn(20, 63, generator=torch.Generator().manual_seed(1))
    assert torch.equal(scale.bins, -scale.bins.flip(0))
    torch.testing.assert_close(scale.decode(logits.flip(-1)), -scale.decode(logits))
    assert scale.decode(torch.full((1, 63), 0.3)).item() == 0.0
    critics = LatentCritics(6, (8,))
    latent = Latent(torch.randn(5, 4), torch.randn(5, 2))
    assert (critics.value_r(latent) == 0).all()
    assert (critics.value_c(latent) == 0).all()


@pytest.mark.parametrize("bins", [1, 2, 64])
def test_bins_without_a_middle_are_refused(bins):
    with pytest.raises(ValueError, match="odd"):
        TwoHot(bins, 10.0)


def test_weights_and_arguments_come_back(tmp_path):
    path = tmp_path / "critics.safetensors"
    critics = LatentCritics(4, (8,))
    save_weights(critics, path, features=4, hidden=[8])
    again = LatentCritics(**read_arguments(path))
    load_weights(again, path)
    assert all(
        torch.equal(a, b)
        for a, b in zip(critics.state_dict().values(), again.state_dict().values(), strict=True)
    )
    assert not any(p.requires_grad for p in again.parameters())


@pytest.mark.parametrize("damage", ["missing", "truncated", "other shape", "no arguments"])
def test_a_damaged_artifact_is_named(tmp_path, damage):
    path = tmp_path / "critics.safetensors"
    save_weights(LatentCritics(4, (8,)), path, features=4, hidden=[8])
    if damage == "missing":
        path.unlink()
    elif damage == "truncated":
        path.write_bytes(path.read_bytes()[:-20])
    elif damage == "no arguments":
        path.with_suffix(".json").write_text("{")
    with pytest.raises(ArtifactError, match="critics"):
        load_weights(
            LatentCritics(**read_arguments(path))
            if damage != "other shape"
            else LatentCritics(5, (8,)),
            path,
        )
