import pytest
import torch

from wasp_cli.models.base import Latent
from wasp_cli.models.critics import LatentCritics, TwoHot


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
        [[[1.0, 0, 0, 0, 0], [0, 0, 1, 0, 0], [0, 0, 0, 0.75, 0.25]], [[0, 0, 0, 1, 0], [0, 0, 0, 0, 1], [0, 0, 0, 0, 1]]]
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
