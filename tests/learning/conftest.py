"""Tiny untrained models, held-out episodes, and a cell that an assistant was evaluated in with them."""

import pytest

from tests.cells import SETTINGS, Evaluated, evaluated
from wasp_cli.learning.configs import HeldoutConfig
from wasp_cli.stages.base import Job
from wasp_cli.stages.heldout import HeldoutStage


@pytest.fixture(scope="session")
def inputs(artifacts, tmp_path_factory):
    folder = tmp_path_factory.mktemp("heldout")
    HeldoutStage().run(Job("heldout", "race1", 0, HeldoutConfig(episodes=2), SETTINGS, {}, artifacts, folder, folder))
    return artifacts | {"heldout": folder}


@pytest.fixture(scope="session")
def cell(inputs, tmp_path_factory) -> Evaluated:
    """IDA takes over wherever more of its ensemble are for it than against it."""
    return evaluated(inputs, tmp_path_factory.mktemp("cell"), "ida", {"vote": 0.0})
