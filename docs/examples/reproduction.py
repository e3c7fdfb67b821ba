"""Print the tables of REPRODUCTION.md and of docs/reproduction_details.md from the published rows:
nothing is computed anew. `reproduction_numbers.py` prints the numbers in their text.

python docs/examples/reproduction.py
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path

import assistants
import away
import curves
import numpy as np
import pyarrow.parquet as pq

from wasp_cli.cells.asked import Asked, asked_of_grid
from wasp_cli.cells.table import CellTable, paired
from wasp_cli.methods.registry import METHODS
from wasp_cli.plan.grid import lay_out
from wasp_cli.plan.offered import Listing
from wasp_cli.report.bootstrap import Estimate, contrast_of, difference_of
from wasp_cli.report.claims import Answer, Judged, any_of, judge
from wasp_cli.report.claims_text import PLAIN, sentence
from wasp_cli.report.figures import rows_by_task
from wasp_cli.report.interventions_figure import Point, points_of
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

VARIANT_TITLES = {
    "safety-only": "the safety gate only",
    "task-only": "the task gate only",
    "no-case2": "no Case II recovery",
    "no-rollout": "no rollouts (H = 1)",
}
LEFT_OUT = ("ms", "Mag.\\|int ↓", "Int. eff. ↓", "Mag. eff. ↓", "ρ > 0 (%)", "UIR eff. ↓")
HEADINGS = ("Claim", "WASP", "As printed", "Decides")


def published(spec: Spec) -> Asked:
    """Return the cells of a spec, with the keys of what is published of them and of their
    branches, by any code and libraries.
    """
    layout = Layout(PUBLISHED)
    by_recipe = {entry.recipe: entry.key for entry in Listing(layout).usable}
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


def tables() -> dict[str, list[str]]:
    """Return the tables of REPRODUCTION.md in Markdown, by the heading above them."""
    made = {
        "Table 1": main_table(frame()),
        "Table 2": ablation_table(frame()),
        "Figure 3": necessity_table(frame()),
    }
    alone = {name: [rows_alone(table)] for name, table in made.items() if table is not None}
    unseen = assistants.short(assistants.published("unseen"), "Operators that no choice has seen")
    return {
        "Table 1": alone["Table 1"],
        "What the others cost more": [costs_more()],
        "Cost at matched interventions": [matched()],
        "The 21 claims": [claims()],
        "Table 2": [*alone["Table 2"], worth()],
        "Figure 3": alone["Figure 3"],
        "Operators that no choice has seen": [unseen],
        "Mild and severe operators": [severities(), ida_by_severity()],
        "Operating curves": [curve_of_wasp()],
        "Environments of others": [environments()],
        "An error that goes on": [error_goes_on()],
        "As printed, with the paper's search": [more_search()],
    }


def details() -> dict[str, list[str]]:
    """Return the tables of docs/reproduction_details.md, by the heading above them."""
    return {
        "Each training of Table 1": [costs_by_training()],
        "Each training of the ablations as printed": [printed_by_training()],
    }


def made_of(head: Sequence[str], rows: Sequence[Sequence[str]], words: int = 2) -> str:
    """Return a Markdown table whose first columns are words, and the others numbers."""
    rules = ["---"] * words + ["---:"] * (len(head) - words)
    return "\n".join(markdown_row(line) for line in (head, rules, *rows))


def titled(rows: Sequence[tuple[str, Sequence[str]]]) -> list[list[str]]:
    """Put the title of its task before each row, once for the rows of one task."""
    lines: list[list[str]] = []
    shown = ""
    for task, row in rows:
        title = TASKS[task].title if task in TASKS else task
        lines.append(["" if title == shown else title, *row])
        shown = title
    return lines


@cache
def placed() -> dict[str, list[Point]]:
    """Return by task what Table 1's assistants cost and how often they act in effect."""
    return {task: points_of(rows) for task, rows in rows_by_task(frame()).items()}


def matched() -> str:
    """Return in Markdown the effective intervention rate and the cost of every assistant, with the
    intervals of the picture.
    """
    told: dict[str, list[str]] = {}
    for points in placed().values():
        for point in points:
            rate, cost = point.rate, point.cost
            told.setdefault(point.title, []).extend(
                (limits(rate.value, rate.limits, 2), limits(cost.value, cost.limits, 1))
            )
    titles = [TASKS[task].title for task in placed()]
    head = ["Method", *(f"{title}: {what}" for title in titles for what in ("Int. eff.", "Cost"))]
    return made_of(head, [[method, *row] for method, row in told.items()], words=1)


def limits(value: float, interval: tuple[float, float] | None, digits: int) -> str:
    """Write a number with its limits; the operators alone have none of their rate."""
    if interval is None or value == 0.0:
        return f"{value:.{digits}f}"
    low, high = interval
    return f"{value:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def worth() -> str:
    """Return in Markdown what WASP's ablations have more than the whole method, with 95 %
    intervals over trainings.
    """
    rows = [group for group in frame().groups if group.method == "wasp" and len(group.cells)]
    wholes = {group.task: group.cells for group in rows if group.variant == "full"}
    lines = []
    for group in rows:
        if group.variant == "full":
            continue
        made = {
            key: difference_of(group.cells, wholes[group.task], key)
            for key in ("return", "success", "cost", "int_rate")
        }
        success = made["success"]
        shown = [
            with_interval(made["return"]),
            "n/a" if success is None else f"{100 * success.value:+.1f}",
            with_interval(made["cost"]),
            with_interval(made["int_rate"], 3),
        ]
        lines.append((group.task, [VARIANT_TITLES[group.variant], *shown]))
    head = ("Task", "WASP with", "Return", "Succ. (points)", "Cost", "Int.")
    return made_of(head, titled(lines))


