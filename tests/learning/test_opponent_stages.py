"""The stages `fallback` and `adversary` on a small invented dataset: what they leave is what their
assistants are built from.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.artifacts import tiny_latents
from tests.learning.recordings import SOURCES, recording
from wasp_cli.learning.assistants import build_assistant, load_parts
from wasp_cli.learning.configs import ReturnsConfig
from wasp_cli.learning.configs.adversary import AdversaryConfig
from wasp_cli.learning.configs.fallback import FallbackConfig
from wasp_cli.learning.heldout import save_heldout
from wasp_cli.learning.latents import Latents, save_latents
from wasp_cli.learning.shards import write_shard
from wasp_cli.methods.base import Heldout
from wasp_cli.operators.base import EpisodeNoise, Operator
from wasp_cli.stages.base import Job
from wasp_cli.stages.registry import STAGES

ROWS = 60


@pytest.fixture
def inputs(artifacts: dict[str, Path], tmp_path: Path) -> dict[str, Path]:
    """Folders of everything that both stages read."""
    folders = {kind: tmp_path / kind for kind in ("dataset", "latents", "heldout")}
    for folder in folders.values():
        folder.mkdir()
    told = recording((6,) * 20)
    write_shard(folders["dataset"] / "shard-0000.parquet", told, SOURCES)
    latent = tiny_latents(len(told.first), 1)
    classes = latent.z.unflatten(-1, (-1, 4)).argmax(-1).to(torch.uint8)
    save_latents(Latents(latent.h, classes, 4), folders["latents"])
    source = torch.Generator().manual_seed(0)
    seen = Heldout(
        latent=tiny_latents(ROWS, 2),
        a_h=2 * torch.rand(ROWS, 2, generator=source) - 1,
        reward=torch.zeros(ROWS),
        cost=(torch.rand(ROWS, generator=source) < 0.2).float(),
        episode=torch.arange(ROWS) // 10,
        terminal=torch.zeros(ROWS),
    )
    save_heldout(seen, folders["heldout"])
    return {**artifacts, **folders}


def run(kind: str, config: Any, inputs: dict[str, Path], out: Path) -> dict[str, Any]:
    out.mkdir()
    stage = STAGES.load(kind)()
    settings = {"returns": ReturnsConfig()} if stage.settings else {}
    read = {needed: inputs[needed] for needed in stage.needs}
    return dict(stage.run(Job(kind, "race1", 3, config, settings, {}, read, out, out)))


@pytest.mark.parametrize(
    ("kind", "config", "method", "settings"),
    [
        ("fallback", FallbackConfig(updates=5, batch=8, hidden=8), "qcbf", {}),
        (
            "adversary",
            AdversaryConfig(updates=3, batch=4, hidden=8, horizon=3),
            "wasp",
            {"adversary": "lucid", "horizon": 4, "residual_steps": 2},
        ),
    ],
)
def test_an_assistant_decides_with_what_its_stage_has_left(
    inputs, tmp_path, kind, config, method, settings
):
    told = run(kind, config, inputs, tmp_path / "first")
    assert all(value is None or torch.isfinite(torch.tensor(value)) for value in told.values())
    again = run(kind, config, inputs, tmp_path / "second")
    assert again == told
    assert json.loads((tmp_path / "first" / "quality.json").read_text())

    parts = load_parts({**inputs, kind: tmp_path / "first"}, ReturnsConfig())
    made = build_assistant(method, settings, parts)
    made.reset(torch.ones(5, dtype=torch.bool), list(range(5)))
    operator = Operator(parts.skills.expert, 2, EpisodeNoise([0] * 5), 5)
    with torch.inference_mode():
        action = made.decide(tiny_latents(5, 0), torch.zeros(5, 2), operator).action
    assert action.isfinite().all()
    assert action.abs().max() <= 1
