"""World models that see vectors: their units, their losses, and that they filter, imagine and
decode as those of images do.
"""

import dataclasses
import json

import numpy as np
import pytest
import torch

from wasp_cli.models.vectors import BOUND, MAGNITUDE, standard_of, standardised
from wasp_cli.models.world_model import (
    Ahead,
    Batch,
    SafetyWorldModel,
    Sizes,
    load_world_model,
    save_world_model,
)

SIZES = Sizes(
    action=2,
    deter=16,
    hidden=16,
    variables=3,
    classes=4,
    depth=2,
    head=16,
    unimix=0.01,
    reward_scale=5.0,
    cost_weight=5.0,
)
MEANS = np.array([1000.3, -2e-3, 7.0, 1e6])
SPREADS = np.array([0.05, 1e-4, 0.0, 3e5])


def vectors(rows: int, seed: int = 0) -> np.ndarray:
    """Vectors [rows, 4] of very different scales; the third component never changes."""
    return MEANS + SPREADS * np.random.default_rng(seed).normal(size=(rows, 4))


def model() -> SafetyWorldModel:
    torch.manual_seed(0)
    known = standard_of(vectors(500))
    return SafetyWorldModel(dataclasses.replace(SIZES, state_mean=known.mean, state_std=known.std))


@pytest.fixture(params=["pixels", "state"])
def world_and_seen(request) -> tuple[SafetyWorldModel, torch.Tensor]:
    """A world model, and what it sees of 2 x 3 steps."""
    if request.param == "state":
        return model(), torch.from_numpy(vectors(6)).unflatten(0, (2, 3))
    torch.manual_seed(0)
    source = torch.Generator().manual_seed(1)
    images = torch.randint(0, 256, (2, 3, 6, 64, 64), generator=source, dtype=torch.uint8)
    return SafetyWorldModel(SIZES), images


def batch(seen: torch.Tensor) -> Batch:
    source = torch.Generator().manual_seed(1)
    flags = torch.zeros(2, 3)
    action, reward = torch.randn(2, 3, 2, generator=source), torch.randn(2, 3, generator=source)
    return Batch(seen, action, reward, flags + 0, flags, flags)


def test_vectors_of_any_units_have_mean_0_and_spread_1_and_what_is_constant_is_0():
    seen = vectors(2000)
    known = standard_of(seen)
    found = standardised(
        torch.from_numpy(seen), torch.tensor(known.mean).double(), torch.tensor(known.std).double()
    ).numpy()
    moving = [0, 1, 3]
    np.testing.assert_allclose(found[:, moving].mean(0), 0, atol=1e-3)
    np.testing.assert_allclose(found[:, moving].std(0), 1, atol=1e-2)
    np.testing.assert_allclose(found[:, 2], 0, atol=1e-6)
    assert known.std[2] == 1.0


def test_what_the_dataset_never_had_stays_within_a_bound():
    world = model()
    odd = torch.tensor([[-1e30, 1e30, 7e9, np.inf], [1000.3, -2e-3, 7.0, 1e6]])
    found = world.standardised(odd)
    assert found[0].tolist() == [-BOUND, BOUND, BOUND, BOUND]
    latent = world.filter(world.initial(2), torch.zeros(2, 2), odd, torch.ones(2))
    assert torch.isfinite(latent.features).all()


def test_the_loss_of_a_vector_is_the_squared_error_in_standard_deviations():
    world, seen = model().eval(), torch.from_numpy(vectors(6)).unflatten(0, (2, 3))
    noise = torch.zeros(2, 3, 3, 4)
    with torch.no_grad():
        losses, latent = world.losses(batch(seen), noise, torch.tensor([0, 2]), 1.0)
        decoded = world.decode(latent).double().numpy()[:, [0, 2]]
    mean, std = np.array(world.sizes.state_mean), np.array(world.sizes.state_std)
    true, told = ((each - mean) / std for each in (seen.numpy()[:, [0, 2]], decoded))
    assert np.abs(true).max() < BOUND
    wanted = MAGNITUDE * np.square(told - true).mean()
    # what is decoded is told in float32, in units of up to 1e6
    assert losses["beta_o"].item() == pytest.approx(wanted, rel=1e-2)


