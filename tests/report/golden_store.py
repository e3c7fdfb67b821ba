"""From a finished run of tests/golden/golden.yaml to the store that is checked in: what a report
reads, and nothing of the machine.

wasp run tests/golden/golden.yaml --results /tmp/golden
python -m tests.report.golden_store /tmp/golden
WASP_GOLDEN=write pytest tests/report/test_golden_store.py
"""

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from wasp_cli.cells.asked import asked_of
from wasp_cli.cells.runs import last_runs
from wasp_cli.report.summarize import Report, report_run
from wasp_cli.spec.paper import Paper
from wasp_cli.store.layout import Layout
from wasp_cli.store.records import dumps

STORE = Path(__file__).parent.parent / "golden" / "store"
READ = (
    "episodes.parquet",
    "_steps.pq",
    "branches.parquet",
    "curve.json",
    "curves.json",
    "diagnostics.json",
    "reinforcement.json",
)
"""Files of artifacts that a report reads, beside the manifests."""
KEPT = (
    "kind",
    "key",
    "label",
    "task",
    "seed",
    "axes",
    "settings",
    "upstream",
    "upstream_kinds",
    "summary",
)
"""Of a manifest."""


def report_of(results: Path, paper: Paper | None = None) -> Report:
    """The report of a copy of the store."""
    asked = asked_of(last_runs(Layout(results)).runs["golden"])
    # An earlier version wrote its spec: the settings that it no longer has are not looked at here.
    return report_run(replace(asked, unknown=()), paper)


def distil(results: Path, target: Path) -> None:
    """Write the part of `results` that a report reads to `target`, an empty folder or one of an
    earlier call.
    """
    shutil.rmtree(target, ignore_errors=True)
    source, made = Layout(results), Layout(target)
    last = last_runs(source)
    if last.damaged or list(last.runs) != ["golden"]:
        raise SystemExit(f"{results} does not hold one whole run of golden.yaml")
    _records(source.run(last.runs["golden"].run_id), made.run("20260101-000000-golden-0000"))
    for manifest in sorted(source.store.glob("*/*/_manifest.json")):
        document = json.loads(manifest.read_text(encoding="utf-8"))
        folder = made.artifact(document["kind"], document["key"])
        folder.mkdir(parents=True)
        # Seconds as if all took the same: a report shows them, and they are the machine's.
        plain = {name: document[name] for name in KEPT} | {
            "provenance": {"seconds": 1.0, "started_at": "2026-01-01T00:00:00+00:00"}
        }
        (folder / "_manifest.json").write_text(dumps(plain), encoding="utf-8")
        for name in READ:
            if (manifest.parent / name).is_file():
                shutil.copy(manifest.parent / name, folder / name)


def _records(source: Path, target: Path) -> None:
    """The spec and the plan of the run; of the nodes only what says which is which."""
    target.mkdir(parents=True)
    shutil.copy(source / "spec.json", target / "spec.json")
    plan: dict[str, Any] = json.loads((source / "plan.json").read_text(encoding="utf-8"))
    plan = {name: plan[name] for name in ("spec", "cells", "branched", "parts")} | {"nodes": []}
    (target / "plan.json").write_text(dumps(plan), encoding="utf-8")


if __name__ == "__main__":
    distil(Path(sys.argv[1]), STORE)
