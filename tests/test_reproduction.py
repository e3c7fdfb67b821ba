"""REPRODUCTION.md and its details say what is published: each table, each number in the text."""

import itertools
import json
import re
import statistics
from collections import Counter
from dataclasses import replace
from pathlib import Path

import assistants
import pytest
import reproduction
import reproduction_numbers

from tests.commands import run_here
from wasp_cli.store.tables import CellIdentity, read_episodes, read_steps

ROOT = Path(__file__).parents[1]
STORE = ROOT / "results" / "published" / "store"
PAGE = (ROOT / "REPRODUCTION.md").read_text(encoding="utf-8")
DETAILS = (ROOT / "docs" / "reproduction_details.md").read_text(encoding="utf-8")
README = (ROOT / "README.md").read_text(encoding="utf-8")
TASKS = ("race1", "formula1", "goal1")
SIZES = {"30", "95", "0"}
"""Episodes of a cell, percent of an interval, and the 0 that an interval may contain."""


def section(page: str, title: str) -> str:
    """The part of a page below a heading."""
    return page.split(f"\n## {title}\n", 1)[1].split("\n## ", 1)[0]


def prose(text: str) -> str:
    """A text without its code, the targets of its links, and the names of tables and tasks."""
    text = re.sub(r"```.*?```|`[^`]*`", " ", text, flags=re.DOTALL)
    text = re.sub(r"\]\([^)]*\)", "]", text)
    text = re.sub(r"(?m)^\d+\. ", "", text)
    names = r"\b(?:Tables?|Figure|Eq\.|[Tt]rainings?|N|H) (?:= )?\d+(?:(?:,| and| or| to) \d+)*"
    return re.sub(names, " ", text)


def numbers_in(text: str) -> list[str]:
    """The numbers of a text, without signs; those in names such as Race1 are none."""
    return re.findall(r"(?<![\w.])\d+(?:,\d{3})*(?:\.\d+)?", prose(text))


@pytest.fixture(scope="module")
def tables() -> dict[str, list[str]]:
    return reproduction.tables()


def test_the_page_reads_rows_that_other_libraries_computed(monkeypatch):
    rows = {key for _, key in reproduction.grid().artifacts if any(STORE.glob(f"*/{key}"))}
    monkeypatch.setattr("wasp_cli.plan.keys.libraries", lambda: {"numpy": "2.5"})
    assert rows < {key for _, key in reproduction.grid.__wrapped__().artifacts}


def test_the_tables_are_those_of_the_published_rows(tables):
    for title, texts in tables.items():
        for text in texts:
            assert text in section(PAGE, title), title
    for title, texts in reproduction.details().items():
        for text in texts:
            assert text in section(DETAILS, title), title


def test_every_number_in_the_text_is_one_of_the_published_rows(tables):
    known = reproduction_numbers.numbers()
    for title in re.findall(r"(?m)^## (.+)$", PAGE):
        if title == "Compute it again":  # times, and settings of commands
            continue
        text = section(PAGE, title)
        allowed = set(SIZES)
        for table in tables.get(title, ()):
            text = text.replace(table, "")
            allowed |= set(numbers_in(table))
        for found in known.get(title, {}).values():
            allowed |= {number for each in found for number in numbers_in(each)}
        if title in ("Operating curves", "Cost at matched interventions"):
            allowed |= {"1", "40"}  # tau_c and episodes of the curves, of docs/assistants.md
        if title == "Environments of others":
            allowed |= {"120"}
        if title == "As printed, with the paper's search":
            allowed |= {"300", "100", "6", "64", "20", "3"}  # of specs/paper-size.yaml, and ours
        assert [number for number in numbers_in(text) if number not in allowed] == [], title


def test_every_number_that_the_rows_give_for_the_text_is_in_it():
    for title, told in reproduction_numbers.numbers().items():
        there = set(numbers_in(section(PAGE, title)))
        for what, found in told.items():
            for each in found:
                assert set(numbers_in(each)) <= there, f"{title}: {what}"


def test_the_numbers_beside_the_pictures_of_the_readme_are_published():
    text = README.split("\n## What comes out\n", 1)[1].split("\n## ", 1)[0]
    text = text.replace(assistants.short(assistants.published("table1")), "")
    told = reproduction_numbers.readme()
    allowed = {number for found in told.values() for number in found}
    assert [number for number in numbers_in(text) if number not in allowed | SIZES] == []
    assert allowed - {"21"} <= set(numbers_in(text))


def test_wasp_costs_less_than_ida_and_saferl_in_each_training():
    less = {name: Counter[bool]() for name in ("ida", "saferl", "diffusion")}
    for task, name, training in itertools.product(TASKS, less, reproduction.TRAININGS):
        costs = {
            method: statistics.mean(
                reproduction_numbers.cells_of(task, method)
                .where(lambda cell, training=training: cell.training == training)
                .pooled("cost")
            )
            for method in ("wasp", name)
        }
        less[name][costs["wasp"] < costs[name]] += 1
    assert less["ida"] == less["saferl"] == {True: 15}
    assert less["diffusion"][False] > 0, "the page would have to name Diffusion too"


