"""A whole sequence and its hand-written way back are the steps that they stand for."""

import pytest
import torch
from torch import Tensor

from wasp_cli.models.base import Latent
from wasp_cli.models.rssm import RSSM

B, T, A, S, C, D, H = 5, 6, 2, 3, 4, 12, 10


@pytest.fixture
def rssm() -> RSSM:
    torch.manual_seed(0)
    made = RSSM(action=A, embed=20, deter=D, hidden=H, variables=S, classes=C, unimix=0.01, action_scales=(1.0, 0.3)).double()
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
    torch.testing.assert_close(gradients(whole, inputs), gradients(steps, inputs), rtol=1e-9, atol=1e-9)


def test_imagining_is_its_steps(rssm):
    begin, action, noise = start(), draws(B, T, A), draws(T, B, S * C)
    latent, hs, zs = begin, [], []
    for t in range(T):
        h = rssm.recur(latent, action[:, t])
        latent = Latent(h, rssm.sample(mixed(rssm, rssm.prior_net(h)), noise[t].unflatten(-1, (S, C))))
        hs.append(h)
        zs.append(latent.z)
    steps = torch.stack(hs, 1), torch.stack(zs, 1)
    whole = rssm.imagine(begin, action, noise)
    inputs = [*begin, *trained(rssm, "posterior")]
    torch.testing.assert_close(tuple(whole), steps, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(gradients(tuple(whole), inputs), gradients(steps, inputs), rtol=1e-9, atol=1e-9)


def test_half_precision_around_it_does_not_reach_it(rssm):
    single, begin = rssm.float(), Latent(*(value.detach().float() for value in start()))
    action, noise = draws(B, T, A).float(), draws(T, B, S * C).float()
    expected = single.imagine(begin, action, noise)
    with torch.autocast("cpu", torch.bfloat16):
        found = single.imagine(begin, action, noise)
    assert found.h.dtype == torch.float32
    torch.testing.assert_close(found.h, expected.h, rtol=0.05, atol=0.05)  # the action's layer alone is rounded
