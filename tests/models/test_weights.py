import pytest
import torch

from wasp_cli.errors import ArtifactError
from wasp_cli.models.critics import LatentCritics
from wasp_cli.models.weights import load_weights, read_arguments, save_weights


def test_weights_and_arguments_come_back(tmp_path):
    path = tmp_path / "critics.safetensors"
    critics = LatentCritics(4, (8,))
    save_weights(critics, path, features=4, hidden=[8])
    again = LatentCritics(**read_arguments(path))
    load_weights(again, path)
    assert all(torch.equal(a, b) for a, b in zip(critics.state_dict().values(), again.state_dict().values(), strict=True))
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
        load_weights(LatentCritics(**read_arguments(path)) if damage != "other shape" else LatentCritics(5, (8,)), path)
