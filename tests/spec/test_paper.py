"""The paper's numbers and claims: the shipped file is complete and says what the paper says,
and mistakes have places.
"""

from pathlib import Path

import pytest

from tests.commands import run_here
from tests.spec.good import mistakes
from wasp_cli.spec.paper import Comparison, Paper, Printed, Who, load_paper, paper_of
from wasp_cli.spec.read import InvalidSpec, parse

SHIPPED = (Path(__file__).parents[2] / "specs/paper.yaml").read_text(encoding="utf-8")
COLUMNS = ("return", "success", "cost", "viol", "int_rate", "mag")
METHODS = ("human", "ida", "diffusion", "saferl", "wasp")
VARIANTS = ("full", "safety-only", "task-only", "no-case2", "no-rollout")


@pytest.fixture(scope="module")
def paper() -> Paper:
    return load_paper()


def test_every_row_of_both_tables_is_there(paper):
    first, second = paper.tables
    assert first.columns == second.columns == COLUMNS
    assert {task: list(rows) for task, rows in first.rows.items()} == {
        task: [Who(method) for method in METHODS] for task in ("race1", "formula1", "goal1")
    }
    assert {task: list(rows) for task, rows in second.rows.items()} == {
        "formula1": [Who("wasp", variant) for variant in VARIANTS]
    }
    assert second.rows["formula1"][Who("wasp")] == first.rows["formula1"][Who("wasp")]


@pytest.mark.parametrize(
    ("task", "who", "column", "printed"),
    [
        ("race1", "wasp", "return", Printed(13.74, 4.15)),
        ("race1", "human", "mag", Printed(0.0)),
        ("formula1", "diffusion", "success", Printed(66.70, 25.20)),
        ("goal1", "saferl", "viol", Printed(0.07, 0.04)),
        ("goal1", "wasp", "success", Printed(56.70, 6.80)),
        ("formula1", "wasp/no-rollout", "int_rate", Printed(0.45, 0.35)),
    ],
)
def test_numbers_are_those_of_the_paper(paper, task, who, column, printed):
    method, _, variant = who.partition("/")
    assert paper.printed(task, Who(method, variant or "full"), column) == printed


def so_in_print(paper: Paper, asked: Comparison) -> bool | None:
    """Whether the printed means alone stand as a comparison says; None where they are not
    printed.
    """
    left = paper.printed(asked.task, asked.left, asked.column)
    if asked.right is None:
        assert asked.bound is not None
        return (
            None
            if left is None
            else left.mean >= asked.bound
            if asked.relation == "at_least"
            else left.mean <= asked.bound
        )
    right = paper.printed(asked.task, asked.right, asked.column)
    if left is None or right is None:
        return None
    room = asked.margin * abs(right.mean)
    return {
        "lower": left.mean < right.mean - room,
        "higher": left.mean > right.mean + room,
        "not_lower": left.mean >= right.mean - room,
        "not_higher": left.mean <= right.mean + room,
    }[asked.relation]


def test_claims_are_what_the_printed_numbers_show(paper):
    """Only two sentences say more than the tables do; everything else that was read into a
    sentence is in the tables.
    """
    against: dict[str, set[tuple[str, str]]] = {}
    for claim in paper.claims:
        for question in claim.questions():
            answers = [so_in_print(paper, asked) for asked in question]
            if answers and not any(answer is not False for answer in answers):
                against.setdefault(claim.id, set()).update(
                    (asked.task, asked.column) for asked in question
                )
    assert against == {
        "fewer-and-smaller": {("race1", "mag"), ("goal1", "int_rate"), ("goal1", "mag")},
        "fewer-or-smaller-than-ida": {("goal1", "int_rate"), ("goal1", "mag")},
    }


def test_every_claim_is_asked_of_rows_that_a_shipped_spec_has(paper):
    assert len({claim.id for claim in paper.claims}) == len(paper.claims) >= 20
    for claim in paper.claims:
        for asked in (asked for question in claim.questions() for asked in question):
            ablation = {asked.left.variant, asked.right.variant if asked.right else "full"} != {
                "full"
            }
            assert asked.task == "formula1" if ablation else asked.left.method in METHODS
            assert asked.task == "race1" or asked.column in COLUMNS


def problems(text: str) -> list[tuple[int, int, str, str | None]]:
    with pytest.raises(InvalidSpec) as caught:
        paper_of(parse(text, "paper.yaml"))
    return [
        (problem.position.line, problem.position.column, problem.message, problem.hint)
        for problem in caught.value.problems
    ]


GOOD = """\
title: A paper
tables:
  - name: Table 1
    columns: [return, cost]
    rows:
      goal1:
        human: [1.0 ± 2.0, 3]
        wasp/no-case2: [-1.5, 0.25 ± 0.5]
claims:
  - id: first
    section: "1"
    says: It is better.
    statements:
      - {tasks: [goal1], columns: [cost], left: [wasp], relation: lower, right: [human]}
      - {tasks: [goal1], columns: [cost], left: [wasp], relation: at_most, bound: 3}
"""


@pytest.mark.parametrize(
    ("old", "new", "expected"), mistakes("paper: a mistake has its place and its remedy")
)
def test_a_mistake_has_its_place_and_its_remedy(old, new, expected):
    assert expected in problems(GOOD.replace(old, new, 1))


@pytest.mark.parametrize(
    ("change", "code"),
    [(lambda text: text, 0), (lambda text: text.replace("relation", "relatoin", 1), 3)],
)
def test_check_takes_a_paper(tmp_path, change, code):
    path = tmp_path / "paper.yaml"
    path.write_text(change(SHIPPED), encoding="utf-8")
    done = run_here("check", path, columns=200, code=code)
    if code:
        assert "did you mean 'relation'?" in done.stderr
    else:
        assert done.stdout == f"{path}: ok, 20 printed rows, {len(load_paper().claims)} claims\n"
