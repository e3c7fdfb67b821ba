import pytest
import torch

from wasp_cli.errors import UsageError
from wasp_cli.learning.configs import WorldModelConfig
from wasp_cli.learning.device import VARIABLE, training_device
from wasp_cli.learning.world_model import build, loss_weights
from wasp_cli.models.world_model import Ahead, Batch

SMALL = WorldModelConfig(
    deter=32,
    hidden=32,
    variables=4,
    classes=4,
    depth=4,
    head=32,
    ahead_starts=6,
    ahead_images=4,
    ahead_horizon=3,
)


def test_the_device_is_what_the_variable_names(monkeypatch):
    monkeypatch.setenv(VARIABLE, "cpu")
    assert training_device() == torch.device("cpu")
    monkeypatch.delenv(VARIABLE)
    assert training_device().type == ("cuda" if torch.cuda.is_available() else "cpu")


@pytest.mark.parametrize("name", ["gpu", "cuda:99", "meta:x"])
def test_a_device_that_is_not_there_is_an_error_with_a_way_out(name, monkeypatch):
    monkeypatch.setenv(VARIABLE, name)
    with pytest.raises(UsageError, match=f"WASP_DEVICE={name}") as caught:
        training_device()
    assert "unset WASP_DEVICE" in str(caught.value.hint)


def test_losses_in_bfloat16_are_float32_sums_close_to_those_in_float32():
    """What a GPU computes in; a CPU can do the same slowly, so the code path is the same."""
    torch.manual_seed(0)
    model = build(SMALL, 2)
    source = torch.Generator().manual_seed(1)
    flags = torch.zeros(3, 8)
    pixels = torch.randint(0, 256, (3, 8, 6, 64, 64), generator=source, dtype=torch.uint8)
    cost = (torch.rand(3, 8, generator=source) < 0.3).float()
    batch = Batch(
        pixels,
        torch.randn(3, 8, 2, generator=source),
        torch.randn(3, 8, generator=source),
        cost,
        flags,
        flags,
    )
    noise = torch.randn(3, 8, 4, 4, generator=source)
    shown = torch.randint(0, 256, (4, 6, 64, 64), generator=source, dtype=torch.uint8)
    events, within = (torch.rand(6, 3, generator=source) < 0.3).float(), torch.ones(6, 3)
    later = (
        torch.randn(6, 3, 2, generator=source),
        torch.randn(6, 3, generator=source),
        events,
        within,
    )
    draws = torch.randn(3, 6, 16, generator=source)
    ahead = Ahead(
        torch.tensor([0, 1, 2, 0, 1, 2]),
        torch.tensor([0, 1, 2, 3, 4, 7]),
        *later,
        torch.tensor([0, 1, 2, 0]),
        shown,
        draws,
    )
    found = []
    for mixed in (False, True):
        model.zero_grad()
        with torch.autocast("cpu", torch.bfloat16, enabled=mixed):
            losses, latent = model.losses(batch, noise, torch.arange(0, 8, 2), 0.0, ahead=ahead)
        # that head is beside the model
        assert losses.keys() == loss_weights(SMALL).keys() - {"privileged"}
        assert all(loss.dtype == torch.float32 for loss in losses.values())
        assert latent.z.dtype == torch.float32
        torch.stack(list(losses.values())).sum().backward()
        assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in model.parameters())
        found.append({name: float(loss.detach()) for name, loss in losses.items()})
    for name, value in found[0].items():
        assert found[1][name] == pytest.approx(value, rel=0.1), name
    assert found[0] != found[1], "bfloat16 was not used"