def test_a_dataset_that_is_not_understood_costs_what_images_cost():
    """With a decoder that tells the mean, the loss is MAGNITUDE times the share of components that
    move at all.
    """
    world, seen = model().eval(), torch.from_numpy(vectors(6000)).unflatten(0, (2, 3000))
    last = world.decoder[-1]
    torch.nn.init.zeros_(last.weight)
    torch.nn.init.zeros_(last.bias)
    features = torch.zeros(6000, world.feature_size)
    with torch.no_grad():
        errors = world._decoding_errors(features, seen.flatten(0, 1))
    assert errors.mean().item() == pytest.approx(0.75 * MAGNITUDE, rel=0.03)


def test_every_loss_reaches_the_encoder_and_the_decoder(world_and_seen):
    world, seen = world_and_seen
    source = torch.Generator().manual_seed(2)
    ahead = Ahead(
        row=torch.tensor([0, 1]),
        step=torch.tensor([0, 1]),
        action=torch.randn(2, 2, 2, generator=source),
        reward=torch.zeros(2, 2),
        cost=torch.zeros(2, 2),
        within=torch.ones(2, 2),
        shown=torch.tensor([0, 1]),
        seen=seen[:, 0],
        noise=torch.zeros(2, 2, 12),
    )
    losses, latent = world.losses(
        batch(seen), torch.zeros(2, 3, 3, 4), torch.arange(3), 0.0, ahead=ahead
    )
    assert set(losses) == {
        *(f"alpha_{each}" for each in "qp"),
        *(f"beta_{each}" for each in "rcno"),
        *(f"ahead_{each}" for each in "rco"),
    }
    assert latent.features.shape == (2, 3, world.feature_size)
    torch.stack(list(losses.values())).sum().backward()
    for part in (world.encoder, world.decoder, world.rssm.posterior_o):
        assert all(bool(weight.grad.abs().sum() > 0) for weight in part.parameters())


def test_it_filters_what_it_reads_imagines_and_decodes(world_and_seen):
    world, seen = world_and_seen
    world.eval()
    with torch.inference_mode():
        once, twice = (
            world.filter(world.initial(2), torch.zeros(2, 2), seen[:, 0], torch.ones(2))
            for _ in range(2)
        )
        other = world.filter(world.initial(2), torch.zeros(2, 2), seen[:, 1], torch.ones(2))
        ahead = world.imagine(once, torch.ones(2, 2), torch.zeros(2, world.noise_size))
        decoded = world.decode(ahead)
    assert torch.equal(once.features, twice.features)
    assert not torch.equal(world.embed(seen[:, 0]), world.embed(seen[:, 1]))
    assert other.features.shape == once.features.shape == (2, world.feature_size)
    assert decoded.shape == seen[:, 0].shape
    assert decoded.dtype == torch.float32


def test_mixed_precision_changes_little(world_and_seen):
    world, seen = world_and_seen
    found = []
    for mixed in (False, True):
        with torch.autocast("cpu", torch.bfloat16, enabled=mixed), torch.no_grad():
            losses, _ = world.losses(batch(seen), torch.zeros(2, 3, 3, 4), torch.arange(3), 1.0)
        found.append(losses["beta_o"].item())
    assert found[1] == pytest.approx(found[0], rel=0.05)


def test_a_stored_model_keeps_its_units_to_the_bit(tmp_path):
    from wasp_cli.learning.rounding import rounded

    world, seen = model(), torch.from_numpy(vectors(4))
    save_world_model(rounded(world), tmp_path)
    loaded = load_world_model(tmp_path)
    assert loaded.reads == "state"
    assert torch.equal(loaded.standardised(seen), world.standardised(seen))
    with torch.inference_mode():
        assert torch.equal(loaded.embed(seen), world.embed(seen))


def test_the_file_of_a_model_of_images_is_as_it_was(tmp_path):
    save_world_model(SafetyWorldModel(SIZES), tmp_path)
    stored = json.loads((tmp_path / "world_model.json").read_text())
    assert set(stored) == {
        "action",
        "action_scales",
        "classes",
        "cost_weight",
        "depth",
        "deter",
        "head",
        "hidden",
        "reward_scale",
        "unimix",
        "variables",
    }
    assert load_world_model(tmp_path).reads == "pixels"
