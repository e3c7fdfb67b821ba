import math

import pytest
import torch
from torch import Tensor

from wasp_cli.models.base import Latent
from wasp_cli.models.nets import Encoder
from wasp_cli.models.rssm import RSSM, Observed, balanced_kl, kl_divergence
from wasp_cli.models.world_model import Batch, SafetyWorldModel, Sizes

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


def model() -> SafetyWorldModel:
    torch.manual_seed(0)
    return SafetyWorldModel(SIZES)


def batch(rows: int = 2, steps: int = 3) -> Batch:
    source = torch.Generator().manual_seed(1)
    flags = torch.zeros(rows, steps)
    pixels = torch.randint(0, 256, (rows, steps, 6, 64, 64), generator=source, dtype=torch.uint8)
    return Batch(
        pixels,
        torch.randn(rows, steps, 2, generator=source),
        torch.randn(rows, steps, generator=source),
        flags + 0,
        flags,
        flags,
    )


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
        # The prediction term trains the prior alone; the reward head starts at zero, so its
        # features get no gradient yet.
        if name not in ("alpha_p", "beta_r"):
            assert gradient is not None, name
            assert gradient.abs().sum() > 0, name


def test_the_cost_is_calibrated_where_its_probability_varies():
    """A head trained with weight 5 on events of probability sigmoid(2 x - 3) answers with that
    probability, bin by bin.
    """
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
        assert predicted[group].mean().item() == pytest.approx(
            wanted[group].mean().item(), abs=0.05
        )


def test_filtering_is_deterministic_and_forgets_at_an_episode_start():
    world = model().eval()
    pixels = batch().seen[:, 0]
    with torch.inference_mode():
        once, twice = (
            world.filter(world.initial(2), torch.zeros(2, 2), pixels, torch.ones(2))
            for _ in range(2)
        )
        later = world.filter(once, torch.randn(2, 2), pixels, torch.tensor([1.0, 0.0]))
    assert torch.equal(once.h, twice.h)
    torch.testing.assert_close(later.h[0], once.h[0])
    assert not torch.allclose(later.h[1], once.h[1])


