from __future__ import annotations

import re
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
import torch

import wasp_cli
from wasp_cli.cli import doctor
from wasp_cli.cli.doctor import ON_DEVICE, PLUGINS, Finding, examine, require
from wasp_cli.errors import WaspError
from wasp_cli.learning.device import VARIABLE


def gpu(tmp_path: Path) -> Finding:
    return next(finding for finding in examine(tmp_path) if finding.what == "GPU")


def test_the_stages_that_doctor_names_are_those_that_ask_for_a_device() -> None:
    root = Path(wasp_cli.__file__).parent
    askers = {path.relative_to(root).as_posix() for path in root.rglob("*.py") if "training_device()" in path.read_text()}
    assert askers - {"learning/device.py", "cli/doctor.py"} == {f"stages/{kind}.py" for kind in ON_DEVICE}


def test_a_gpu_is_used_unless_the_variable_says_otherwise(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda _: "NVIDIA Something")
    used = gpu(tmp_path)
    assert (used.state, used.found) == ("ok", "NVIDIA Something")
    assert "world_model, latents, evaluate compute on cuda" in used.meaning
    assert "not used" not in used.meaning
    monkeypatch.setenv(VARIABLE, "cpu")
    assert "every stage computes on the CPU (WASP_DEVICE=cpu)" in gpu(tmp_path).meaning


def test_a_machine_without_a_gpu_needs_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert gpu(tmp_path).state == "optional"


def test_a_device_that_training_would_not_find_is_said_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "cuda:99")
    found = gpu(tmp_path)
    assert found.state == "missing"
    assert "unset WASP_DEVICE" in found.meaning
    with pytest.raises(WaspError, match="GPU"):
        require([found])


def test_plugins_are_listed_and_a_broken_one_is_named_without_stopping_the_rest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    points = {
        "wasp.methods": [EntryPoint("careful", "wasp_cli.methods.registry:METHODS", "wasp.methods")],
        "wasp.operators": [EntryPoint("gone", "no_such_package:thing", "wasp.operators")],
    }
    monkeypatch.setattr(doctor, "entry_points", lambda group: points.get(group, []))
    found = {finding.what: finding for finding in examine(tmp_path) if finding.what.startswith("plugin")}
    assert found["plugin careful (method)"].state == "ok"
    broken = found["plugin gone (operator)"]
    assert (broken.state, broken.meaning) == ("broken", "repair or uninstall it")
    assert "ModuleNotFoundError" in broken.found
    with pytest.raises(WaspError, match="plugin gone"):
        require([*found.values()])


def test_every_group_of_plugins_is_looked_at() -> None:
    root = Path(wasp_cli.__file__).parent
    groups = {group for path in root.glob("*/registry.py") for group in re.findall(r'^    "(wasp\.\w+)",$', path.read_text(), re.MULTILINE)}
    assert groups == {*PLUGINS}
