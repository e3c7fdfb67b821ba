"""From artifacts to an assistant: at the operating point that was chosen for it, where there is one
among its inputs.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from wasp_cli.config import Config
from wasp_cli.learning.configs.shared import ReturnsConfig
from wasp_cli.methods.base import Assistant, AssistantClass, Parts
from wasp_cli.methods.human import HumanOnly
from wasp_cli.methods.registry import METHODS
from wasp_cli.methods.scaled import Scaled
from wasp_cli.models.policy import load_skills
from wasp_cli.models.world_model import load_world_model
from wasp_cli.tasks.motors import UNKNOWN, Motors

OPERATING = "operating"  # the stage
POINT_FILE = "operating_point.json"  # what it leaves


def load_parts(
    inputs: Mapping[str, Path],
    returns: ReturnsConfig,
    device: torch.device | None = None,
    *,
    motors: Motors = UNKNOWN,
) -> Parts:
    """Load the frozen models of a training chain to a device (the CPU), and the calibrated
    thresholds where there are any.
    """
    thresholds: dict[str, float] = {}
    if "calibration" in inputs:
        thresholds = json.loads((inputs["calibration"] / "calibration.json").read_text())
    return Parts(
        load_world_model(inputs["world_model"]).to(device),
        load_skills(inputs["policies"]).to(device),
        inputs,
        thresholds,
        returns.gamma_r,
        returns.gamma_c,
        returns.lam,
        motors,
    )


def method_config(method: str, resolved: Mapping[str, Any]) -> Config:
    """Return the validated configuration of a method from its resolved JSON form."""
    return METHODS[method].config_model().model_validate(resolved)


def build_assistant(method: str, resolved: Mapping[str, Any], parts: Parts) -> Assistant:
    """Build an assistant by its registered name.

    Where the stage `operating` is among the inputs of `parts`, it is built at the point that was
    chosen there; a silent one executes the commands as they are.
    """
    point = _operating_point(method, parts)
    if point is None:
        return _built(method, resolved, parts)
    if point["silent"]:
        return HumanOnly()
    if point["knob"] is None:
        return _built(method, resolved, parts)
    return build_turned(method, resolved, parts, point["knob"], point["value"])


def operating_words(method: str, parts: Parts) -> str | None:
    """Say at which operating point `build_assistant` builds an assistant: `silent`, `as it is`, or
    the value of its knob; None where none was chosen.
    """
    point = _operating_point(method, parts)
    if point is None:
        return None
    return words_of(point["silent"], point["knob"], point["value"])


def words_of(silent: bool, knob: Mapping[str, Any] | None, value: float | None) -> str:
    """Say an operating point in a few words."""
    if silent:
        return "silent"
    return "as it is" if not knob else f"{knob['symbol']} {value:g}"


def _operating_point(method: str, parts: Parts) -> Mapping[str, Any] | None:
    if OPERATING not in parts.inputs:
        return None
    text = (parts.inputs[OPERATING] / POINT_FILE).read_text()
    point: Mapping[str, Any] = json.loads(text)
    # Who practises for a session drives without the assistant of these inputs.
    return point if point["method"] == method else None


def build_turned(
    method: str, resolved: Mapping[str, Any], parts: Parts, knob: Mapping[str, Any], value: float
) -> Assistant:
    """Build an assistant with its knob at a value.

    Args:
        knob: what it `turns` and the `name` of that, as in `methods.registry.Knob`.
    """
    turns = knob["turns"]
    name = knob["name"]
    known = dict(parts.thresholds)
    if turns == "setting":
        return _built(method, {**resolved, name: value}, parts)
    if turns == "correction":
        return Scaled(_built(method, resolved, parts), value)
    if turns == "threshold":
        known[name] *= value
    elif turns == "margin":
        known[name] = max(0.0, known["margin_p95"]) * value
    else:
        raise ValueError(f"'{turns}' is nothing that a knob turns")
    return _built(method, resolved, replace(parts, thresholds=known))


def _built(method: str, resolved: Mapping[str, Any], parts: Parts) -> Assistant:
    cls: AssistantClass = METHODS.load(method)
    return cls(method_config(method, resolved), parts)
