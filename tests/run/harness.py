"""Fixtures and helpers for tests that run fake stages, in this process or in others."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
import pytest

from tests.commands import ROOT
from tests.run import fake_stages
from wasp_cli.plan import grid
from wasp_cli.plan.plan import Plan, plan_against
from wasp_cli.run.pools.base import Pool
from wasp_cli.run.pools.local import InlinePool
from wasp_cli.run.record import new_run
from wasp_cli.run.runner import Runner, Summary
from wasp_cli.spec.load import Loaded, load
from wasp_cli.stages.registry import STAGES
from wasp_cli.store.layout import Layout

SMALL = """
name: small
preset: smoke
tasks: [goal1]
methods: [human, ida, wasp, expert]
operators:
  noisy: {mild: 0.2}
  laggy: {moderate: 0.7}
seeds: [0, 1]
"""


@dataclass
class Fakes:
    """The behaviour of the fake stages, and what they have done."""

    folder: Path

    def set(self, **options: Any) -> None:
        os.environ[fake_stages.OPTIONS] = json.dumps({"log": str(self.log), **options})

    @property
    def log(self) -> Path:
        return self.folder / "executions.log"

    def executions(self) -> list[str]:
        return self.log.read_text(encoding="utf-8").splitlines() if self.log.exists() else []


@contextmanager
def faked(folder: Path) -> Iterator[Fakes]:
    """Fake stages in the place of all real ones."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(fake_stages.OPTIONS, "{}")
        grid.stage_class.cache_clear()
        before = fake_stages.install()
        state = Fakes(folder)
        state.set()
        yield state
        STAGES._own.update(before)
        STAGES._all = None
        grid.stage_class.cache_clear()


@pytest.fixture
def fakes(tmp_path):
    with faked(tmp_path) as state:
        yield state


def written(path: Path, *change: str) -> Path:
    path.write_text(SMALL.replace(*change) if change else SMALL, encoding="utf-8")
    return path


@pytest.fixture
def small_spec(tmp_path) -> Path:
    return written(tmp_path / "small.yaml")


@pytest.fixture
def other_spec(tmp_path) -> Path:
    """The same experiment with another seed, under the same name."""
    return written(tmp_path / "other.yaml", "seeds: [0, 1]", "seeds: [1, 7]")


def prepared(spec: Path, results: Path) -> tuple[Loaded, Layout, Plan]:
    loaded, layout = load(spec), Layout(results)
    layout.prepare()
    return loaded, layout, plan_against(grid.lay_out(loaded.spec), layout)


def run(spec: Path, results: Path, pool: Pool | None = None) -> Summary:
    """One run through the runner itself."""
    loaded, layout, plan = prepared(spec, results)
    return Runner(layout, new_run(layout, loaded, plan), pool or InlinePool()).run(plan)


def keys_of(spec: Path, results: Path) -> set[str]:
    _, _, plan = prepared(spec, results)
    return {step.node.key for step in plan.steps}


def data_of(results: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(results / "store")): path.read_bytes()
        for path in sorted((results / "store").glob("*/*/data.bin"))
    }


def as_undisturbed(spec: Path, results: Path) -> bool:
    """Whether a store has the bytes that it gets where nothing goes wrong."""
    run(spec, results.with_name("undisturbed"))
    return data_of(results) == data_of(results.with_name("undisturbed"))


def finished(results: Path) -> set[str]:
    return {path.parent.name for path in results.glob("store/*/*/_manifest.json")}


def goes_on(fakes: Fakes, spec: Path, results: Path) -> int:
    """A run in which nothing goes wrong computes what is not finished, once, and leaves an
    undisturbed store; how many nodes that were.
    """
    kept, ran = len(finished(results)), len(fakes.executions())
    fakes.set()
    summary = run(spec, results)
    assert summary.complete
    assert summary.done == len(finished(results)) - kept == len(fakes.executions()) - ran
    assert as_undisturbed(spec, results)
    return summary.done


def start(*arguments: str | Path, cwd: Path = ROOT) -> subprocess.Popen[str]:
    """`wasp` with fake stages in a session of its own, so that a signal to its group cannot
    reach the tests. Its output is buffered as that of a user's is.
    """
    variables = {name: os.environ[name] for name in os.environ if name != "PYTHONUNBUFFERED"}
    command = [sys.executable, str(ROOT / "tests/run/fake_wasp.py"), *map(str, arguments)]
    return subprocess.Popen(
        command,
        cwd=cwd,
        env=variables,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def wasp(
    *arguments: str | Path | int, code: int | None = None, cwd: Path = ROOT
) -> subprocess.CompletedProcess[str]:
    """The same, to its end; where it ends with 1, it says why in words."""
    process = start(*map(str, arguments), cwd=cwd)
    out, errors = process.communicate(timeout=600)
    assert code in (None, process.returncode), errors
    assert code != 1 or "Traceback" not in errors
    return subprocess.CompletedProcess(arguments, process.returncode, out, errors)


def wait_until(condition: Callable[[], bool], seconds: float = 600.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError("the condition never came true")
        time.sleep(0.02)


LED_BY = "WASP_TEST_LED_BY"
"""The environment variable of the workers of a command: its process, which leads a group."""


def group_is_gone(group: int) -> bool:
    """Whether a command has gone, and its workers, which stand in groups of their own."""
    with suppress(ProcessLookupError):
        os.killpg(group, 0)
        return False
    for process in psutil.process_iter():
        with suppress(psutil.Error):
            if process.environ().get(LED_BY) == str(group):
                return False
    return True
