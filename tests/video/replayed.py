"""A results folder with one cell of tiny models, as runs leave it."""

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tests.artifacts import tiny_artifacts
from tests.cells import REPEAT, evaluated
from wasp_cli.methods.registry import METHODS
from wasp_cli.registry import load_target
from wasp_cli.store.artifact import commit, staging_folder
from wasp_cli.store.layout import Layout

KEYS = {
    "world_model": "aaaa1111aaaa1111aaaa",
    "policies": "bbbb2222bbbb2222bbbb",
    "calibration": "cccc3333cccc3333cccc",
}
CELL = "dddd4444dddd4444dddd"
EAGER = {
    "horizon": 4,
    "residual_steps": 2,
    "candidates": 12,
    "elites": 4,
    "feasible": 4,
    "iterations": 1,
    "rollouts": 1,
    "tau_c": 1.2,
    "tau_r": 0.0,
}
"""WASP that intervenes although nothing is trained."""
TAU_R, WINDOW = 0.25, 5


def made_store(
    root: Path,
    method: str = "wasp",
    config: Mapping[str, Any] = EAGER,
    episodes: int = 2,
    task: str = "race1",
) -> Path:
    """Artifacts and the cell of a method, published below `root`; returns the results folder."""
    inputs = tiny_artifacts(root / "artifacts")
    known = json.loads((inputs["calibration"] / "calibration.json").read_text())
    (inputs["calibration"] / "calibration.json").write_text(json.dumps(known | {"tau_R": TAU_R}))
    layout = Layout(root / "results")
    layout.prepare()
    for kind, key in KEYS.items():
        staging = staging_folder(layout, key)
        shutil.copytree(inputs[kind], staging, dirs_exist_ok=True)
        commit(
            layout,
            kind,
            key,
            staging,
            {"kind": kind, "key": key, "label": f"{task} s0 {kind}", "config": {"window": WINDOW}},
        )
    staging = staging_folder(layout, CELL)
    evaluated(inputs, staging, method, config, task=task, episodes=episodes)
    resolved = load_target(METHODS[method].config).model_validate(config).model_dump(mode="json")
    manifest = {
        "kind": "evaluate",
        "key": CELL,
        "label": f"{task} s0 {method} noisy=0.4",
        "task": task,
        "seed": 0,
        "axes": {"method": method, "method_config": resolved, "operator": "noisy", "value": 0.4},
        "settings": {"action_repeat": REPEAT, "returns": {"gamma_c": 0.95}},
        "upstream": KEYS,
        "upstream_kinds": {kind: kind for kind in KEYS},
        "provenance": {"threads": 2},
    }
    commit(layout, "evaluate", CELL, staging, manifest)
    return layout.root
