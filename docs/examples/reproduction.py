"""Print the tables of REPRODUCTION.md from the published rows, the paper's claims first: nothing is
computed anew.

python docs/examples/reproduction.py
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np

from wasp_cli.cells.asked import Asked, asked_of_grid
from wasp_cli.cells.table import CellTable, paired
from wasp_cli.methods.registry import METHODS
from wasp_cli.plan.grid import lay_out
from wasp_cli.report.bootstrap import Estimate, contrast_of, difference_of
from wasp_cli.report.claims import Answer, Judged, any_of, judge
from wasp_cli.report.claims_text import PLAIN, sentence
from wasp_cli.report.render import markdown, markdown_row
from wasp_cli.report.stats import Frame, Group, read_frame, with_branches
from wasp_cli.report.summary import summarise
from wasp_cli.report.tables import Table
from wasp_cli.report.tables.comparison import necessity_table
from wasp_cli.report.tables.main import ablation_table, main_table
from wasp_cli.spec.load import load
from wasp_cli.spec.model import Spec
from wasp_cli.spec.paper import load_paper
from wasp_cli.store.layout import Layout
from wasp_cli.store.published import offers
from wasp_cli.tasks.registry import TASKS

ROOT = Path(__file__).parents[2]
PUBLISHED = ROOT / "results" / "published"
TRAININGS = (1, 2, 3, 4, 5)
# those of the ablations of WASP as printed on FormulaOne1, of which the claims are
PRINTED = (1, 2, 3)
VARIANTS = "variants=[full, safety-only, task-only, no-case2, no-rollout]"
STAGES = ("stages=[counterfactual]", "counterfactual.stride=10")
LEVELS, MEASURED = (
    ("mild", "moderate", "severe"),
    {"return": "Return {} ↑", "cost": "Cost {} ↓", "int_rate": "Int. {} ↓"},
)

SEARCHED = {"return": "Return ↑", "cost": "Cost ↓", "int_rate": "Int. ↓"}

LEFT_OUT = ("ms", "Mag.\\|int ↓", "Int. eff. ↓", "Mag. eff. ↓", "ρ > 0 (%)", "UIR eff. ↓")
HEADINGS = ("Claim", "WASP", "As printed", "Decides")


def published(spec: Spec) -> Asked:
    """Return the cells of a spec, with the keys of what is published of them and of their
    branches, by any code and libraries.
    """
    layout = Layout(PUBLISHED)
    by_recipe = {offer.recipe: offer.key for offer in offers(layout)[0]}
    grid = lay_out(spec)
    keys = {node.key: by_recipe.get(node.recipe, node.key) for node in grid.nodes}
    asked = asked_of_grid(layout, "", spec, grid)
    cells = []
    for cell in asked.cells:
        branches = None if cell.branches is None else keys[cell.branches]
        cells.append(replace(cell, key=keys[cell.key], branches=branches))
    return replace(asked, cells=tuple(cells))


@cache
def grid() -> Asked:
    """Return the cells of Tables 1 and 2, with the branches of Figure 3."""
    return published(
        load(ROOT / "specs" / "table1.yaml", (f"seeds={list(TRAININGS)}", VARIANTS, *STAGES)).spec
    )


@cache
def frame(trainings: tuple[int, ...] = TRAININGS) -> Frame:
    """Return those that are published."""
    if trainings != TRAININGS:
        whole = frame()
        return replace(
            whole,
            cells=whole.cells.where(lambda cell: cell.seed in trainings),
            missing=tuple(gap for gap in whole.missing if gap.cell.seed in trainings),
            order=tuple(cell for cell in whole.order if cell.seed in trainings),
        )
    layout = grid().layout
    return with_branches(layout, read_frame(layout, grid().cells))


def word(judged: Judged | None) -> str:
    """Return an outcome as the page prints it."""
    if judged is None or judged.outcome == "untested":
        return "n/a"
    return f"**{PLAIN['fails']}**" if judged.outcome == "fails" else PLAIN[judged.outcome]


def decides(judged: Judged) -> str:
    """Put the first comparison with the claim's outcome into words, and count those that share
    it.
    """
    deciding = [answers for answers in judged.answers if any_of(answers) == judged.outcome]
    if not deciding or judged.outcome == "untested":
        return ""
    first: Answer = next(answer for answer in deciding[0] if answer.outcome == judged.outcome)
    either = "one is enough: " if len(deciding[0]) > 1 else ""
    return f"{either}{sentence(first)}; {len(deciding)} of {len(judged.answers)} comparisons"


@cache
def verdicts() -> list[tuple[Judged, Judged | None]]:
    """Return of every claim the verdict with WASP, and the one with WASP (as printed), whose
    ablations have fewer trainings.
    """
    whole, of_ablations = (
        judge(frame(trainings), load_paper()) for trainings in (TRAININGS, PRINTED)
    )
    printed = [who.method for who in whole.others].index("printed")
    found: list[tuple[Judged, Judged | None]] = []
    for ours, fewer in zip(whole.claims, of_ablations.claims, strict=True):
        theirs = (each.others[printed] for each in (ours, fewer))
        found.append(
            (
                ours,
                next(
                    (
                        other
                        for other in theirs
                        if other is not None and other.outcome != "untested"
                    ),
                    None,
                ),
            )
        )
    return found


def claims() -> str:
    """Return the table of all claims in Markdown."""
    rows = [
        (f"{ours.claim.says} (`{ours.claim.id}`)", word(ours), word(theirs), decides(ours))
        for ours, theirs in verdicts()
    ]
    return "\n".join(markdown_row(row) for row in (HEADINGS, ["---"] * len(HEADINGS), *rows))


def tables() -> dict[str, str]:
    """Return every table of the page in Markdown, by its heading there."""
    made = {
        "Table 1": main_table(frame()),
        "Table 2": ablation_table(frame()),
        "Figure 3": necessity_table(frame()),
    }
    alone = {name: rows_alone(table) for name, table in made.items() if table is not None}
    texts = {
        "The 21 claims": claims(),
        "What the others cost more": costs_more(),
        "As printed, with the paper's search": more_search(),
    }
    return texts | {"Mild and severe operators": severities()} | alone


def costs_more() -> str:
    """Return in Markdown what each assistant costs more than WASP, with 95 % intervals over
    trainings and worlds; bold without 0 in it.
    """
    told: dict[str, dict[str, str]] = {}
    rows = [
        group
        for group in frame().groups
        if len(group.cells) and group.variant == "full" and METHODS[group.method].impaired
    ]
    wholes = {group.task: group for group in rows if group.method == "wasp"}
    for group in rows:
        contrast = contrast_of(group.cells, wholes[group.task].cells, "cost")
        if (
            group.method not in ("human", "wasp")
            and contrast is not None
            and contrast.bootstrap is not None
        ):
            low, high = contrast.bootstrap
            bold = "**" if low * high > 0 else ""
            told.setdefault(METHODS[group.method].title, {})[group.task] = (
                f"{bold}{contrast.value:+.1f} [{low:+.1f}, {high:+.1f}]{bold}"
            )
    head = ("Method", *(TASKS[task].title for task in wholes))
    lines = (
        head,
        ("---", *["---:"] * len(wholes)),
        *((method, *row.values()) for method, row in told.items()),
    )
    return "\n".join(markdown_row(line) for line in lines)


@cache
def rows_of(name: str) -> list[Group]:
    """Return the published cells of a spec, grouped; those of references are left out."""
    spec = load(ROOT / "specs" / f"{name}.yaml").spec
    asked = published(spec)
    groups = read_frame(asked.layout, asked.cells).groups
    return [group for group in groups if METHODS[group.method].impaired]


def by_severity() -> dict[tuple[str, str, str], CellTable]:
    """Return the cells of `specs/severity.yaml` by task, method and severity."""
    found: dict[tuple[str, str, str], CellTable] = {}
    for row, level in product(rows_of("severity"), LEVELS):
        severities = np.array([cell.severity or "" for cell in row.cells])
        found[row.task, row.method, level] = row.cells.choose(severities == level)
    return found


def more_search() -> str:
    """Return in Markdown what WASP as printed comes to with our search and with the paper's on
    the same worlds, with paired differences.
    """
    lines: list[Sequence[str]] = [
        ("Task", "Search", *SEARCHED.values()),
        ("---", "---", *["---:"] * len(SEARCHED)),
    ]
    ours = {
        row.task: row.cells
        for row in frame((1,)).groups
        if (row.method, row.variant) == ("printed", "full")
    }
    for row in rows_of("paper-size"):
        small, large = [TASKS[row.task].title, "N = 64"], ["", "N = 300"]
        for measure in SEARCHED:
            more, less = paired(row.cells, ours[row.task], measure)
            small.append(f"{summarise(less, measure).mean:.2f}")
            large.append(
                f"{summarise(more, measure).mean:.2f} "
                f"({with_interval(difference_of(more, less, measure))})"
            )
        lines += [small, large]
    return "\n".join(markdown_row(line) for line in lines)


def severities() -> str:
    """Return in Markdown what each assistant comes to under mild, moderate and severe
    operators: means over the operators.
    """
    columns = [(measure, level) for measure in MEASURED for level in LEVELS]
    lines: list[Sequence[str]] = [
        ("Task", "Method", *(MEASURED[measure].format(level) for measure, level in columns))
    ]
    lines.append(("---", "---", *["---:"] * len(columns)))
    for task, method in dict.fromkeys((task, method) for task, method, _ in by_severity()):
        means = (
            summarise(by_severity()[task, method, level], measure).mean
            for measure, level in columns
        )
        shown = "" if any(line[0] == TASKS[task].title for line in lines) else TASKS[task].title
        lines.append(
            (
                shown,
                METHODS[method].title,
                *("n/a" if mean is None else f"{mean:.2f}" for mean in means),
            )
        )
    return "\n".join(markdown_row(line) for line in lines)


@cache
def differences(trainings: tuple[int, ...] = TRAININGS) -> dict[str, str]:
    """Return by task and row what it has more than WASP, and an ablation more than the whole
    method: paired means with 95 % intervals.
    """
    texts: dict[str, str] = {}
    rows = [
        group
        for group in frame(trainings).groups
        if len(group.cells) and METHODS[group.method].impaired
    ]
    wholes = {(group.task, group.method): group for group in rows if group.variant == "full"}
    for group in rows:
        ablated = group.variant != "full"
        whole = wholes[group.task, group.method if ablated else "wasp"]
        name = (
            group.method
            if not ablated
            else group.variant
            if group.method == "wasp"
            else f"{group.method}/{group.variant}"
        )
        keys = () if group is whole else ("return", "success", "cost", "int_rate")
        made = {key: difference_of(group.cells, whole.cells, key) for key in keys}
        if made:
            texts[f"{group.task} {name}"] = ", ".join(
                f"{key} {with_interval(each, 3)}"
                for key, each in made.items()
                if each is not None and each.interval is not None
            )
    return texts


def with_interval(made: Estimate | None, digits: int = 2) -> str:
    """Write a difference with its 95 % interval."""
    if made is None or made.interval is None:
        return "n/a"
    return (
        f"{made.value:+.{digits}f} [{made.interval.low:+.{digits}f}, "
        f"{made.interval.high:+.{digits}f}]"
    )


def short(label: str) -> str:
    """Return a row's label in fewer words: of 20 cells it says [8/20]."""
    return label.replace("WASP (as printed),", "As printed,").replace(" of 20 cells]", "/20]")


def rows_alone(table: Table) -> str:
    """Return the rows of a table, without its notes, columns of LEFT_OUT and rows without cells."""
    head, rules, *rows = [
        [cell.strip() for cell in re.split(r"(?<!\\)\|", line[1:-1])]
        for line in markdown(table).splitlines()
        if line.startswith("|")
    ]
    kept = [i for i, heading in enumerate(head) if heading not in LEFT_OUT]
    lines, task, shown = [head, rules], "", ""
    for row in rows:
        task = row[0] or task
        if "[0 of" not in row[1]:
            lines.append(["" if task == shown else task, short(row[1]), *row[2:]])
            shown = task
    return "\n".join(f"| {' | '.join(line[i] for i in kept)} |" for line in lines)


if __name__ == "__main__":
    for name, text in tables().items():
        print(f"## {name}\n\n{text}\n")
    for trainings in dict.fromkeys((TRAININGS, *((training,) for training in TRAININGS))):
        print(f"Minus WASP, trainings {trainings}:")
        for name, text in differences(trainings).items():
            print(f"    {name}: {text}")
