"""A results folder with published results of the small spec, and code that moves on."""

import json
import shutil
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.run.harness import faked, written
from wasp_cli.console import err
from wasp_cli.plan import grid, reasons
from wasp_cli.plan.node import Node
from wasp_cli.plan.plan import Plan, plan_against
from wasp_cli.plan.reuse import lay_out_over
from wasp_cli.plan.source import closure
from wasp_cli.run.publish import carry_publication, publication
from wasp_cli.run.session import RunOptions, Session, run_spec
from wasp_cli.spec.load import load
from wasp_cli.store.layout import Layout
from wasp_cli.store.slim import Slimming

SPECIFIC = "wasp_cli.methods.ida"
"""A module that some nodes run, none of them one that others read but a calibration."""
COMMON = "wasp_cli.tasks.goal.task"
"""A module that every node runs."""
MORE = ("operators={noisy: {mild: 0.2, severe: 0.6}, laggy: {moderate: 0.7}}",)
"""One more severity than the spec has."""


@pytest.fixture(autouse=True)
def fresh_console() -> Iterator[None]:
    """The console keeps the stream of its first use, which is closed after the test."""
    err.cache_clear()
    yield
    err.cache_clear()


@pytest.fixture
def moved(monkeypatch) -> Callable[[str], None]:
    """Changes the code of a module, as far as plans can see."""
    hashed, sources = grid.closure_hash, reasons.source_hashes

    def change(module: str) -> None:
        def moved_hash(roots: tuple[str, ...], without: tuple[str, ...] = ()) -> str:
            is_run = module in closure(roots, without)
            return hashed(roots, without) + ("moved" if is_run else "")

        def moved_sources(roots: tuple[str, ...], without: tuple[str, ...] = ()) -> dict[str, str]:
            now = sources(roots, without)
            return now | {module: "moved"} if module in now else now

        monkeypatch.setattr(grid, "closure_hash", moved_hash)
        monkeypatch.setattr(reasons, "source_hashes", moved_sources)

    return change


@pytest.fixture(scope="session")
def computed(tmp_path_factory) -> Path:
    """The results of the spec in `elsewhere`, and what was published of them in `results`."""
    folder = tmp_path_factory.mktemp("layered")
    spec, elsewhere = written(folder / "small.yaml"), Layout(folder / "elsewhere")
    with faked(folder):
        run_spec(load(spec), elsewhere.root, RunOptions(jobs=0))
        publish(spec, elsewhere, Layout(folder / "results" / "published"))
    err.cache_clear()
    return folder


@pytest.fixture
def here(computed, fakes, small_spec, tmp_path) -> Path:
    """A fresh results folder with the published results of the spec, which were computed
    elsewhere.
    """
    return shutil.copytree(computed / "results", tmp_path / "results")


def publish(spec: Path, layout: Layout, target: Layout) -> None:
    found = publication(load(spec).spec, layout, target, (), 8e6, "none")
    carry_publication(found, load(spec).spec, layout, target, Slimming())


def run(
    spec: Path, results: Path, settings: tuple[str, ...] = (), choice: str = "published"
) -> Session:
    done = run_spec(load(spec, settings), results, RunOptions(jobs=0), reuse=choice)
    done.require_complete()
    return done


def plan(
    spec: Path, results: Path, settings: tuple[str, ...] = (), choice: str = "published"
) -> Plan:
    layout = Layout(results)
    return plan_against(lay_out_over(load(spec, settings).spec, layout, choice), layout)


def kinds(executions: list[str]) -> Counter[str]:
    return Counter(line.split()[2] for line in executions)


def node_of(plan: Plan, label: str) -> Node:
    return next(step.node for step in plan.steps if step.node.label == label)


def published_manifest(results: Path, label: str) -> Path:
    found = [
        path
        for path in results.glob("published/store/*/*/_manifest.json")
        if json.loads(path.read_text())["label"] == label
    ]
    return found[0]


def rewrite(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    manifest = json.loads(path.read_text())
    change(manifest)
    path.write_text(json.dumps(manifest))