def test_an_event_one_step_after_a_reset_is_learned_and_imagined():
    """The classic failure: a mask one step early makes heads see a blank context, and imagination
    never predicts the event.

    Sequences hold two episodes; in each, the action at the start decides whether the next step
    costs. Images show nothing.
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
                arrived = world.imagine(
                    start,
                    torch.tensor([[command, 0.0]]).expand(rows, 2),
                    torch.zeros(rows, world.noise_size),
                )
                assert (world.cost(arrived) >= low).all(), (t, command)
                assert (world.cost(arrived) <= high).all(), (t, command)


def small() -> RSSM:
    torch.manual_seed(0)
    return RSSM(action=2, embed=6, deter=8, hidden=8, variables=3, classes=4, unimix=0.01)


def logs(*rows: tuple[float, ...]) -> torch.Tensor:
    return torch.tensor(rows, dtype=torch.float64).log()


def test_kl_is_the_sum_over_variables_by_hand():
    q, p = logs((0.5, 0.5), (0.9, 0.1)), logs((0.25, 0.75), (0.5, 0.5))
    by_hand = (
        0.5 * math.log(2) + 0.5 * math.log(0.5 / 0.75) + 0.9 * math.log(1.8) + 0.1 * math.log(0.2)
    )
    assert kl_divergence(q, p).item() == pytest.approx(by_hand)
    assert kl_divergence(q, q).item() == pytest.approx(0.0, abs=1e-12)


def test_free_nats_clip_every_step_by_itself_by_hand():
    """Two steps, one variable: the one below a free nat counts as 1, the one above as it is,
    alone in the gradient.
    """
    q = torch.tensor([[[0.5, 0.5]], [[0.99, 0.01]]], dtype=torch.float64).log().requires_grad_()
    p = torch.tensor([[[0.9, 0.1]], [[0.1, 0.9]]], dtype=torch.float64).log().requires_grad_()
    below = 0.5 * math.log(0.5 / 0.9) + 0.5 * math.log(0.5 / 0.1)
    above = 0.99 * math.log(0.99 / 0.1) + 0.01 * math.log(0.01 / 0.9)
    assert below < 1.0 < above
    representation, prediction = balanced_kl(q, p, 1.0)
    assert representation.item() == pytest.approx((1.0 + above) / 2)
    assert prediction.item() == pytest.approx((1.0 + above) / 2)
    (0.1 * representation + prediction).backward()
    assert (q.grad[0] == 0).all()
    assert (p.grad[0] == 0).all()
    # d/d log p_i of sum q (log q - log p) is -q_i; half of it for the mean over two steps.
    torch.testing.assert_close(p.grad[1, 0], torch.tensor([-0.99, -0.01], dtype=torch.float64) / 2)
    # d/d log q_i is q_i (log q_i - log p_i + 1); a tenth of it is the weight of the representation
    # term.
    by_hand = [0.1 * 0.5 * x * (math.log(x / y) + 1) for x, y in ((0.99, 0.1), (0.01, 0.9))]
    torch.testing.assert_close(q.grad[1, 0], torch.tensor(by_hand, dtype=torch.float64))


def test_samples_are_one_hot_and_follow_the_distribution():
    rssm = small()
    log_probs = torch.tensor([0.7, 0.1, 0.1, 0.1]).log().expand(20000, 3, 4)
    uniform = torch.rand(20000, 3, 4, generator=torch.Generator().manual_seed(0)).clamp(1e-9)
    with torch.no_grad():
        drawn = rssm.sample(log_probs, -(-uniform.log()).log()).unflatten(-1, (3, 4))
        mode = rssm.sample(log_probs, None).unflatten(-1, (3, 4))
    assert (drawn.sum(-1) == 1).all()
    torch.testing.assert_close(
        drawn.mean((0, 1)), torch.tensor([0.7, 0.1, 0.1, 0.1]), atol=0.01, rtol=0
    )
    assert (mode[..., 0] == 1).all()


def test_an_episode_start_masks_h_z_and_the_action():
    rssm = small()
    projected, noise = torch.randn(1, 6, 8), torch.randn(1, 6, 3, 4)
    first = torch.tensor([[1.0, 0, 0, 1, 0, 0]])
    with torch.no_grad():
        action = torch.randn(1, 6, 2)
        whole = rssm.observe(projected, action, first, noise)
        changed = action.clone()
        # everything before the second episode, and the action that "led" to its first step
        changed[:, :4] += 5.0
        other = rssm.observe(projected + 0, changed, first, noise)
        rest = rssm.observe(projected[:, 3:], action[:, 3:], first[:, 3:], noise[:, 3:])
    assert not torch.equal(whole.latent.h[:, 1], other.latent.h[:, 1])
    assert torch.equal(whole.latent.h[:, 3:], other.latent.h[:, 3:])
    torch.testing.assert_close(whole.latent.h[:, 3:], rest.latent.h)


def test_the_recurrence_reads_the_action_at_every_scale():
    model = RSSM(
        action=2,
        embed=6,
        deter=8,
        hidden=8,
        variables=3,
        classes=4,
        unimix=0.01,
        action_scales=(1.0, 0.1),
    )
    action = torch.tensor([[0.5, -0.05], [1.0, -0.2]])
    torch.testing.assert_close(
        model.scaled(action), torch.tensor([[0.5, -0.05, 1.0, -0.5], [1.0, -0.2, 1.0, -1.0]])
    )
    assert (model.scaled(-action) == -model.scaled(action)).all(), (
        "a mirror turns the action over, and so what is read of it"
    )


# A whole sequence and its hand-written way back are the steps that they stand for.


B, T, A, S, C, D, H = 5, 6, 2, 3, 4, 12, 10


@pytest.fixture
def rssm() -> RSSM:
    torch.manual_seed(0)
    made = RSSM(
        action=A,
        embed=20,
        deter=D,
        hidden=H,
        variables=S,
        classes=C,
        unimix=0.01,
        action_scales=(1.0, 0.3),
    ).double()
    for parameter in made.parameters():  # scales of 1 and shifts of 0 would hide a wrong gradient
        parameter.data += 0.1 * torch.randn_like(parameter)
    return made


def draws(*shape: int) -> Tensor:
    return torch.randn(shape, dtype=torch.double)


def gradients(outputs: tuple[Tensor, ...], inputs: list[Tensor]) -> list[Tensor]:
    torch.manual_seed(1)
    total = torch.stack([(output * draws(*output.shape)).sum() for output in outputs]).sum()
    return list(torch.autograd.grad(total, inputs))


def start() -> Latent:
    z = torch.nn.functional.one_hot(torch.randint(C, (B, S)), C).double().flatten(1)
    return Latent(draws(B, D).requires_grad_(True), z.requires_grad_(True))


def trained(rssm: RSSM, *without: str) -> list[Tensor]:
    return [value for name, value in rssm.named_parameters() if not name.startswith(without)]


def mixed(rssm: RSSM, logits: Tensor) -> Tensor:
    return ((1 - rssm.unimix) * logits.unflatten(-1, (S, C)).softmax(-1) + rssm.unimix / C).log()


def test_filtering_is_its_steps(rssm):
    begin, projected, action = start(), draws(B, T, H).requires_grad_(True), draws(B, T, A)
    first, noise = (torch.rand(B, T) < 0.3).double(), draws(B, T, S, C)
    assert first[:, 1:].any()
    assert not first.all()
    latent, hs, zs, logs = begin, [], [], []
    for t in range(T):
        keep = 1.0 - first[:, t, None]
        h = rssm.recur(Latent(latent.h * keep, latent.z * keep), action[:, t] * keep)
        logs.append(mixed(rssm, rssm.posterior_net(rssm.posterior_h(h) + projected[:, t])))
        latent = Latent(h, rssm.sample(logs[-1], noise[:, t]))
        hs.append(h)
        zs.append(latent.z)
    steps = tuple(torch.stack(each, 1) for each in (hs, zs, logs))
    seen = rssm.observe(projected, action, first, noise, begin)
    whole = (seen.latent.h, seen.latent.z, seen.posterior)
    inputs = [projected, *begin, *trained(rssm, "prior_net", "posterior_o")]
    torch.testing.assert_close(whole, steps, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(
        gradients(whole, inputs), gradients(steps, inputs), rtol=1e-9, atol=1e-9
    )


def test_imagining_is_its_steps(rssm):
    begin, action, noise = start(), draws(B, T, A), draws(T, B, S * C)
    latent, hs, zs = begin, [], []
    for t in range(T):
        h = rssm.recur(latent, action[:, t])
        latent = Latent(
            h, rssm.sample(mixed(rssm, rssm.prior_net(h)), noise[t].unflatten(-1, (S, C)))
        )
        hs.append(h)
        zs.append(latent.z)
    steps = torch.stack(hs, 1), torch.stack(zs, 1)
    whole = rssm.imagine(begin, action, noise)
    inputs = [*begin, *trained(rssm, "posterior")]
    torch.testing.assert_close(tuple(whole), steps, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(
        gradients(tuple(whole), inputs), gradients(steps, inputs), rtol=1e-9, atol=1e-9
    )


def test_half_precision_around_it_does_not_reach_it(rssm):
    single, begin = rssm.float(), Latent(*(value.detach().float() for value in start()))
    action, noise = draws(B, T, A).float(), draws(T, B, S * C).float()
    expected = single.imagine(begin, action, noise)
    with torch.autocast("cpu", torch.bfloat16):
        found = single.imagine(begin, action, noise)
    assert found.h.dtype == torch.float32
    # the action's layer alone is rounded
    torch.testing.assert_close(found.h, expected.h, rtol=0.05, atol=0.05)