def test_in_each_training_each_gate_alone_is_worse():
    for task, training in itertools.product(TASKS, reproduction.TRAININGS):
        rows = {
            group.variant: group.cells
            for group in reproduction.frame((training,)).groups
            if (group.task, group.method) == (task, "wasp")
        }
        means = {
            variant: {key: statistics.mean(cells.pooled(key)) for key in ("return", "cost")}
            for variant, cells in rows.items()
        }
        assert means["task-only"]["cost"] > means["full"]["cost"]
        assert means["safety-only"]["return"] < means["full"]["return"]


def test_who_costs_as_little_as_wasp_on_the_cars():
    intervals = {task: reproduction_numbers.contrasts(task) for task in TASKS}
    alike = {
        (method, task)
        for task, found in intervals.items()
        for method, (low, high) in found.items()
        if low <= 0.0 <= high
    }
    assert alike >= set(itertools.product(("diffusion", "ida-guarded"), ("race1", "formula1")))
    assert ("csa", "race1") in alike
    assert ("csa", "formula1") not in alike
    assert all(low > 0.0 for low, _ in (found["ida"] for found in intervals.values()))


def test_who_acts_as_often_in_effect_and_helps_costs_more_than_wasp_and_ida_behind_the_gate():
    mean = reproduction_numbers.mean
    for task in TASKS:
        rates = [mean(task, name, "int_eff") for name in ("ida", "ida-guarded", "wasp")]
        for name in reproduction_numbers.assistants():
            helps = mean(task, name, "return") > mean(task, "human", "return")
            as_often = min(rates) - 0.01 <= mean(task, name, "int_eff") <= max(rates) + 0.01
            if helps and as_often and name not in ("wasp", "ida-guarded"):
                cost = mean(task, name, "cost")
                assert cost > mean(task, "wasp", "cost"), (task, name)
                assert cost > mean(task, "ida-guarded", "cost"), (task, name)
        for name in ("filter", "reach", "mpmi"):
            assert mean(task, name, "int_eff") <= mean(task, "wasp", "int_eff")
            assert mean(task, name, "return") < mean(task, "human", "return")
            low, _ = reproduction_numbers.contrasts(task)[name]
            assert low <= 0.0, "it does not certainly cost more than WASP"


def test_the_most_necessary_interventions_are_those_of_wasp_and_of_ida_behind_the_gate():
    for task in TASKS:
        judged = {
            name: float(found[0])
            for name in reproduction_numbers.assistants()
            if name not in ("ida-least", "reach", "mpmi")
            and (found := reproduction_numbers.necessity(task, name, "uir"))
        }
        assert set(sorted(judged, key=judged.__getitem__)[:2]) == {"wasp", "ida-guarded"}
    uir = reproduction_numbers.necessity
    assert uir("race1", "printed", "uir") > uir("race1", "ida", "uir")
    assert "[-" in uir("formula1", "wasp", "delta_c", 3)[0], "nothing certain in training 3"


def test_operators_of_limited_skill_cost_nothing_alone_in_training_2_of_race1():
    identity = CellIdentity("race1", "human", "full", "limited-skill", 0.25, 2)
    alone = reproduction.frame((2,)).cells.where(lambda cell: cell.identity == identity)
    assert list(alone.pooled("cost")) == [0.0]


def test_whom_the_safety_gate_alone_fails_on_formula1():
    every = reproduction.frame().cells
    own = every.where(lambda cell: (cell.task, cell.method) == ("formula1", "wasp"))
    cost = {cell.identity: pooled for cell, pooled in zip(own, own.pooled("cost"), strict=True)}
    more: dict[str, list[float]] = {}
    for identity, whole in cost.items():
        if identity.variant == "full":
            alone = cost[replace(identity, variant="safety-only")]
            more.setdefault(identity.operator, []).append(alone - whole)
    assert {operator for operator, costs in more.items() if min(costs) > 0.0} == {
        "laggy",
        "limited-skill",
    }


def test_the_page_has_a_cause_for_each_claim_that_fails_or_stays_open():
    rows = re.findall(
        r"(?m)^\| `([\w-]+)` \| ([^|]+) \|", section(PAGE, "Why claims fail or stay open")
    )
    verdicts = {
        ours.claim.id: reproduction.word(ours)
        for ours, _ in reproduction.verdicts()
        if ours.outcome != "holds"
    }
    assert dict(rows) == verdicts
    open_ones = reproduction_numbers.answers_of("fewer-violations", "undecided")
    assert {answer.asked.task for answer in open_ones} == {"race1", "formula1"}
    for claim in ("safety-gate-keeps-safety", "recovery-needed", "rollouts-needed"):
        (judged,) = (ours for ours, _ in reproduction.verdicts() if ours.claim.id == claim)
        tasks = {answer.asked.task for answers in judged.answers for answer in answers}
        assert tasks == {"formula1"}


