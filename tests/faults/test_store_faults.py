"""Results folders that cannot be used, or hold rubbish."""

import json

from tests.run.harness import run
from wasp_cli.report.provenance import last_runs
from wasp_cli.report.summarize import report_run
from wasp_cli.run.record import read_run
from wasp_cli.store.layout import Layout


def test_results_of_another_version_and_of_an_absent_plugin_are_read(fakes, small_spec, tmp_path):
    results = tmp_path / "results"
    run(small_spec, results)
    layout = Layout(results)
    (run_id,) = last_runs(layout)[0].values()
    before = read_run(layout, run_id)
    spec, plan = (layout.run(run_id) / name for name in ("spec.json", "plan.json"))
    document, planned = json.loads(spec.read_text()), json.loads(plan.read_text())
    document["blend"] = {"share": 0.5}  # the section of a plugin
    document["wasp"]["braveness"] = 2  # a field of another version
    document["wasp"]["operator_model"] = "oracle"  # a value of another version
    document["methods"] += ["blend", "mix"]
    document["operators"]["sleepy"] = {"mild": 1.0}
    spec.write_text(json.dumps(document))
    cell = next(cell for cell in planned["cells"] if cell["method"] == "human")
    planned["cells"] += [{**cell, "method": "blend", "key": "0" * 20}, {**cell, "operator": "sleepy", "key": "1" * 20}]
    plan.write_text(json.dumps(planned))
    after = read_run(layout, run_id)
    assert (after.cells, after.parts) == (before.cells, before.parts)
    assert after.spec == before.spec
    told = "\n".join(after.unknown)
    for name in ("`blend`", "`wasp.braveness`", "`wasp.operator_model`", "`methods: blend`", "`methods: mix`", "`operators.sleepy`"):
        assert name in told
    assert after.absent == ("blend: not installed here; its cell is left out.", "sleepy: not installed here; its cell is left out.")
    report = report_run(results, after.spec, after.cells, after.parts, unknown=after.unknown, absent=after.absent)
    assert {*after.unknown, *after.absent} <= set(report.facts)
