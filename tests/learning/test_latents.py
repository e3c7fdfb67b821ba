"""What the world model infers at every recorded row: the same before and after it was stored, and whoever asks."""

from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file

from tests.learning.recordings import SOURCES, TINY, recording
from wasp_cli.config import Config
from wasp_cli.learning import world_model as training
from wasp_cli.learning.configs import LatentsConfig
from wasp_cli.learning.latents import save_latents
from wasp_cli.learning.shards import write_shard
from wasp_cli.stages.base import Job
from wasp_cli.stages.latents import LatentsStage
from wasp_cli.stages.world_model import WorldModelStage


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
