"""The packed step and the networks that look rows up, against the model's own one-hot products."""

import pytest
import torch
from torch.nn import functional as F

from wasp_cli.models.base import Latent
from wasp_cli.models.coded import Coded, first_layer
from wasp_cli.models.critics import LatentCritics
from wasp_cli.models.nets import mlp
from wasp_cli.models.packed import PackedModel
from wasp_cli.models.policy import LatentPolicy
from wasp_cli.models.world_model import SafetyWorldModel, Sizes

H, B, COPIES = 6, 5, 7
R = B * COPIES


def world(classes: int = 5) -> SafetyWorldModel:
    """Weights of the size of trained ones: a step of them changes the latent."""
    torch.manual_seed(0)
    sizes = Sizes(
        action=2, deter=24, hidden=20, variables=6, classes=classes, depth=2, head=16, unimix=0.01, reward_scale=5.0, cost_weight=5.0,
        action_scales=(1.0, 0.1),
    )  # fmt: skip
    model = SafetyWorldModel(sizes).eval().requires_grad_(False)
    for head in (model.reward_head, model.cost_head, model.continue_head):
        torch.nn.init.normal_(head[-1].weight, std=0.3)
    for weight in model.rssm.parameters():
        weight.mul_(2.0)
    return model


def one_hot(model: SafetyWorldModel, rows: int) -> Latent:
    drawn = torch.randint(0, model.rssm.classes, (rows, model.rssm.variables))
    return Latent(torch.randn(rows, model.rssm.deter).tanh(), F.one_hot(drawn, model.rssm.classes).float().flatten(1))


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
        here = packed.imagine(here, actions[k], packed.chances(noise[k]), room.step(k), COPIES if k == 0 else 1)
        wanted.append(latent)
    whole = Latent(torch.stack([step.h for step in wanted]), torch.stack([step.z for step in wanted]))
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
    coded = packed.imagine(one_hot(model, R), torch.zeros(R, 2), torch.ones(R, model.noise_size), packed.room(1, R).step(0))
    features = coded.features
    assert features.latent is coded
    assert not hasattr(features * 1.0, "latent")
    torch.testing.assert_close(policy(features), policy(features * 1.0), atol=1e-6, rtol=1e-5)
    # A part of the features is another tensor: nothing may be answered from the whole.
    torch.testing.assert_close(policy(features[3:5]), policy(features * 1.0)[3:5], atol=1e-6, rtol=1e-5)


def test_weights_that_have_changed_are_laid_out_anew():
    net = mlp(10, [8], 3)
    coded = Coded.of(torch.randn(4, 4), torch.tensor([[0, 3], [1, 5], [2, 4], [0, 5]], dtype=torch.int32), 6)
    with torch.no_grad():
        torch.testing.assert_close(coded.through(net), net(coded.features), atol=1e-6, rtol=1e-5)
        held = first_layer(net[0], 4)
        assert first_layer(net[0], 4) is held
        net[0].weight.mul_(3.0)
        coded.known.clear()
        torch.testing.assert_close(coded.through(net), net(coded.features), atol=1e-6, rtol=1e-5)
