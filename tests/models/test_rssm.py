import math

import pytest
import torch

from wasp_cli.models.rssm import RSSM, balanced_kl, kl_divergence


def small() -> RSSM:
    torch.manual_seed(0)
    return RSSM(action=2, embed=6, deter=8, hidden=8, variables=3, classes=4, unimix=0.01)


def logs(*rows: tuple[float, ...]) -> torch.Tensor:
    return torch.tensor(rows, dtype=torch.float64).log()


def test_kl_is_the_sum_over_variables_by_hand():
    q, p = logs((0.5, 0.5), (0.9, 0.1)), logs((0.25, 0.75), (0.5, 0.5))
    by_hand = 0.5 * math.log(2) + 0.5 * math.log(0.5 / 0.75) + 0.9 * math.log(1.8) + 0.1 * math.log(0.2)
    assert kl_divergence(q, p).item() == pytest.approx(by_hand)
    assert kl_divergence(q, q).item() == pytest.approx(0.0, abs=1e-12)


def test_free_nats_clip_every_step_by_itself_by_hand():
    """Two steps, one variable: the one below a free nat counts as 1, the one above as it is, alone in the gradient."""
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
    # d/d log q_i is q_i (log q_i - log p_i + 1); a tenth of it is the weight of the representation term.
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
    torch.testing.assert_close(drawn.mean((0, 1)), torch.tensor([0.7, 0.1, 0.1, 0.1]), atol=0.01, rtol=0)
    assert (mode[..., 0] == 1).all()


def test_an_episode_start_masks_h_z_and_the_action():
    rssm = small()
    projected, noise = torch.randn(1, 6, 8), torch.randn(1, 6, 3, 4)
    first = torch.tensor([[1.0, 0, 0, 1, 0, 0]])
    with torch.no_grad():
        action = torch.randn(1, 6, 2)
        whole = rssm.observe(projected, action, first, noise)
        changed = action.clone()
        changed[:, :4] += 5.0  # everything before the second episode, and the action that "led" to its first step
        other = rssm.observe(projected + 0, changed, first, noise)
        rest = rssm.observe(projected[:, 3:], action[:, 3:], first[:, 3:], noise[:, 3:])
    assert not torch.equal(whole.latent.h[:, 1], other.latent.h[:, 1])
    assert torch.equal(whole.latent.h[:, 3:], other.latent.h[:, 3:])
    torch.testing.assert_close(whole.latent.h[:, 3:], rest.latent.h)


def test_the_recurrence_reads_the_action_at_every_scale():
    model = RSSM(action=2, embed=6, deter=8, hidden=8, variables=3, classes=4, unimix=0.01, action_scales=(1.0, 0.1))
    action = torch.tensor([[0.5, -0.05], [1.0, -0.2]])
    torch.testing.assert_close(model.scaled(action), torch.tensor([[0.5, -0.05, 1.0, -0.5], [1.0, -0.2, 1.0, -1.0]]))
    assert (model.scaled(-action) == -model.scaled(action)).all(), "a mirror turns the action over, and so what is read of it"
