"""Print the numbers in the text of REPRODUCTION.md, of docs/reproduction_details.md and beside
README's pictures, by heading, from the published rows. The tables are those of `reproduction.py`.

python docs/examples/reproduction_numbers.py
"""

from __future__ import annotations

import json
import math
import statistics
from collections import Counter
from collections.abc import Iterable, Sequence

import curves
import pyarrow.parquet as pq
import reproduction

from wasp_cli.cells.table import CellTable
from wasp_cli.methods.registry import METHODS
from wasp_cli.report.bootstrap import Contrast, contrast_of, difference_of
from wasp_cli.report.claims import Answer
from wasp_cli.report.tables.comparison import necessity_table
from wasp_cli.store.tables import CellIdentity, read_steps

TASKS = ("race1", "formula1", "goal1")
STORE = reproduction.PUBLISHED / "store"
Numbers = dict[str, list[str]]
"""What the numbers say, and the numbers as the page writes them."""


def cells_of(task: str, method: str, variant: str = "full") -> CellTable:
    """Return the published cells of one row of Table 1 or 2."""
    row = (task, method, variant)
    for group in reproduction.frame().groups:
        if group.assistant == row:
            return group.cells
    raise ValueError(f"no row of {task}, {method}, {variant}")


def pooled(cells: CellTable, key: str) -> list[float]:
    """Return a measure of each cell."""
    return [float(value) for value in cells.pooled(key)]


def mean(task: str, method: str, key: str, variant: str = "full") -> float:
    """Return the mean of a measure over the cells of a row."""
    return statistics.mean(pooled(cells_of(task, method, variant), key))


def assistants() -> list[str]:
    """Return the assistants of Table 1."""
    named = dict.fromkeys(group.method for group in reproduction.frame().groups)
    return [name for name in named if METHODS[name].impaired and name != "human"]


def percents(values: Iterable[float]) -> list[str]:
    """Write shares as whole percents."""
    return [f"{100 * value:.0f}" for value in values]


def outcomes(as_printed: bool) -> Counter[str]:
    """Count the verdicts with WASP, or with WASP as printed."""
    judged = (pair[as_printed] for pair in reproduction.verdicts())
    return Counter(reproduction.word(each).strip("*") for each in judged)


def cost_shares() -> list[str]:
    """Return what WASP costs in percent of IDA's cost, on each task."""
    return percents(mean(task, "wasp", "cost") / mean(task, "ida", "cost") for task in TASKS)


def kept() -> list[str]:
    """Return WASP's return in percent of the best assistant's, on each task."""
    best = [max(mean(task, each, "return") for each in assistants()) for task in TASKS]
    return percents(
        mean(task, "wasp", "return") / most for task, most in zip(TASKS, best, strict=True)
    )


def changed(*methods: str) -> list[float]:
    """Return the shares of the commands that assistants change, over all tasks."""
    return [mean(task, method, "int_rate") for method in methods for task in TASKS]


def effective(method: str) -> list[str]:
    """Return the effective intervention rate in percent, on each task."""
    return percents(mean(task, method, "int_eff") for task in TASKS)


def more(
    task: str,
    method: str,
    key: str,
    variant: str = "full",
    to: tuple[str, str] = ("wasp", "full"),
    training: int | None = None,
) -> tuple[float, str]:
    """Return what a row has more than another one, and its 95 % interval."""
    own, other = (
        cells.where(lambda cell: training in (None, cell.training))
        for cells in (cells_of(task, method, variant), cells_of(task, *to))
    )
    made = difference_of(own, other, key)
    if made is None or made.interval is None:
        raise ValueError(f"{task} {method} {variant} shares no worlds with {to}")
    low = made.interval.low
    high = made.interval.high
    if made.value < 0:
        low, high = -high, -low
    return abs(made.value), f"[{low:.1f}, {high:.1f}]"


