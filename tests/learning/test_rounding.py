"""Weights as they ship: rounded once, by the stage that trained them."""

import pytest
import torch

from wasp_cli.errors import TrainingError
from wasp_cli.learning.rounding import rounded
from wasp_cli.models.weights import load_weights, save_weights
from wasp_cli.store.slim import Slimming, slim


def test_what_is_stored_what_is_measured_and_what_ships_are_the_same_numbers(tmp_path):
    trained = torch.nn.Sequential(torch.nn.Linear(7, 5), torch.nn.BatchNorm1d(5))
    before = {name: value.clone() for name, value in trained.state_dict().items()}
    save_weights(rounded(trained), tmp_path / "m.safetensors")
    again = torch.nn.Sequential(torch.nn.Linear(7, 5), torch.nn.BatchNorm1d(5))
    load_weights(again, tmp_path / "m.safetensors")
    for name, value in again.state_dict().items():
        assert torch.equal(value, trained.state_dict()[name])
        assert value.dtype == before[name].dtype
        if value.is_floating_point():
            assert torch.equal(value, before[name].half().float())
    assert not torch.equal(again.state_dict()["0.weight"], before["0.weight"])
    assert slim(tmp_path, "critics", Slimming(half=True)) == {}  # publishing leaves nothing out


@pytest.mark.parametrize("value", [1e6, float("nan")])
def test_a_weight_that_16_bits_cannot_hold_ends_the_training(value):
    module = torch.nn.Linear(2, 2)
    torch.nn.init.constant_(module.bias, value)
    with pytest.raises(TrainingError, match="weight 'bias' does not fit into 16 bits"):
        rounded(module)
    assert torch.equal(module.bias.isnan(), torch.full((2,), value != value))