def ida_by_severity() -> str:
    """Return in Markdown what IDA costs more than WASP at each severity."""
    cells = by_severity()
    rows = []
    for task in dict.fromkeys(task for task, _, _ in cells):
        made = [
            difference_of(cells[task, "ida", level], cells[task, "wasp", level], "cost")
            for level in LEVELS
        ]
        rows.append([TASKS[task].title, *(with_interval(each, 1) for each in made)])
    head = ("IDA's cost minus WASP's", *LEVELS)
    return made_of(head, rows, words=1)


def curve_of_wasp() -> str:
    """Return in Markdown WASP's published curve: return / cost / effective intervention rate."""
    rows = pq.read_table(curves.published("field"))
    tasks = curves.shown_tasks(rows)
    lines = []
    for value in curves.KNOBS["wasp"].values:
        each = [curves.point(rows, task, "wasp", value) for task in tasks]
        numbers = (f"{at['return']:.1f} / {at['cost']:.1f} / {at['effective']:.2f}" for at in each)
        lines.append([f"{value:g}", *numbers])
    return made_of(("tau_r, times", *(TASKS[task].title for task in tasks)), lines, words=1)


def environments() -> str:
    """Return in Markdown what the published environments of others came to, and what WASP has more
    in the same episodes.
    """
    columns = ("Return ↑", "Cost ↓", "Cost/1000 ↓", "Int. ↓")
    lines = []
    for task in away.TASKS:
        cells = away.cells_of(task)
        if not len(cells):
            continue
        differences = {row[0].removeprefix("WASP - "): row[1:] for row in away.differences(cells)}
        for label, *numbers in away.table(cells):
            row = dict(zip(away.heading(cells), numbers, strict=True))
            more = differences.get(label, ("", ""))
            lines.append((task, [label, *(row[column] for column in columns), *more]))
    head = ("Environment", "Method", *columns, "WASP's return minus it", "WASP's cost minus it")
    return made_of(head, titled(lines))


def costs_by_training() -> str:
    """Return in Markdown what each assistant costs more than WASP in each training, with 95 %
    intervals over worlds.
    """
    lines: dict[tuple[str, str], list[str]] = {}
    for training in TRAININGS:
        rows = [group for group in frame((training,)).groups if group.variant == "full"]
        wholes = {group.task: group.cells for group in rows if group.method == "wasp"}
        for group in rows:
            if METHODS[group.method].impaired and group.method not in ("human", "wasp"):
                made = difference_of(group.cells, wholes[group.task], "cost")
                row = lines.setdefault((group.task, METHODS[group.method].title), [])
                row.append(with_interval(made, 1))
    rows_ = [(task, [method, *row]) for (task, method), row in lines.items()]
    return made_of(("Task", "Method", *(f"Training {each}" for each in TRAININGS)), titled(rows_))


def printed_by_training() -> str:
    """Return in Markdown what the ablations of WASP as printed cost and return more than the whole
    method in each training, with 95 % intervals over worlds.
    """
    lines: dict[tuple[str, str], list[str]] = {}
    for training in PRINTED:
        rows = [group for group in frame((training,)).groups if group.method == "printed"]
        wholes = {group.task: group.cells for group in rows if group.variant == "full"}
        for group in rows:
            if group.variant != "full":
                row = lines.setdefault((group.task, VARIANT_TITLES[group.variant]), [])
                for key in ("cost", "return"):
                    row.append(
                        with_interval(difference_of(group.cells, wholes[group.task], key), 1)
                    )
    rows_ = [(task, [variant, *row]) for (task, variant), row in lines.items()]
    head = [f"{what}, training {each}" for each in PRINTED for what in ("Cost", "Return")]
    return made_of(("Task", "As printed with", *head), titled(rows_))


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
    """Return in Markdown what WASP as printed comes to with our search and with the paper's."""
    return with_other_setting("paper-size", "printed", "Search", ("N = 64", "N = 300"))


def error_goes_on() -> str:
    """Return in Markdown what WASP comes to if its safety gate also imagines that the operator's
    error goes on.
    """
    names = ("for one decision", "for the whole horizon")
    return with_other_setting("error-lasts", "wasp", "The operator's error lasts", names)


def with_other_setting(spec: str, method: str, what: str, names: tuple[str, str]) -> str:
    """Return in Markdown what a method comes to in Table 1 and, in the same episodes, with the
    setting of another spec, with paired differences.

    Args:
        spec: the other spec.
        method: of both.
        what: is different, as the heading of a column.
        names: what the setting of Table 1 is called, and that of the spec.
    """
    lines: list[Sequence[str]] = [
        ("Task", what, *SEARCHED.values()),
        ("---", "---", *["---:"] * len(SEARCHED)),
    ]
    ours = {
        row.task: row.cells
        for row in frame((1,)).groups
        if (row.method, row.variant) == (method, "full")
    }
    for row in rows_of(spec):
        before, after = [TASKS[row.task].title, names[0]], ["", names[1]]
        for measure in SEARCHED:
            new, old = paired(row.cells, ours[row.task], measure)
            before.append(f"{summarise(old, measure).mean:.2f}")
            after.append(
                f"{summarise(new, measure).mean:.2f} "
                f"({with_interval(difference_of(new, old, measure))})"
            )
        lines += [before, after]
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
    for name, texts in (tables() | details()).items():
        print(f"## {name}\n\n" + "\n\n".join(texts) + "\n")