def best_kept_in_range() -> tuple[str, str]:
    """Return the least and the largest share of the best return that WASP keeps."""
    shares = sorted(kept(), key=int)
    return shares[0], shares[-1]


def in_short() -> Numbers:
    """The ten sentences at the top."""
    ours = outcomes(False)
    printed = outcomes(True)
    stepwise = changed("diffusion", "csa", "saferl")
    return {
        "assistants beside WASP": [str(len(assistants()) - 1)],
        "claims": [str(sum(ours.values()))],
        "verdicts with WASP": [str(ours[word]) for word in ("holds", "does not hold", "undecided")],
        "verdicts as printed": [
            str(printed[word]) for word in ("holds", "does not hold", "undecided")
        ],
        "cost in % of IDA's": cost_shares(),
        "return in % of the best": kept(),
        "commands changed in %": percents(changed("wasp")),
        "commands changed by Diffusion, CSA and SafeRL-Res": percents(
            (min(stepwise), max(stepwise))
        ),
        "tasks times trainings": [str(len(TASKS) * len(reproduction.TRAININGS))],
        "IDA's return more on Goal1": [f"{more('goal1', 'ida', 'return')[0]:.1f}"],
    }


def table_1() -> Numbers:
    """What Table 1 says of single trainings and rows."""
    second = reproduction.frame((2,)).cells
    identities = [cell.identity for cell in second]
    hardly_moving = [
        identities.index(CellIdentity("race1", method, "full", "limited-skill", 0.25, 2))
        for method in ("human", "wasp")
    ]
    returned = second.pooled("return")[hardly_moving]
    cost = second.pooled("cost")[hardly_moving]
    manifests = [
        json.loads(path.read_text()) for path in STORE.glob("diagnostics/*/_manifest.json")
    ]
    (foreseen,) = (
        manifest["summary"]["auprc@15"]
        for manifest in manifests
        if manifest["label"] == "race1 s2 diagnostics"
    )
    weak = [(task, method) for task in TASKS for method in ("filter", "reach", "mpmi")]
    shares = [
        mean(task, method, "return") / mean(task, "wasp", "return")
        for task, method in [*weak, ("formula1", "printed")]
    ]
    guarded = more("race1", "ida-guarded", "cost", training=2)
    diffusion = more("race1", "diffusion", "cost", training=2)
    less = mean("formula1", "wasp", "return") - mean("formula1", "ida-guarded", "return")
    return {
        "trainings": [str(len(TASKS) * len(reproduction.TRAININGS))],
        "IDA + safety gate costs less in training 2 of Race1": [f"{guarded[0]:.1f} {guarded[1]}"],
        "Diffusion costs less there": [f"{diffusion[0]:.1f} {diffusion[1]}"],
        "AUPRC at step 15 there": ["15", f"{foreseen:.2f}"],
        "limited skill there: return and cost": [
            f"{returned[0]:.1f}",
            f"{returned[1]:.1f}",
            f"{cost[1]:.1f}",
        ],
        "IDA on Goal1: return more, cost": [
            f"{more('goal1', 'ida', 'return')[0]:.1f}",
            f"{mean('goal1', 'ida', 'cost') / mean('goal1', 'wasp', 'cost'):.1f}",
        ],
        "IDA + safety gate on FormulaOne1": [f"{less:.1f}"],
        "filters' return in % of WASP's": percents((min(shares), max(shares))),
    }


def interventions() -> Numbers:
    """What the picture of costs at matched interventions shows."""
    rows = pq.read_table(curves.published("field"))

    def costs(task: str, method: str) -> list[float]:
        values = curves.KNOBS[method].values
        return [curves.point(rows, task, method, value)["cost"] for value in values]

    return {
        "effective rates": [*effective("ida"), *effective("ida-guarded"), *effective("wasp")],
        "cost in % of IDA's": [*cost_shares(), *guarded_shares()],
        "Diffusion and CSA on the cars": [*effective("diffusion")[:2], *effective("csa")[:2]],
        "IDA's least cost on its curve": [f"{min(costs(task, 'ida')):.1f}" for task in TASKS],
        "WASP's highest cost on its curve": [f"{max(costs(task, 'wasp')):.1f}" for task in TASKS],
    }


