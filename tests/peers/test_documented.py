"""The lines of use in docs/tasks.md do what they say."""

import re
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import pytest
from minari import DataCollector
from skrl.envs.wrappers.torch import wrap_env
from stable_baselines3 import PPO
from torchrl.envs import GymEnv

from tests.peers import IDS
from wasp_cli.tasks.gym import upstream

DOCS = Path(__file__).parents[2] / "docs/tasks.md"
ROWS = re.findall(
    r"^\| (\S+) (\d[\d.]+) \| .* \| `([^`]+)`[^|]*\|$", DOCS.read_text(), re.MULTILINE
)
KNOWN: dict[str, Any] = {
    "gymnasium": gymnasium,
    "PPO": PPO,
    "GymEnv": GymEnv,
    "DataCollector": DataCollector,
    "wrap_env": wrap_env,
    "sys": sys,
    "SimpleNamespace": SimpleNamespace,
    "upstream": upstream,
    "id": IDS[0],
}


def test_there_is_one_for_every_package():
    assert [name for name, *_ in ROWS] == [
        "gymnasium",
        "stable-baselines3",
        "TorchRL",
        "Minari",
        "skrl",
        "OmniSafe",
    ]


@pytest.mark.parametrize(("name", "version", "line"), ROWS, ids=[name for name, *_ in ROWS])
def test_a_line_of_use_works(name, version, line, tmp_path, monkeypatch):
    from importlib.metadata import version as installed

    assert installed(name) == version
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    monkeypatch.setitem(sys.modules, "safety_gymnasium", None)
    exec(line, dict(KNOWN))
    if name == "OmniSafe":
        assert (
            len(
                sys.modules["safety_gymnasium"]
                .make("SafetyPointGoal1-v0", autoreset=True)
                .reset(seed=0)
            )
            == 2
        )