def test_commands_that_stepwise_correction_leaves_are_corners_of_the_box():
    for cell in reproduction.grid().cells:
        if cell.method in ("saferl", "diffusion") and cell.seed == 1:
            steps = read_steps(STORE / "evaluate" / cell.key / "episodes.parquet")
            for command, deviation in zip(
                steps["a_h"].to_pylist(), steps["deviation"].to_pylist(), strict=True
            ):
                assert deviation > 0.0 or {abs(number) for number in command} == {1.0}


def test_a_film_of_a_published_cell_needs_nothing_but_the_checkout(tmp_path):
    film, cell = tmp_path / "film.webp", "ab95264a"  # race1 s1 wasp laggy=0.7 of the second edition
    run_here(
        "replay",
        cell,
        "--episode",
        "0",
        "--every",
        "30",
        "--results",
        STORE.parent,
        "--out",
        film,
        columns=200,
        code=0,
    )
    assert film.stat().st_size > 10_000


def test_the_first_episodes_of_published_cells_are_those_of_the_whole_ones(tmp_path):
    spec, only = (
        ROOT / "specs" / "table2.yaml",
        ("--task", "formula1", "--select", "method=human,seed=1"),
    )
    done = run_here(
        "run", spec, "--results", tmp_path / "r", "--limit", "10", *only, columns=200, code=0
    )
    assert re.search(r"(?m)^0 computed, ", done.stderr), done.stderr
    run_here("run", spec, "--results", tmp_path / "r", *only, columns=200)
    rows: dict[tuple[str, int], list[dict[str, object]]] = {}
    for path in tmp_path.glob("r/store/evaluate/*/episodes.parquet"):
        for row in read_episodes([path]).to_pylist():
            rows.setdefault((row["operator"], row["episode"]), []).append(row)
    assert len(rows) == 4 * 30
    assert all(
        len(both) == 1 + (episode < 10) and both[0] == both[-1]
        for (_, episode), both in rows.items()
    )


def test_what_cuts_a_batch_is_computed(tmp_path):
    done = run_here(
        "plan", ROOT / "specs" / "table2.yaml", "--results", tmp_path, "--limit", "7", columns=200
    )
    assert "a cell is cut after whole batches of 10 (side_by_side)" in " ".join(done.output.split())
    assert "nothing to compute" not in done.output


def test_assistants_are_varied_over_the_published_models_without_training(tmp_path):
    setting = ("--set", "wasp.tau_c=0.35", "--set", "seeds=[1]", "--json")
    done = run_here(
        "plan", ROOT / "specs" / "table1.yaml", "--results", tmp_path, *setting, columns=200
    )
    nodes = json.loads(done.stdout)["nodes"]
    assert {node["kind"] for node in nodes if node["state"] == "missing"} == {
        "heldout",
        "calibration",
        "evaluate",
    }


# calibrations of training 1: whole and without rollouts, FormulaOne1 and Goal1
FIRING = ("122d45bf", "65504b38", "57463201", "9f489a32")


def test_cells_of_two_processors_and_thresholds_of_two_are_told():
    """A key is of the code, the settings and the inputs: what a processor rounds is in none."""
    processors: dict[tuple[str, int], set[str]] = {}
    thresholds: dict[tuple[str, int], set[float]] = {}
    for cell in reproduction.grid().cells:
        key = cell.key
        # an ablation of WASP as printed that is to come
        if not (STORE / "evaluate" / key).is_dir():
            continue
        manifest = json.loads((STORE / "evaluate" / key / "_manifest.json").read_text())
        kind = manifest["provenance"]["processor"].partition("(R)")[0].partition(" ")[0]
        processors.setdefault((cell.task, cell.seed), set()).add(kind)
        if cell.method == "wasp" and cell.variant != "no-rollout":
            rows = read_episodes([STORE / "evaluate" / key / "episodes.parquet"])
            thresholds.setdefault((cell.task, cell.seed), set()).update(
                round(value, 4) for value in rows["tau_r"].to_pylist()
            )
    tasks = ("race1", "formula1", "goal1")
    assert {place for place, kinds in processors.items() if kinds == {"AMD"}} == {
        *itertools.product(tasks, (3, 4, 5))
    } - {("formula1", 5)}
    assert {place for place, kinds in processors.items() if len(kinds) > 1} == {
        ("race1", 1),
        ("formula1", 2),
    }
    assert {place: found for place, found in thresholds.items() if len(found) > 1} == {
        ("formula1", 2): {0.0315, 0.0329}
    }
    found = [
        path
        for path in STORE.glob("calibration/*/calibration.json")
        if path.parent.name[:8] in FIRING
    ]
    assert sorted(f"{100 * json.loads(path.read_text())['safety_rate']:.1f}" for path in found) == [
        "0.3",
        "1.8",
        "4.6",
        "5.1",
    ]
    told = numbers_in(section(DETAILS, "Processors and thresholds"))
    assert {"0.0329", "0.0315", "1.8", "0.3", "4.6", "5.1"} <= set(told)