def guarded_shares() -> list[str]:
    """Return what IDA behind the safety gate costs in percent of IDA's cost, on each task."""
    return percents(mean(task, "ida-guarded", "cost") / mean(task, "ida", "cost") for task in TASKS)


def answers_of(claim: str, outcome: str) -> list[Answer]:
    """Return the comparisons of a claim that have an outcome."""
    (judged,) = (ours for ours, _ in reproduction.verdicts() if ours.claim.id == claim)
    return [each for answers in judged.answers for each in answers if each.outcome == outcome]


def claims() -> Numbers:
    """What the table of the claims shows, and the example of how it is read."""
    ours, printed = outcomes(False), outcomes(True)
    (open_,) = answers_of("performance-preserved", "undecided")
    contrast = reproduction.sentence(open_).split("; ")[1].split()[0].lstrip("+")
    return {
        "verdicts": [
            str(each[word])
            for each in (ours, printed)
            for word in ("holds", "does not hold", "undecided")
        ],
        "margins": ["0.1"],
        "how a contrast is read": [
            f"{100 * open_.left:.1f}",
            f"{100 * open_.right:.1f}",
            contrast,
        ],
    }


def causes() -> Numbers:
    """Why claims fail or stay open."""
    (violations,) = (
        each
        for each in answers_of("fewer-violations", "undecided")
        if each.asked.right is not None
        and each.asked.task == "race1"
        and "saferl" in repr(each.asked.right)
    )
    (smaller,) = answers_of("less-than-stepwise-correction", "fails")
    (fewer,) = answers_of("fewer-and-smaller", "fails")
    (between,) = answers_of("ida-between", "undecided")
    size = mean("goal1", "wasp", "mag", "task-only")
    by_operator = safety_gate_alone()
    left = commands_left()
    saferl = changed("saferl")
    ablated = cells_of("formula1", "wasp", "no-case2")
    whole = cells_of("formula1", "wasp")
    per_training = [
        statistics.mean(pooled(ablated.choose(ablated.trainings == training), "cost"))
        - statistics.mean(pooled(whole.choose(whole.trainings == training), "cost"))
        for training in reproduction.TRAININGS
    ]
    return {
        "commands left to the operator on Race1, in %": percents(
            [1 - mean("race1", "wasp", "int_rate")]
        ),
        "violations on Race1": [f"{violations.left:.3f}", f"{violations.right:.3f}"],
        "Diffusion on Race1": [
            f"{more('race1', 'diffusion', 'cost', training=2)[0]:.1f}",
            f"{more('race1', 'diffusion', 'cost', training=3)[0]:.1f}",
        ],
        "success on Goal1": [
            f"{100 * mean('goal1', 'wasp', 'success'):.1f}",
            f"{100 * mean('goal1', 'ida', 'success'):.1f}",
            f"{100 * mean('goal1', 'wasp', 'success', 'task-only'):.1f}",
        ],
        "cost that the safety gate avoids on Goal1": [
            f"{more('goal1', 'wasp', 'cost', 'task-only')[0]:.1f}"
        ],
        "rho": [f"{between.left:.3f}", f"{between.right:.3f}"],
        "rho of IDA above SafeRL-Res's": more_risk(),
        "safety gate on FormulaOne1, in %": [
            f"{100 * mean('formula1', 'wasp', 'safety_gate'):.1f}",
            f"{100 * mean('formula1', 'wasp', 'safety_gate', 'no-rollout'):.1f}",
        ],
        "cost without Case II on FormulaOne1": [
            f"{max(per_training):.1f}",
            f"{sorted(per_training)[-2]:.1f}",
        ],
        "cost without Case II elsewhere": [
            "{:.1f} {}".format(*more(task, "wasp", "cost", "no-case2"))
            for task in ("race1", "goal1")
        ],
        "return without rollouts": [
            "{:.1f} {}".format(*more("formula1", "wasp", "return", "no-rollout"))
        ],
        "commands changed on Goal1, in %": [
            *percents((fewer.left, fewer.right)),
            *percents([mean("goal1", "wasp", "int_rate", "task-only")]),
        ],
        "magnitude below SafeRL-Res's, in %": percents(
            (1 - smaller.left / smaller.right, 1 - size / smaller.right)
        ),
        "commands changed in %": [
            *percents((min(saferl), max(saferl))),
            *dict.fromkeys(percents(changed("diffusion"))),
        ],
        "commands left as they were": [
            f"{each[False]} of {each.total():,}" for each in left.values()
        ],
        "safety gate alone on FormulaOne1": by_operator,
        "as printed: returns": [
            f"{mean(task, method, 'return'):.1f}"
            for method in ("printed", "human")
            for task in ("formula1", "goal1", "race1")
        ],
        "as printed: UIR on Race1": necessity("race1", "printed", "uir"),
        "as printed: without rollouts on FormulaOne1": printed_without_rollouts(),
    }


