"""What stages store: latents as they were inferred, and weights rounded once, as they ship."""

from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file

from tests.learning.recordings import SOURCES, TINY, recording
from wasp_cli.config import Config
from wasp_cli.errors import TrainingError
from wasp_cli.learning import world_model as training
from wasp_cli.learning.configs import LatentsConfig
from wasp_cli.learning.latents import save_latents
from wasp_cli.learning.rounding import rounded
from wasp_cli.learning.shards import write_shard
from wasp_cli.models.weights import load_weights, save_weights
from wasp_cli.stages.base import Job
from wasp_cli.stages.latents import LatentsStage
from wasp_cli.stages.world_model import WorldModelStage
from wasp_cli.store.slim import Slimming, slim


@pytest.fixture(scope="module")
def inputs(tmp_path_factory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("chain")
    folders = {name: root / name for name in ("dataset", "world_model", "latents", "work")}
    for folder in folders.values():
        folder.mkdir()
    write_shard(folders["dataset"] / "shard-0000.parquet", recording(), SOURCES)
    return folders


def job(kind: str, config: Config, inputs: dict[str, Path]) -> Job:
    needed = {name: inputs[name] for name in ("dataset", "world_model") if name != kind}
    return Job(kind, "goal1", 0, config, {"action_repeat": 4}, {}, needed, inputs[kind], inputs["work"])


def test_the_stored_latents_are_those_that_the_heads_were_refitted_on_but_for_the_rounding_of_weights(inputs, monkeypatch):
    met: list[Any] = []

    def refit(model: Any, rows: Any, latents: Any, *rest: Any) -> None:
        met.append(latents)
        refit_heads(model, rows, latents, *rest)

    refit_heads = training.refit_heads
    monkeypatch.setattr(training, "refit_heads", refit)
    WorldModelStage().run(job("world_model", TINY, inputs))
    assert not list(inputs["world_model"].glob("latents*"))
    shown = LatentsStage().run(job("latents", LatentsConfig(), inputs))
    assert shown["rows"] == 36
    save_latents(met[0], inputs["work"])
    before, after = (load_file(inputs[name] / "latents.safetensors") for name in ("work", "latents"))
    assert before.keys() == after.keys() == {"h", "z", "classes"}
    torch.testing.assert_close(before["h"], after["h"], atol=5e-3, rtol=0.0)
    assert float((before["z"] == after["z"]).float().mean()) > 0.98
    assert after["h"].dtype == torch.float16


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
