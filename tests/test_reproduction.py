"""REPRODUCTION.md says what is published, number by number."""

import csv
import json
import math
import re
import statistics
from pathlib import Path

import assistants
import claims
import pyarrow.parquet as pq
import pytest

from tests.commands import run_here
from wasp_cli.spec.load import load
from wasp_cli.store.tables import read_episodes

ROOT = Path(__file__).parents[1]
STORE = ROOT / "results" / "published" / "store"
REPORTS = ROOT / "results" / "published" / "reports"
PAGE = (ROOT / "REPRODUCTION.md").read_text(encoding="utf-8")
CARDS = (ROOT / "docs" / "cards.md").read_text(encoding="utf-8")
BASELINES = ("ida", "diffusion", "saferl")


def rows_of(text: str) -> list[list[str]]:
    """The cells of every row of the Markdown tables in a text."""
    lines = [line.strip() for line in text.splitlines() if line.startswith("|") and not line.startswith("| ---")]
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", line[1:-1])] for line in lines]


def section(title: str) -> str:
    """The part of the page below a heading."""
    return PAGE.split(f"\n## {title}\n", 1)[1].split("\n## ", 1)[0]


@pytest.mark.parametrize(
    ("title", "report", "table", "left_out"),
    [("Table 1", "table1", "table1", 1), ("Table 2: FormulaOne1", "table2", "table2", 0), ("Figure 3: Race1", "figure3", "figure3", 0)],
)
def test_the_tables_are_the_published_ones(title, report, table, left_out):
    """Of Table 1 the times of decisions are left out: they belong to a machine."""
    published = rows_of((REPORTS / report / f"{table}.md").read_text(encoding="utf-8"))
    assert len(published) > 5
    assert rows_of(section(title)) == [row[: len(row) - left_out] for row in published]


def test_the_second_edition_so_far_is_the_published_one():
    rows = assistants.published("edition2")
    assert assistants.short(rows) in section("The second edition, training 1")
    told = assistants.differences(rows, next(iter(assistants.GROUPS)))
    for less in ("-4.9 [-7.3, -2.9]", "-3.9 [-8.9, -0.5]", "-15.9 [-21.3, -10.9]"):
        assert less in told


@pytest.mark.parametrize(("title", "table"), [("World models", "world_model"), ("Policies and critics", "training")])
def test_the_cards_have_the_published_evidence(title, table):
    published = rows_of((REPORTS / "table1" / f"{table}.md").read_text(encoding="utf-8"))
    shown = rows_of(CARDS.split(f"\n## {title}\n", 1)[1].split("\n## ", 1)[0])
    assert len(published) > 3
    assert [row for row in shown if len(row) == len(published[0])] == published


def test_the_experts_of_the_cards_are_those_of_all_three_trainings():
    """One of three numbers is at most 2 / sqrt(3) standard deviations from their mean: seed 1's has to be among them."""
    with (REPORTS / "table1" / "training.csv").open(encoding="utf-8") as file:
        rows = {row["task"]: row for row in csv.DictReader(file)}
    shipped = [json.loads(path.read_text()) for path in (STORE / "expert").glob("*/*manifest.json")]
    shipped = [manifest for manifest in shipped if manifest["config"]["evaluation_episodes"] == 64]  # the quickstart's is a small one
    shipped = [manifest for manifest in shipped if not manifest["config"].get("bars")]  # those that reach bars are of docs/assistants.md
    assert sorted(manifest["task"] for manifest in shipped) == ["formula1", "goal1", "race1"]
    for manifest in shipped:
        row = rows[{"formula1": "FormulaOne1", "goal1": "Goal1", "race1": "Race1"}[manifest["task"]]]
        for name in ("return", "cost"):
            mean, spread = float(row[f"expert.{name}"]), float(row[f"expert.{name}_sd"])
            assert abs(manifest["summary"][name] - mean) <= 2 / math.sqrt(3) * spread + 1e-6


def test_each_claim_has_the_verdict_of_the_published_rows():
    listed = rows_of(section("The 21 claims"))
    assert listed == rows_of(claims.table())
    words = [row[1] for row in listed[1:]]
    holds, fails, undecided = (words.count(word) for word in ("holds", "**does not hold**", "undecided"))
    assert f"{holds} hold for these models, {fails} do not, {undecided} are undecided" in PAGE
    pairs = [row[1:3] for row in listed[1:] if row[2] != "n/a"]
    assert f"{sum(own != other for own, other in pairs)} of the {len(pairs)} claims that this row can answer come out differently" in PAGE


def test_a_film_of_a_published_cell_needs_nothing_but_the_checkout(tmp_path):
    film = tmp_path / "film.webp"
    key = "ab95264a"  # race1 s1 wasp laggy=0.7 of the second edition
    label = (key, "--episode", "0", "--every", "30")
    run_here("replay", *label, "--results", ROOT / "results" / "published", "--out", film, columns=200, code=0)
    assert film.stat().st_size > 10_000