def risk_above(operators: Sequence[str]) -> Contrast:
    """Return how much higher the risk at IDA's interventions on Race1 is than at those of
    SafeRL-Res, with some of the operators.
    """
    own, other = (
        cells_of("race1", method).where(lambda cell: cell.operator in operators)
        for method in ("ida", "saferl")
    )
    made = contrast_of(own, other, "rho")
    if made is None:
        raise ValueError(f"IDA and SafeRL-Res share no branches with {operators}")
    return made


def more_risk() -> list[str]:
    """Return `risk_above`: with laggy operators, with its hierarchical interval; with one of the
    others, the most; in a training, the least and the most.
    """
    laggy = risk_above(["laggy"])
    others = ["limited-skill", "noisy", "reaction-time"]
    by_training = risk_above(["laggy", *others]).trainings
    most = max(risk_above([name]).value for name in others)
    low, high = laggy.bootstrap or (math.nan, math.nan)
    return [
        f"{laggy.value:.3f} [{low:.3f}, {high:.3f}]",
        *(f"{value:.3f}" for value in (most, min(by_training), max(by_training))),
    ]


def safety_gate_alone() -> list[str]:
    """Return what the safety gate alone costs more on FormulaOne1 under laggy operators and those
    of limited skill, and how often it fires under these, alone and in the whole method, in percent.
    """
    found = []
    for operator in ("laggy", "limited-skill"):
        alone, whole = (
            cells_of("formula1", "wasp", variant).where(
                lambda cell, operator=operator: cell.operator == operator
            )
            for variant in ("safety-only", "full")
        )
        pairs = zip(pooled(alone, "cost"), pooled(whole, "cost"), strict=True)
        found.append(f"{statistics.mean(one - two for one, two in pairs):.1f}")
    rates = [statistics.mean(pooled(each, "safety_gate")) for each in (alone, whole)]
    return [*found, *(f"{100 * rate:.1f}" for rate in rates)]


def commands_left() -> dict[str, Counter[bool]]:
    """Count in the first episodes of training 1 the commands that stepwise assistants changed
    (True) and left as they were (False).
    """
    counts = {method: Counter[bool]() for method in ("saferl", "diffusion")}
    for cell in reproduction.grid().cells:
        if cell.method in counts and cell.seed == 1:
            steps = read_steps(STORE / "evaluate" / cell.key / "episodes.parquet")
            counts[cell.method].update(each > 0.0 for each in steps["deviation"].to_pylist())
    return counts


