"""From artifacts to an assistant. Where an operating point was chosen for it, and is among its
inputs, it is built there.
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

OPERATING = "operating"  # the stage that chooses operating points
POINT_FILE = "operating_point.json"  # in its artifact


def load_parts(
    inputs: Mapping[str, Path],
    returns: ReturnsConfig,
    device: torch.device | None = None,
    *,
    motors: Motors = UNKNOWN,
) -> Parts:
    """Load the frozen models of a training chain, and its calibrated thresholds if there are any.

    Args:
        inputs: artifact folders by stage kind.
        returns: discounts and lambda.
        device: where the models compute; None is the CPU.
        motors: of the task.
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

    Where the stage `operating` is among the inputs of `parts`, the assistant is built at the point
    that was chosen there. If it should be silent, the commands are executed as they are.

    Args:
        method: its name.
        resolved: its configuration in JSON form.
        parts: the models.
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
    """Return in words the operating point at which `build_assistant` builds an assistant: `silent`,
    `as it is`, or the value of its knob. None where no point was chosen.
    """
    point = _operating_point(method, parts)
    if point is None:
        return None
    return words_of(point["silent"], point["knob"], point["value"])


def words_of(silent: bool, knob: Mapping[str, Any] | None, value: float | None) -> str:
    """Return an operating point in a few words."""
    if silent:
        return "silent"
    if not knob:
        return "as it is"
    return f"{knob['symbol']} {value:g}"


def _operating_point(method: str, parts: Parts) -> Mapping[str, Any] | None:
    """Return the point among the inputs; None without one, and where it is that of another method:
    somebody who practises for a session drives without the assistant of these inputs.
    """
    if OPERATING not in parts.inputs:
        return None
    text = (parts.inputs[OPERATING] / POINT_FILE).read_text()
    point: Mapping[str, Any] = json.loads(text)
    if point["method"] != method:
        return None
    return point


def build_turned(
    method: str, resolved: Mapping[str, Any], parts: Parts, knob: Mapping[str, Any], value: float
) -> Assistant:
    """Build an assistant with its knob at a value.

    Args:
        method: its name.
        resolved: its configuration in JSON form.
        parts: the models and thresholds.
        knob: what it `turns` and the `name` of that, as in `methods.registry.Knob`.
        value: of the knob.

    Raises:
        ValueError: the knob turns something unknown.
    """
    turns = knob["turns"]
    name = knob["name"]
    if turns == "setting":
        return _built(method, {**resolved, name: value}, parts)
    if turns == "correction":
        return Scaled(_built(method, resolved, parts), value)
    thresholds = dict(parts.thresholds)
    if turns == "threshold":
        thresholds[name] *= value
    elif turns == "margin":
        thresholds[name] = max(0.0, thresholds["margin_p95"]) * value
    else:
        raise ValueError(f"a knob cannot turn '{turns}'")
    return _built(method, resolved, replace(parts, thresholds=thresholds))


def _built(method: str, resolved: Mapping[str, Any], parts: Parts) -> Assistant:
    cls: AssistantClass = METHODS.load(method)
    return cls(method_config(method, resolved), parts)
