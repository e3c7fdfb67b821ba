import pytest
import torch

from wasp_cli.models.base import Latent
from wasp_cli.models.nets import Encoder
from wasp_cli.models.rssm import Observed, balanced_kl
from wasp_cli.models.world_model import Batch, SafetyWorldModel, Sizes

SIZES = Sizes(action=2, deter=16, hidden=16, variables=3, classes=4, depth=2, head=16, unimix=0.01, reward_scale=5.0, cost_weight=5.0)


def model() -> SafetyWorldModel:
    torch.manual_seed(0)
    return SafetyWorldModel(SIZES)


def batch(rows: int = 2, steps: int = 3) -> Batch:
    source = torch.Generator().manual_seed(1)
    flags = torch.zeros(rows, steps)
    pixels = torch.randint(0, 256, (rows, steps, 6, 64, 64), generator=source, dtype=torch.uint8)
    return Batch(pixels, torch.randn(rows, steps, 2, generator=source), torch.randn(rows, steps, generator=source), flags + 0, flags, flags)


def test_centring_by_linearity_is_centring():
    torch.manual_seed(0)
    encoder, mean = Encoder(2), torch.rand(6, 64, 64)
    pixels = torch.randint(0, 256, (3, 6, 64, 64), dtype=torch.uint8)
    x = pixels / 255.0 - mean
    for layer in encoder.layers:
        x = torch.nn.functional.silu(layer(x))
    torch.testing.assert_close(encoder(pixels, mean), x.flatten(1), atol=1e-5, rtol=1e-5)


def test_the_terms_of_equation_6_all_reach_the_encoder():
    world = model()
    losses, _ = world.losses(batch(), torch.randn(2, 3, 3, 4), torch.tensor([0, 2]), free_nats=0.0)
    assert set(losses) == {"alpha_q", "alpha_p", "beta_o", "beta_r", "beta_c", "beta_n"}
    parameter = world.rssm.posterior_o.weight
    for name, loss in losses.items():
        (gradient,) = torch.autograd.grad(loss, parameter, retain_graph=True, allow_unused=True)
        # The prediction term trains the prior alone; the reward head starts at zero, so its features get no gradient yet.
        if name not in ("alpha_p", "beta_r"):
            assert gradient is not None, name
            assert gradient.abs().sum() > 0, name


def test_the_cost_is_calibrated_where_its_probability_varies():
    """A head trained with weight 5 on events of probability sigmoid(2 x - 3) answers with that probability, bin by bin."""
    world = model()
    source = torch.Generator().manual_seed(5)
    optimizer = torch.optim.Adam(world.cost_head.parameters(), lr=3e-3)
    for _ in range(300):
        features = torch.randn(512, world.feature_size, generator=source)
        cost = (torch.rand(512, generator=source) < (2 * features[:, 0] - 3).sigmoid()).float()
        _, loss = world.head_losses(features, torch.zeros(512), cost)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    fresh = torch.randn(4000, world.feature_size, generator=source)
    with torch.no_grad():
        predicted = world.cost(Latent(fresh[:, : SIZES.deter], fresh[:, SIZES.deter :]))
        raw = world.cost_head(fresh).squeeze(-1).sigmoid()
    wanted = (2 * fresh[:, 0] - 3).sigmoid()
    assert (predicted.mean() / wanted.mean()).item() == pytest.approx(1.0, abs=0.15)
    assert raw.mean() > 1.8 * wanted.mean()  # with the weight left in, the answer would be far off
    for group in predicted.argsort().split(800):  # fifths, from safe to dangerous
        assert predicted[group].mean().item() == pytest.approx(wanted[group].mean().item(), abs=0.05)


def test_filtering_is_deterministic_and_forgets_at_an_episode_start():
    world = model().eval()
    pixels = batch().pixels[:, 0]
    with torch.inference_mode():
        once, twice = (world.filter(world.initial(2), torch.zeros(2, 2), pixels, torch.ones(2)) for _ in range(2))
        later = world.filter(once, torch.randn(2, 2), pixels, torch.tensor([1.0, 0.0]))
    assert torch.equal(once.h, twice.h)
    torch.testing.assert_close(later.h[0], once.h[0])
    assert not torch.allclose(later.h[1], once.h[1])


def test_an_event_one_step_after_a_reset_is_learned_and_imagined():
    """The classic failure: a mask one step early makes heads see a blank context, and imagination never predicts the event.

    Sequences hold two episodes; in each, the action at the start decides whether the next step costs. Images show nothing.
    """
    torch.manual_seed(3)
    world = SafetyWorldModel(SIZES)
    optimizer = torch.optim.Adam(world.parameters(), lr=6e-3)
    source = torch.Generator().manual_seed(0)
    first = torch.tensor([1.0, 0, 0, 1, 0, 0]).expand(32, 6)
    after = torch.tensor([0.0, 1, 0, 0, 1, 0])
    pixels = torch.zeros(32, 6, 6, 64, 64, dtype=torch.uint8)

    def actions() -> torch.Tensor:
        return torch.where(torch.rand(32, 6, 2, generator=source) < 0.5, -1.0, 1.0)

    def filtered(action: torch.Tensor) -> Observed:
        noise = torch.zeros(32, 6, 3, 4)
        return world.rssm.observe(projected, action, first, noise)

    with torch.no_grad():
        blank = world.encoder(pixels[:1, 0], world.mean_image)
    for _ in range(90):
        action = actions()
        cost = (action[..., 0] > 0).float() * after
        projected = world.rssm.posterior_o(blank).expand(32, 6, -1)
        seen = filtered(action)
        _, cost_loss = world.head_losses(seen.latent.features, cost, cost)
        loss = cost_loss + sum(balanced_kl(seen.posterior, seen.prior, 0.1))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    with torch.inference_mode():
        projected = world.rssm.posterior_o(blank).expand(32, 6, -1)
        seen = filtered(actions())
        fresh = world.filter(world.initial(1), torch.zeros(1, 2), pixels[:1, 0], torch.ones(1))
        for t, start in ((0, fresh), (3, Latent(seen.latent.h[:, 3], seen.latent.z[:, 3]))):
            rows = len(start.h)
            for command, low, high in ((1.0, 0.7, 1.0), (-1.0, 0.0, 0.2)):
                arrived = world.imagine(start, torch.tensor([[command, 0.0]]).expand(rows, 2), torch.zeros(rows, world.noise_size))
                assert (world.cost(arrived) >= low).all(), (t, command)
                assert (world.cost(arrived) <= high).all(), (t, command)
