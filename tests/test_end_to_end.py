"""The whole chain through the command line on the smallest budgets: every stage runs, and every
method really acts.
"""

import json
import shutil
from functools import partial
from io import StringIO
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from rich.console import Console

from tests import commands
from wasp_cli.methods.registry import METHODS
from wasp_cli.report.trained.evidence import EVIDENCE
from wasp_cli.run.verify import again, differences, show_answer
from wasp_cli.stages.registry import STAGES
from wasp_cli.store.branches import read_branches
from wasp_cli.store.tables import read_episodes, read_steps, same_rows, write_episodes

# Of a change before it goes in, the nox session `smoke` and tests/test_own_task.py run the whole
# chain.
pytestmark = pytest.mark.slow

SPEC = """
name: chain
preset: smoke
tasks: [goal1]
methods: [human, ida, diffusion, csa, saferl, wasp, printed, ida-guarded, ida-least, expert, filter, reach, qcbf, mpmi, planner]
variants: [full, safety-only, task-only]
operators:
  laggy: {severe: 0.85}
stages: [diagnostics, adversary, counterfactual]
action_repeat: 20                    # a fifth of the decisions of usual episodes, which are whole all the same
dataset: {steps: 300}
expert: {interactions: 500, evaluation_episodes: 1}
policies: {labelling_episodes: 1}
seeds: [4]
episodes: 2
wasp: {tau_c: 0.05, tau_r: 0.0}   # untrained models see little: gates that fire all the same
printed: {tau_c: 0.05}
ida: {vote: -0.9, quantile: 0.05}
ida-guarded: {vote: -0.9, quantile: 0.05}
"""


wasp = partial(commands.wasp, commands.ROOT, code=0)


