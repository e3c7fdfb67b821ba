"""Which run is the newest, and until when a run is not over."""

import json
import os
import time
from pathlib import Path

from tests.commands import run_here
from tests.run.harness import finished, keys_of, run, start, wait_until
from tests.run.recorded import planned, write_run
from wasp_cli.plan.recorded import order_of, run_ids
from wasp_cli.report.provenance import last_runs
from wasp_cli.store.layout import Layout


def other(spec: Path) -> Path:
    path = spec.with_name("other.yaml")
    path.write_text(spec.read_text().replace("seeds: [0, 1]", "seeds: [1, 7]"), encoding="utf-8")
    return path


def test_a_clock_that_was_ahead_makes_no_run_the_newest(fakes, small_spec, tmp_path):
    results, later = tmp_path / "results", other(small_spec)
    run(small_spec, results)
    layout = Layout(results)
    (first,) = run_ids(layout)
    ahead = "20300101-000000-small-0001"
    os.rename(layout.run(first), layout.run(ahead))
    future = time.time() + 10**8
    os.utime(layout.run(ahead), (future, future))
    run(later, results)
    (newest,) = set(run_ids(layout)) - {ahead}
    assert run_ids(layout) == [newest, ahead]
    assert last_runs(layout) == ({"small": newest}, [])
    assert json.loads(run_here("status", results, "--json", columns=80).stdout)[0]["run_id"] == newest
    done = run_here("gc", results, "--yes", columns=80)
    assert done.exit_code == 0, done.output
    assert finished(results) == keys_of(later, results)


def test_a_run_without_a_number_is_older(tmp_path):
    layout = Layout(tmp_path / "results")
    layout.prepare()
    names = [f"{day}-120000-small-000{n}" for n, day in enumerate(("20260503", "20300101", "20260502"))]
    for name in names:
        write_run(layout, name, [planned(1, "a")])
    for name, text in ((names[0], "2\n"), (names[2], "1\n"), (names[1], "no number")):
        layout.order(name).write_text(text)
    assert [order_of(layout, name) for name in names] == [2, 0, 1]
    assert run_ids(layout) == [names[0], names[2], names[1]]


def test_what_a_run_reports_on_stays_until_its_report_is_written(fakes, small_spec, tmp_path):
    results, later, gate = tmp_path / "results", other(small_spec), tmp_path / "report now"
    fakes.set(report=str(gate))
    process = start("run", small_spec, "--results", results, "-j", "0")
    try:
        wait_until(lambda: any("run ended" in path.read_text() for path in results.glob("runs/*/journal.jsonl")))
        before = keys_of(small_spec, results)
        run(later, results)
        for _ in range(2):
            done = run_here("gc", results, "--yes", "--runs", columns=80)
            assert done.exit_code == 0, done.output
        assert before <= finished(results)
    finally:
        gate.touch()
        output = process.communicate(timeout=600)
    assert process.returncode == 0, output
    run_here("gc", results, "--yes", columns=80)
    assert finished(results) == keys_of(later, results)
