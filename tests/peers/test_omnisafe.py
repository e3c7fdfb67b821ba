"""OmniSafe: PPO-Lag through the six values.

OmniSafe makes its environments with `safety_gymnasium.make`. That package wants gymnasium 0.28.1
and MuJoCo 2.3.3: `upstream` stands in.
"""

import csv
import importlib
import sys
from types import SimpleNamespace
from typing import Any

from wasp_cli.tasks.gym import upstream


def make(id: str, autoreset: bool, **options: Any) -> Any:
    """Make an environment; OmniSafe asks for one that restarts by itself, and then restarts it
    itself too.
    """
    assert autoreset
    return upstream(id, **options)


def test_ppo_lag_trains(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "safety_gymnasium", SimpleNamespace(make=make))
    omnisafe = importlib.import_module("omnisafe")
    settings = {
        "train_cfgs": {
            "total_steps": 4000,
            "vector_env_nums": 1,
            "parallel": 1,
            "torch_threads": 1,
        },
        "algo_cfgs": {"steps_per_epoch": 2000, "update_iters": 2},
        "logger_cfgs": {"use_wandb": False, "use_tensorboard": False, "log_dir": str(tmp_path)},
        "lagrange_cfgs": {"cost_limit": 25.0},
    }
    omnisafe.Agent("PPOLag", "SafetyPointGoal1-v0", custom_cfgs=settings).learn()
    (log,) = tmp_path.rglob("progress.csv")
    with log.open() as file:
        epochs = list(csv.DictReader(file))
    assert len(epochs) == 2
    assert {float(epoch["Metrics/EpLen"]) for epoch in epochs} == {1000.0}
    assert min(float(epoch["Metrics/EpCost"]) for epoch in epochs) > 25.0
    # The costs that came through exceed the limit, so the multiplier rises.
    multipliers = [float(epoch["Metrics/LagrangeMultiplier"]) for epoch in epochs]
    assert multipliers == sorted(set(multipliers))