def test_the_first_episodes_of_published_cells_are_those_of_the_whole_ones(tmp_path):
    spec, only = ROOT / "specs" / "table2.yaml", ("--select", "method=human")
    done = run_here("run", spec, "--results", tmp_path / "r", "--limit", "10", *only, columns=200, code=0)
    assert re.search(r"(?m)^0 computed, ", done.stderr), done.stderr
    run_here("run", spec, "--results", tmp_path / "r", *only, columns=200)
    rows: dict[tuple[str, int], list[dict[str, object]]] = {}
    for path in tmp_path.glob("r/store/evaluate/*/episodes.parquet"):
        for row in read_episodes([path]).to_pylist():
            rows.setdefault((row["operator"], row["episode"]), []).append(row)
    assert len(rows) == 4 * 30
    assert all(len(both) == 1 + (episode < 10) and both[0] == both[-1] for (_, episode), both in rows.items())


def test_what_cuts_a_batch_is_computed(tmp_path):
    done = run_here("plan", ROOT / "specs" / "table2.yaml", "--results", tmp_path, "--limit", "7", columns=200)
    assert "a cell is cut after whole batches of 10 (side_by_side)" in " ".join(done.output.split())
    assert "nothing to compute" not in done.output


def test_assistants_are_varied_over_the_published_models_without_training(tmp_path):
    setting = ("--set", "wasp.tau_c=0.35", "--set", "seeds=[1]", "--json")
    done = run_here("plan", ROOT / "specs" / "table1.yaml", "--results", tmp_path, *setting, columns=200)
    nodes = json.loads(done.stdout)["nodes"]
    assert {node["kind"] for node in nodes if node["state"] == "missing"} == {"heldout", "calibration", "evaluate"}


def test_mild_and_severe_operators_are_the_published_ones():
    with (REPORTS / "severity" / "severity.csv").open(encoding="utf-8") as file:
        published = list(csv.DictReader(file))
    columns = [
        (f"{key}.{severity}", digits)
        for key, digits in (("return", 1), ("cost", 1), ("int_rate", 2)) for severity in ("mild", "moderate", "severe")
    ]  # fmt: skip
    shown, task = rows_of(section("Mild and severe operators"))[1:], ""
    assert len(shown) == len({(row["task"], row["method"]) for row in published})
    for title, method, *numbers in shown:
        task = title or task
        own = [row for row in published if (row["task"], row["method"]) == (task, method)]
        assert len(own) == 4
        assert numbers == [f"{sum(float(row[key]) for row in own) / 4:.{digits}f}" for key, digits in columns]


def test_in_each_training_wasp_costs_less_than_the_baselines():
    """The sentence below Table 1, and of how many differences the 95 % interval over worlds includes zero."""
    spec = load(ROOT / "specs" / "table1.yaml").spec
    moderate = {(operator, severity["moderate"]) for operator, severity in spec.operators.items()}
    costs: dict[tuple[str, int], dict[str, dict[int, list[int]]]] = {}
    for cell, path in claims.cells_of("evaluate/*/episodes.parquet").items():
        if cell.method in ("wasp", *BASELINES) and cell.variant == "full" and (cell.operator, cell.value) in moderate:
            for row in pq.read_table(path, columns=["episode_seed", "cost"]).to_pylist():
                worlds = costs.setdefault((cell.task, cell.seed), {}).setdefault(cell.method, {})
                worlds.setdefault(row["episode_seed"], []).append(row["cost"])
    costs = {place: by_method for place, by_method in costs.items() if place[1] in spec.seeds}
    assert len(costs) == 9
    open_ones = 0
    for by_method in costs.values():
        assert len(by_method) == 4
        for name in BASELINES:
            apart = [statistics.mean(by_method["wasp"][world]) - statistics.mean(each) for world, each in by_method[name].items()]
            assert len(apart) == 30
            assert statistics.mean(apart) < 0
            open_ones += statistics.mean(apart) + 1.96 * statistics.stdev(apart) / math.sqrt(30) > 0
    assert f"of these 27 paired differences {open_ones} include zero" in PAGE


def test_of_how_many_episodes_an_ablation_changed_nothing():
    """The sentence below Table 2."""
    columns = ["return", "cost", "int_rate", "mag", "env_steps"]
    rows: dict[str, dict[tuple[str, int], list[float]]] = {}
    for cell, path in claims.cells_of("evaluate/*/episodes.parquet").items():
        if (cell.task, cell.method, cell.seed) == ("formula1", "wasp", 1):
            for row in pq.read_table(path, columns=["episode", *columns]).to_pylist():
                rows.setdefault(cell.variant, {})[cell.operator, row["episode"]] = [row[name] for name in columns]
    assert all(len(rows[variant]) == 120 for variant in ("full", "no-case2", "task-only"))
    case2, gate = (sum(rows["full"][place] == row for place, row in rows[variant].items()) for variant in ("no-case2", "task-only"))
    assert f"without Case II {case2} of 120 episodes are identical to those of the whole, without the safety gate {gate}." in PAGE
