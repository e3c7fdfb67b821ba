import re
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
import torch

import wasp_cli
from tests.commands import run_here
from wasp_cli.cli.doctor import ON_DEVICE, Finding, examine, registries, require
from wasp_cli.errors import WaspError
from wasp_cli.learning.device import VARIABLE
from wasp_cli.methods.registry import MethodInfo
from wasp_cli.operators.registry import OperatorInfo
from wasp_cli.run import cores


def gpu(tmp_path: Path) -> Finding:
    return next(finding for finding in examine(tmp_path) if finding.what == "GPU")


def test_the_stages_that_doctor_names_are_those_that_ask_for_a_device() -> None:
    root = Path(wasp_cli.__file__).parent
    askers = {
        path.relative_to(root).as_posix()
        for path in root.rglob("*.py")
        if "training_device()" in path.read_text()
    }
    assert askers - {
        "learning/device.py",
        "cli/doctor.py",
        "drive/session.py",
        "notebook/assistant.py",
    } == {f"stages/{kind}.py" for kind in ON_DEVICE}


def test_it_says_what_is_there_and_creates_nothing(tmp_path: Path) -> None:
    done = run_here("doctor", "--results", tmp_path / "results", columns=200, code=0)
    for word in ("Python", "torch", "mujoco", "cores", "memory", "GPU", "results"):
        assert word in done.stdout
    assert not (tmp_path / "results").exists()
    (tmp_path / "reports").symlink_to(tmp_path)
    assert (
        "reports' is a link"
        in run_here("doctor", "--results", tmp_path, columns=200, code=1).stdout
    )


def test_a_library_that_cannot_begin_is_broken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(name: str) -> None:
        if name == "mujoco":
            raise RuntimeError("invalid value for environment variable MUJOCO_GL")

    monkeypatch.setattr("wasp_cli.cli.doctor.import_module", fails)
    assert (
        "invalid value for environment variable MUJOCO_GL"
        in run_here("doctor", "--results", tmp_path, columns=200, code=1).stdout
    )


@pytest.mark.parametrize(
    "files",
    [
        {"cpu.max": "150000 100000\n", "memory.max": "3000000000\n"},
        {
            "cpu/cpu.cfs_quota_us": "150000\n",
            "cpu/cpu.cfs_period_us": "100000\n",
            "memory/memory.limit_in_bytes": "3000000000\n",
        },
    ],
)
def test_a_container_has_the_cores_and_the_memory_of_its_limits(files, tmp_path, monkeypatch):
    monkeypatch.setattr(cores, "CGROUP", tmp_path)
    monkeypatch.setattr("os.sched_getaffinity", lambda _: range(64), raising=False)
    assert cores.cores() == 64
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    found = {finding.what: finding for finding in examine(tmp_path)}
    assert found["cores"].found.startswith("2 (")
    assert (found["memory"].state, found["memory"].found) == ("low", "3 GB")


def test_a_gpu_is_used_unless_the_variable_says_otherwise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda _: "NVIDIA Something")
    used = gpu(tmp_path)
    assert (used.state, used.found) == ("ok", "NVIDIA Something")
    assert "world_model, latents, severity, operating, evaluate compute on cuda" in used.meaning
    assert "not used" not in used.meaning
    monkeypatch.setenv(VARIABLE, "cpu")
    assert "every stage computes on the CPU (WASP_DEVICE=cpu)" in gpu(tmp_path).meaning


def test_a_device_that_training_would_not_find_is_said_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(VARIABLE, "cuda:99")
    found = gpu(tmp_path)
    assert found.state == "missing"
    assert "unset WASP_DEVICE" in found.meaning
    with pytest.raises(WaspError, match="GPU"):
        require([found])


INFO = "wasp_cli.methods.registry:MethodInfo"


class Odd:
    """What plugins name: one entry that is whole, and others that no command could use."""

    whole = MethodInfo(
        "whole", "Whole", "wasp_cli.methods.human:HumanOnly", "wasp_cli.methods.configs:HumanConfig"
    )
    taken = MethodInfo(
        "wasp", "Mine", "wasp_cli.methods.human:HumanOnly", "wasp_cli.methods.configs:HumanConfig"
    )
    no_class = OperatorInfo(
        "no-class", "None", "wasp_cli.operators.noisy:Nothing", 0.0, 1.0, "nothing"
    )
    study = MethodInfo(
        "study", "Study", "wasp_cli.methods.human:HumanOnly", "wasp_cli.methods.configs:HumanConfig"
    )
    none = OperatorInfo(
        "none", "None", "wasp_cli.operators.noisy:NoisyOperator", 0.0, 1.0, "nothing"
    )
    no_config = MethodInfo("no-config", "None", "wasp_cli.methods.human:HumanOnly", INFO)


@pytest.mark.parametrize(
    ("group", "name", "value", "reason"),
    [
        ("wasp.methods", "whole", f"{__name__}:Odd.whole", ""),
        (
            "wasp.operators",
            "gone",
            "no_such_package:thing",
            "ModuleNotFoundError: No module named 'no_such_package'",
        ),
        ("wasp.operators", "method", f"{__name__}:Odd.whole", "is of type MethodInfo"),
        ("wasp.methods", "taken", f"{__name__}:Odd.taken", "redefines the built-in method 'wasp'"),
        ("wasp.operators", "no-class", f"{__name__}:Odd.no_class", "AttributeError"),
        ("wasp.methods", "study", f"{__name__}:Odd.study", "has the name of a field of every spec"),
        ("wasp.operators", "none", f"{__name__}:Odd.none", "has the name of the unimpaired expert"),
        ("wasp.methods", "no-config", f"{__name__}:Odd.no_config", "is no configuration"),
    ],
)
def test_a_plugin_has_a_row_that_says_whether_it_can_be_used(
    group: str, name: str, value: str, reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    point = EntryPoint(name, value, group)
    monkeypatch.setattr(
        "wasp_cli.registry.entry_points", lambda group: [point] if group == point.group else []
    )
    (found,) = [finding for finding in examine(tmp_path) if finding.what.startswith("plugin")]
    assert found.what.startswith(f"plugin {name} (")
    if not reason:
        assert found.state == "ok"
        return
    assert (found.state, found.meaning) == ("broken", "repair or uninstall it")
    assert reason in found.found
    with pytest.raises(WaspError, match=f"plugin {name}"):
        require([found])


def test_every_group_of_plugins_is_looked_at() -> None:
    root = Path(wasp_cli.__file__).parent
    groups = {
        group
        for path in root.glob("*/registry.py")
        for group in re.findall(r'^    "(wasp\.\w+)",$', path.read_text(), re.MULTILINE)
    }
    assert groups == {registry.group for registry in registries()}
