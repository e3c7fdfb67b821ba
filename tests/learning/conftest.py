"""Tiny untrained models, held-out episodes, and a cell that an assistant was evaluated in with
them.
"""

import pytest

from tests.cells import SETTINGS, Evaluated, evaluated, short_episodes
from wasp_cli.learning.configs import HeldoutConfig
from wasp_cli.stages.base import Job
from wasp_cli.stages.heldout import HeldoutStage


@pytest.fixture(scope="module", autouse=True)
def short():
    with short_episodes():
        yield


@pytest.fixture(scope="session")
def inputs(artifacts, tmp_path_factory):
    folder = tmp_path_factory.mktemp("heldout")
    with short_episodes():
        HeldoutStage().run(
            Job(
                "heldout",
                "race1",
                0,
                HeldoutConfig(episodes=2),
                SETTINGS,
                {},
                artifacts,
                folder,
                folder,
            )
        )
    return artifacts | {"heldout": folder}


@pytest.fixture(scope="session")
def cell(inputs, tmp_path_factory) -> Evaluated:
    """IDA takes over wherever more of its ensemble are for it than against it."""
    with short_episodes():
        return evaluated(inputs, tmp_path_factory.mktemp("cell"), "ida", {"vote": 0.0})


@pytest.fixture(scope="session")
def root(tmp_path_factory):
    """An untrained expert, and a small dataset in `whole`; tests add folders."""
    from tests.learning.test_dataset import collected

    with short_episodes():
        return collected(tmp_path_factory.mktemp("dataset"))


@pytest.fixture(scope="session")
def chain(root):
    """A tiny untrained world model of that dataset, and its latents."""
    import torch

    from wasp_cli.learning.configs import WorldModelConfig
    from wasp_cli.learning.encoding import encode
    from wasp_cli.learning.latents import save_latents
    from wasp_cli.learning.shards import read_shards
    from wasp_cli.learning.world_model import build
    from wasp_cli.models.world_model import save_world_model
    from wasp_cli.stages.base import no_progress

    torch.manual_seed(1)
    folders = {
        "expert": root / "expert",
        "dataset": root / "whole",
        "world_model": root / "model",
        "latents": root / "latents",
    }
    for name in ("world_model", "latents"):
        folders[name].mkdir()
    model = build(
        WorldModelConfig(deter=16, hidden=16, variables=3, classes=4, depth=2, head=16), 2
    )
    save_world_model(model, folders["world_model"])
    save_latents(encode(model, read_shards(folders["dataset"]), no_progress), folders["latents"])
    return folders