@pytest.fixture(scope="module")
def results(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("chain")
    spec = folder / "chain.yaml"
    spec.write_text(SPEC)
    wasp("run", str(spec), "--results", str(folder / "results"), "-j", "2")
    return folder / "results"


def cells(results: Path) -> dict[tuple[str, str], Path]:
    found = {}
    for path in sorted((results / "store" / "evaluate").glob("*/episodes.parquet")):
        row = read_episodes([path]).slice(0, 1).to_pylist()[0]
        found[row["method"], row["variant"]] = path
    return found


def test_every_stage_has_left_an_artifact_with_its_numbers(results):
    # A clone is made of what a person drove; an operating point would silence untrained methods.
    for kind in STAGES.keys() - {"clone", "operating", "severity"}:
        manifests = list((results / "store" / kind).glob("*/_manifest.json"))
        assert manifests, f"no {kind}"
        for manifest in manifests:
            assert json.loads(manifest.read_text())["summary"], f"{kind} says nothing about itself"


def test_every_method_and_variant_has_its_cell_of_whole_episodes(results):
    wanted = {(name, "full") for name in METHODS} | {
        (name, variant) for name in ("wasp", "printed") for variant in ("safety-only", "task-only")
    }
    assert set(cells(results)) == wanted
    for path in cells(results).values():
        episodes = read_episodes([path])
        assert episodes.num_rows == 2
        assert set(episodes["env_steps"].to_pylist()) == {1000}
        assert read_steps(path).num_rows == 2 * 50


def test_methods_act_and_human_only_does_not(results):
    full = {name: path for (name, variant), path in cells(results).items() if variant == "full"}
    rates = {
        name: np.mean(read_episodes([path])["int_rate"].to_pylist()) for name, path in full.items()
    }
    assert rates["human"] == 0
    assert rates["expert"] == 0
    for name in (
        "ida",
        "diffusion",
        "saferl",
        "filter",
        "reach",
        "qcbf",
        "wasp",
        "printed",
        "ida-guarded",
        "mpmi",
        "planner",
    ):
        assert rates[name] > 0, f"{name} never acted"


def branches(results: Path) -> dict[str, Path]:
    return {
        path.parent.name: path
        for path in (results / "store" / "counterfactual").glob("*/branches.parquet")
    }


def test_the_interventions_of_every_method_that_acts_are_branched(results):
    found = {
        (b.cell.identity.method, b.cell.identity.variant): b
        for b in map(read_branches, branches(results).values())
    }
    assert set(found) == {name for name in cells(results) if METHODS[name[0]].intervenes}
    for name, judged in found.items():
        steps = read_steps(cells(results)[name]).to_pylist()
        interventions = [(step["episode"], step["t"]) for step in steps if step["deviation"] > 0]
        assert (
            list(zip(judged.episode.tolist(), judged.t.tolist(), strict=True))
            == interventions[:: judged.cell.stride]
        )
        assert len(judged.t) <= 3
    # How often an untrained method acts depends on the machine, but Diffusion always does.
    assert len(found["diffusion", "full"].t) > 0
    report = (results / "reports" / "chain" / "figure3.md").read_text(encoding="utf-8")
    assert all(METHODS[method].title in report for method, _ in found)


def test_no_two_methods_have_the_same_rows(results):
    # Ablations of an untrained model may coincide, and an untrained IDA may always choose the
    # expert's action.
    compared = {
        name: path
        for (name, variant), path in cells(results).items()
        if variant == "full" and name not in ("expert", "ida-least", "ida-guarded")
    }
    actions = {name: str(read_steps(path)["a"].to_pylist()) for name, path in compared.items()}
    assert len(set(actions.values())) == len(actions) == 12


def test_wasp_records_its_gates_and_cases_as_its_variants_allow(results):
    def steps(variant: str) -> pa.Table:
        return read_steps(cells(results)["wasp", variant])

    gates = {
        variant: set(steps(variant)["gate"].to_pylist())
        for variant in ("full", "safety-only", "task-only")
    }
    assert 2 not in gates["safety-only"]
    assert 1 not in gates["task-only"]
    assert gates["full"] & {1, 2}
    full = steps("full").to_pylist()
    for step in full:
        assert step["g_cost"] is not None
        assert step["g_return"] is not None
        for name in (
            "safe",
            "case2",
            "plan",
            "plan_cost",
            "plan_return",
            "alone_cost",
            "alone_return",
        ):
            assert (step[name] is not None) == (step["gate"] in (1, 2))
        if step["gate"] == 0:
            assert step["deviation"] == 0
    thresholds = read_episodes([cells(results)["wasp", "full"]])
    assert set(thresholds["tau_c"].to_pylist()) == {0.05}


def test_report_needs_the_results_folder_alone(results):
    shown = wasp("report", str(results)).stdout
    for said in (
        *(info.title for info in METHODS.values()),
        "Trained parts",
        "World model, imagined steps ahead",
    ):
        assert said in shown
    parts = {
        path.parent.name.split("-")[2]: path
        for path in (results / "reports" / "chain" / "trained").glob("*/*")
    }
    assert {kind for kind in EVIDENCE if (results / "store" / kind).is_dir()} == set(parts)
    files = {path.name for path in (results / "reports" / "chain" / "trained").glob("*/*")}
    assert {
        "contents.md",
        "open_loop.png",
        "reconstruction.png",
        "curve.png",
        "critics.png",
    } <= files


def test_one_worker_trains_and_evaluates_the_same_as_two(results, tmp_path):
    # What judges the models has no part in the rows.
    spec = str(results.parent / "chain.yaml")
    wasp("run", spec, "--results", str(tmp_path), "-j", "1", "--set", "stages=[counterfactual]")
    mine, theirs = cells(results), cells(tmp_path)
    assert set(theirs) == set(mine)
    for name in theirs:
        assert mine[name].parent.name == theirs[name].parent.name, (
            "the same content has the same key"
        )
        assert same_rows(mine[name], theirs[name]), name
    judged, branched = branches(results), branches(tmp_path)
    assert branched
    assert all(path.read_bytes() == judged[key].read_bytes() for key, path in branched.items())


def rows_of_table(results: Path) -> list[str]:
    """The main table without the sentences under it: some are about trained parts, which are not
    copied where only their cells are needed.
    """
    text = (results / "reports/chain/table1.md").read_text(encoding="utf-8")
    rows = [line for line in text.splitlines() if line.startswith("|")]
    assert rows
    return rows


def test_published_results_give_the_same_tables_on_a_fresh_machine(results, tmp_path):
    spec, here = str(results.parent / "chain.yaml"), tmp_path / "results"
    wasp("publish", spec, "--results", str(results), "--to", str(here / "published"))
    done = wasp("run", spec, "--results", str(here), "--reuse", "published")
    assert "0 computed, 0 computed before" in done.stderr
    assert "published with this code" in done.stderr
    ours, theirs = cells(here), cells(results)
    assert {name: path.read_bytes() for name, path in ours.items()} == {
        name: path.read_bytes() for name, path in theirs.items()
    }
    for shown in (done.stdout, wasp("report", str(here)).stdout):
        assert "their own code and libraries are the present ones" in shown
        assert "INCOMPLETE" not in shown
    assert rows_of_table(here) == rows_of_table(results)


def test_cells_follow_from_the_models_beside_them_to_the_bit(results, tmp_path):
    assert (
        "2 of 2 cells are the same to the bit"
        in wasp("verify", str(results), "--cells", "2", "--seed", "7", "-j", "1").stdout
    )
    copy = shutil.copytree(results, tmp_path / "results")
    key = next(path.parent.name for name, path in cells(copy).items() if name == ("human", "full"))
    rows = copy / "store" / "evaluate" / key / "episodes.parquet"
    table = read_episodes([rows])
    wrong = table.set_column(
        table.column_names.index("return"),
        "return",
        [[value + 1e-6 for value in table["return"].to_pylist()]],
    )
    write_episodes(wrong.replace_schema_metadata(pq.read_schema(rows).metadata), rows)
    assert differences(rows.parent, results / "store" / "evaluate" / key) == ["return"]
    manifest = rows.parent / "_manifest.json"
    record = json.loads(manifest.read_text(encoding="utf-8"))
    record["provenance"]["processor"] = "Another One"
    manifest.write_text(json.dumps(record), encoding="utf-8")
    answer = again(copy, key, tmp_path)
    console = Console(file=StringIO(), width=80)
    show_answer(answer, console)
    assert answer.differing == ("return",)
    ((_, then, now), (_, cost_then, cost_now)) = answer.means
    assert then - now == pytest.approx(1e-6, rel=0.01)
    assert cost_then == cost_now
    assert "(differ: return)  (computed on Another One, here " in console.file.getvalue()
    record["config"]["of_another_version"] = 1
    manifest.write_text(json.dumps(record), encoding="utf-8")
    assert (
        again(copy, key, tmp_path)
        .differing[0]
        .startswith("error: ValidationError: 1 validation error")
    )