def necessity(task: str, method: str, key: str, training: int | None = None) -> list[str]:
    """Return a number of Figure 3 in all trainings, or in one with its interval."""
    frame = reproduction.frame() if training is None else reproduction.frame((training,))
    table = necessity_table(frame)
    if table is None:
        return []
    column = [each.key for each in table.columns].index(key)
    title = METHODS[method].title
    (found,) = (
        row.values[column]
        for row in table.rows
        if row.labels[0] == reproduction.TASKS[task].title
        and row.labels[1].partition(" [")[0] == title
    )
    if found.mean is None:
        return []
    if training is None or found.interval is None:
        return [f"{found.mean:.2f}"]
    return [f"{found.mean:.2f} [{found.interval.low:.2f}, {found.interval.high:.2f}]"]


def printed_without_rollouts() -> list[str]:
    """Return on FormulaOne1 cost, and decisions in percent at which the task gate fires, without
    and with rollouts, in the trainings that have both.
    """
    kinds = [
        cells_of("formula1", "printed", variant).where(
            lambda cell: cell.training in reproduction.PRINTED
        )
        for variant in ("no-rollout", "full")
    ]
    costs = [f"{statistics.mean(pooled(kind, 'cost')):.2f}" for kind in kinds]
    gates = percents(statistics.mean(pooled(kind, "task_gate")) for kind in kinds)
    return [*costs, *gates]


def figure_3() -> Numbers:
    """What Figure 3 shows of WASP."""
    swapped = [
        float(necessity(task, "wasp", "uir_swapped")[0]) - float(necessity(task, "wasp", "uir")[0])
        for task in TASKS
    ]
    return {
        "UIR swapped minus UIR": [f"{min(swapped):.2f}", f"{max(swapped):.2f}"],
        "cost avoided on FormulaOne1": [
            *necessity("formula1", "wasp", "delta_c", 1),
            *necessity("formula1", "wasp", "delta_c", 5),
        ],
        "UIR on Goal1 in training 2": [
            *necessity("goal1", "wasp", "uir", 2),
            *necessity("goal1", "ida", "uir", 2),
        ],
    }


def severities() -> Numbers:
    """What severe operators change."""
    cells = reproduction.by_severity()
    made = difference_of(
        cells["race1", "diffusion", "severe"], cells["race1", "wasp", "severe"], "return"
    )
    if made is None or made.interval is None:
        return {}
    return {
        "Diffusion's return more on Race1": [
            f"{made.value:.1f} [{made.interval.low:.1f}, {made.interval.high:.1f}]"
        ]
    }


def readme() -> Numbers:
    """The numbers beside README's pictures."""
    rates = percents(changed("wasp"))
    less = mean("formula1", "wasp", "return") - mean("formula1", "ida-guarded", "return")
    return {
        "return in % of the best": list(best_kept_in_range()),
        "cost in % of IDA's": [*cost_shares(), *guarded_shares()],
        "commands changed in %": [min(rates, key=int), max(rates, key=int)],
        "effective rates in %": [*effective("ida"), *effective("ida-guarded"), *effective("wasp")],
        "IDA + safety gate on FormulaOne1": [f"{less:.1f}"],
        "claims": [str(sum(outcomes(False).values()))],
    }


def contrasts(task: str, key: str = "cost") -> dict[str, tuple[float, float]]:
    """Return the hierarchical interval of what each assistant has more than WASP."""
    found = {}
    for method in assistants():
        made = contrast_of(cells_of(task, method), cells_of(task, "wasp"), key)
        if method != "wasp" and made is not None and made.bootstrap is not None:
            found[method] = made.bootstrap
    return found


def numbers() -> dict[str, Numbers]:
    """Return the numbers in the text of REPRODUCTION.md, by heading."""
    return {
        "In short": in_short(),
        "Table 1": table_1(),
        "Cost at matched interventions": interventions(),
        "The 21 claims": claims(),
        "Why claims fail or stay open": causes(),
        "Figure 3": figure_3(),
        "Mild and severe operators": severities(),
    }


if __name__ == "__main__":
    for heading, told in (numbers() | {"README": readme()}).items():
        print(f"## {heading}\n")
        for what, found in told.items():
            print(f"{what}: {', '.join(found)}")
        print()
