"""How sure the numbers of Table 1 are, and how the methods compare with a reference: `statistics`, and `statistics_best`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import groupby

from wasp_cli.methods.registry import METHODS
from wasp_cli.report.bootstrap import RESAMPLES, Estimate, difference_of, improvement_over, iqm_of, mean_of
from wasp_cli.report.frame import Frame, Group
from wasp_cli.report.main_table import PAPER_COLUMNS, full_groups, missing_notes, part_of
from wasp_cli.report.statistics import distinct_resamples
from wasp_cli.report.table import UNDEFINED, Column, Row, Table, Value
from wasp_cli.report.titles import assistant_title, task_title

HUMAN = "human"
OURS = "wasp"
BEST = "best"
"""As a reference: for each task and measure on its own, the complete method other than WASP that has the best mean; also Human-only."""

MEASURES = tuple(column for column in PAPER_COLUMNS if column.key in ("return", "success", "cost", "viol"))
PROBABILITY = Column("improvement", "P(better)")


def comparison_table(frame: Frame, reference: str = HUMAN) -> Table | None:
    """Per task, measure and method: mean, interquartile mean, paired difference to a reference and probability of improvement over it.

    Args:
        frame: the cells; ablations are left out.
        reference: a method, or BEST.

    Returns:
        All with intervals (`report.bootstrap`); None without any readable cell.
    """
    if not frame.cells:
        return None
    rows, chosen = [], []
    for task, of_task in groupby(full_groups(frame), lambda group: group.task):
        found = list(of_task)
        for measure in MEASURES:
            other = _reference(found, measure, reference)
            if other is not None:
                chosen.append((task, measure, other))
            rows += [_row(group, other, measure) for group in found]
    against = "best other method" if reference == BEST else METHODS[reference].title
    difference = Column("difference", f"Difference to {against}", signed=True)
    columns = (Column("mean", "Mean"), Column("iqm", "IQM"), difference, PROBABILITY)
    notes = (*_interval_notes(rows), *_reference_notes(chosen, reference), *missing_notes(frame))
    meanings = (
        "Mean is that of the main table. IQM is the mean of the middle half of the cells (operator variants x severities x seeds): one "
        "cell that is far off does not carry it. The difference is paired, over the operators, severities and seeds that both have.",
        "P(better) is the probability that an episode is better than one of the reference under the same operator, severity and seed, "
        "ties one half: 0.5 is no difference.",
    )
    name, title = ("statistics_best", "Compared with the best other method") if reference == BEST else ("statistics", "How sure")
    return Table(name, title, ("Task", "Measure", "Method"), columns, tuple(rows), notes, meanings, grouping=2)


def _reference(found: Sequence[Group], measure: Column, reference: str) -> Group | None:
    """What the methods of a task are compared with."""
    if reference != BEST:
        return next((group for group in found if group.method == reference and group.cells), None)
    rivals = [group for group in found if group.method != OURS and METHODS[group.method].impaired and group.complete]
    means = [(part_of(group, group.cells, measure).mean, group) for group in rivals]
    sign = 1.0 if measure.better == "up" else -1.0
    return max(((sign * mean, group) for mean, group in means if mean is not None), key=lambda pair: pair[0], default=(0.0, None))[1]


def _row(group: Group, other: Group | None, measure: Column) -> Row:
    marked = part_of(group, group.cells, measure)
    numbers = [_value(mean_of(group.cells, measure.key), marked), _value(iqm_of(group.cells, measure.key), marked)]
    if other is None or other is group or measure.better is None:
        numbers += [UNDEFINED, UNDEFINED]
    else:
        plain = replace(marked, ranked=False)
        numbers.append(_value(difference_of(group.cells, other.cells, measure.key), plain))
        numbers.append(_value(improvement_over(group.cells, other.cells, measure.key, measure.better), plain))
    task, method = task_title(group.task), assistant_title(group)
    columns = (measure, measure, replace(measure, signed=True), PROBABILITY)
    return Row((task, measure.heading, method), tuple(numbers), columns, names=(task, measure.key, method))


def _value(estimate: Estimate | None, like: Value) -> Value:
    return UNDEFINED if estimate is None else Value(estimate.value, n=like.n, ranked=like.ranked, interval=estimate.interval)


def _interval_notes(rows: Sequence[Row]) -> Iterator[str]:
    """What the intervals resample, how coarse that is, and that they are many."""
    found = [value.interval for row in rows for value in row.values if value.interval is not None]
    if not found:
        yield "No intervals: there is a single world to resample."
        return
    seeds = sorted({interval.clusters for interval in found if interval.unit == "seed"})
    worlds = sorted({interval.clusters for interval in found if interval.unit == "world"})
    yield f"[low, high] are 95 % intervals of a bootstrap with {RESAMPLES} resamples."
    for count in seeds:
        coarse = ", so they are coarse" if count < 6 else ""
        yield f"Resampled are {count} seeds, each with its models and worlds; {distinct_resamples(count):,} resamples differ{coarse}."
    if worlds:
        counts = " or ".join(map(str, worlds))
        yield f"Resampled are the {counts} worlds of one seed: intervals tell of other worlds for the same models, not of another training."
    yield f"These are {len(found)} intervals; of so many some miss even where nothing differs. Decide beforehand which comparison counts."


def _reference_notes(chosen: Sequence[tuple[str, Column, Group]], reference: str) -> Iterator[str]:
    """Who is the reference, and what choosing it does."""
    if not chosen:
        yield "The reference has no cells here, so that nothing is compared with it."
    elif reference == BEST:
        for task, found in groupby(chosen, lambda each: each[0]):
            named = ", ".join(f"{measure.title} {assistant_title(group)}" for _, measure, group in found)
            yield f"Best other methods on {task_title(task)}: {named}."
        yield "They were chosen on these very episodes, which flatters them a little."
