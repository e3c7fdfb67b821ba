"""How good the trained parts are, per task; and of single parts what a dataset holds, what is foreseen of it, what a denoiser does."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from wasp_cli.plan.node import Part
from wasp_cli.plan.reasons import few
from wasp_cli.report.render import markdown
from wasp_cli.report.summary import Value, over_seeds
from wasp_cli.report.tables.table import Column, Row, Table, task_title
from wasp_cli.report.trained.parts import UNREADABLE, Trained, read_json
from wasp_cli.store.layout import Layout

COLUMNS = (  # stage and the number of its summary. Stages that do not tell a number leave its column out.
    ("expert", Column("return", "Expert return", digits=1)),
    ("expert", Column("cost", "Expert cost", digits=1)),
    ("expert", Column("success", "Expert succ. (%)", digits=0, scale=100.0, spread=False)),
    ("expert", Column("accepted", "Expert accepted (%)", digits=0, scale=100.0, spread=False, optional=True)),
    ("dataset", Column("costly_share", "Costly data (%)", digits=1, scale=100.0, spread=False)),
    ("policies", Column("return", "Latent return", digits=1)),
    ("policies", Column("privileged_return", "privileged", digits=1, spread=False, optional=True)),
    ("policies", Column("cost", "Latent cost", digits=1)),
    ("policies", Column("privileged_cost", "privileged", digits=1, spread=False, optional=True)),
    ("critics", Column("rank_r", "rank V_r")),
    ("critics", Column("predicted_over_real_r", "V_r / real", optional=True)),
    ("critics", Column("rank_c", "rank V_c")),
    ("critics", Column("predicted_over_real_c", "V_c / real", optional=True)),
)
MEASURES = (  # numbers of `diagnostics`, each for some imagined steps: `auprc@5`
    Column("auprc", "Cost AUPRC"),
    Column("persistence", "Cost AUPRC, persistence"),
    Column("unseen_auprc", "Cost AUPRC, operators not in the data"),
    Column("base", "Cost base rate"),
    Column("predicted_over_base", "Cost predicted / base rate"),
    Column("recall", "Cost recall"),
    Column("reward_r2", "Reward R²"),
)
STEPS = (1, 5, 10, 15)
NAMED = 6  # missing parts that a note names; the plan names all
Key = tuple[str, str]  # task and stage of a part


@dataclass(frozen=True)
class _Training:
    """The parts that a run trains, one for each seed of a task and stage, and what those say that are there."""

    wanted: Mapping[Key, list[Part]]
    summaries: Mapping[Part, Mapping[str, Any]]
    failures: Mapping[Part, str]  # why a part is not there, where that is known

    @property
    def tasks(self) -> list[str]:
        return list(dict.fromkeys(task for task, _ in self.wanted))

    def parts(self, task: str, stage: str) -> list[Part]:
        return self.wanted.get((task, stage), [])

    def value(self, parts: Sequence[Part], name: str) -> Value:
        told = (self.summaries.get(part, {}).get(name) for part in parts)
        numbers = [float(number) for number in told if isinstance(number, int | float) and math.isfinite(number)]
        return over_seeds(numbers, ranked=False)

    def tells(self, parts: Sequence[Part], name: str) -> bool:
        """Whether a part knows the number, be it undefined."""
        return any(name in self.summaries.get(part, {}) for part in parts)

    def missing(self, parts: Sequence[Part]) -> list[Part]:
        return [part for part in parts if part not in self.summaries]


def training_tables(
    parts: Sequence[tuple[Part, str]], trained: Sequence[Trained], failures: Mapping[str, str] | None = None
) -> list[Table]:
    summaries, why = {artifact.key: artifact.summary for artifact in trained}, failures or {}
    by_stage: dict[Key, list[Part]] = {}
    for part, _ in parts:
        by_stage.setdefault((part.task, part.kind), []).append(part)
    told = {part: summaries[key] for part, key in parts if key in summaries}
    training = _Training(by_stage, told, {part: why[key] for part, key in parts if key in why})
    tables = (_stages(training, _incomplete(training)), _ahead(training))
    return [table for table in tables if table.rows and table.columns]


def _stages(training: _Training, notes: tuple[str, ...]) -> Table:
    columns, shown = [], []
    for stage, column in COLUMNS:
        read = [training.parts(task, stage) for task in training.tasks]
        # A number that no part tells is no column; one that is still to come is.
        if any(training.missing(own) or training.tells(own, column.key) for own in read):
            columns.append(replace(column, key=f"{stage}.{column.key}"))
            shown.append([training.value(own, column.key) for own in read])
    rows = []
    stages = dict.fromkeys(stage for stage, _ in COLUMNS)
    for i, task in enumerate(training.tasks):
        own = [part for stage in stages for part in training.parts(task, stage)]
        rows.append(Row((task_title(task) + _share(training, own),), tuple(values[i] for values in shown)))
    meanings = (
        "The latent expert drives by the world model's filter; beside it the privileged one that it was distilled from. rank: correlation "
        "of a critic with the discounted sum that really followed in held-out episodes, whose time limit cuts some of it off; / real: the "
        "mean of the critic over that of these sums.",
    )
    return Table("training", "Trained parts", ("Task",), tuple(columns), tuple(rows), notes, meanings, ranked=False)


def _ahead(training: _Training) -> Table:
    rows = []
    for task in training.tasks:
        judges = training.parts(task, "diagnostics")
        share = _share(training, judges)
        for measure in MEASURES:
            names = [f"{measure.key}@{step}" for step in STEPS]
            values = [training.value(judges, name) for name in names]
            told = any(training.tells(judges, name) for name in names)
            # A measure that no part tells is no row; of what is still to come there is one.
            if told or (share and measure is MEASURES[0]):
                rows.append(Row((task_title(task), measure.title + share), tuple(values)))
    kept = [i for i in range(len(STEPS)) if any(row.values[i].mean is not None for row in rows)] or range(len(STEPS))
    return Table(
        "world_model",
        "World model, imagined steps ahead",
        ("Task", "Measure"),
        tuple(Column(f"step_{STEPS[i]}", str(STEPS[i]), digits=3) for i in kept),
        tuple(Row(row.labels, tuple(row.values[i] for i in kept)) for row in rows),
        meanings=("On held-out episodes. Persistence says that the cost stays what it is now.",),
        ranked=False,
    )


def _incomplete(training: _Training) -> tuple[str, ...]:
    everything = [part for parts in training.wanted.values() for part in parts]
    absent = training.missing(everything)
    if not absent:
        return ()
    absent.sort(key=lambda part: part not in training.failures)  # what failed explains the rest
    names = [f"{part} ({training.failures[part]})" if part in training.failures else str(part) for part in absent]
    return (f"INCOMPLETE: {len(absent)} of {len(everything)} parts are missing: {few(names, NAMED)}.",)


def _share(training: _Training, parts: Sequence[Part]) -> str:
    absent = len(training.missing(parts))
    return f" [{len(parts) - absent} of {len(parts)} parts]" if absent else ""


ALL = "all"  # the row of a dataset's contents that has all behaviours
COSTLY_SHARE = (0.03, 0.15)
"""Share of costly decision steps that a dataset should have: with less a model learns no cost, with more nothing of driving well."""
SETS = {"held_out": "Held-out episodes of the dataset", "unseen": "Fresh episodes under operators that are not in the dataset"}


def _percent(key: str, title: str, digits: int = 0) -> Column:
    return Column(key, f"{title} (%)", digits=digits, scale=100.0)


CONTENTS = (
    Column("episodes", "Episodes", digits=0), _percent("share", "Share"), Column("steps", "Steps", digits=0),
    Column("return_per_episode", "Return"), Column("goals_per_episode", "Goals"), _percent("with_goal", "With a goal"),
    _percent("terminal", "Ended by rule"), Column("cost_per_episode", "Cost", digits=1), _percent("costly_share", "Costly steps", 2),
)  # fmt: skip
FORESEEN = tuple(
    Column(key, title, digits=digits)
    for key, title, digits in (
        ("base", "Base rate", 3), ("auprc", "AUPRC", 3), ("auprc_low", "from", 3), ("auprc_high", "to", 3),
        ("persistence", "Persistence", 3), ("recall", "Recall", 3), ("predicted_over_base", "Predicted / base", 2),
        ("calibration_error", "ECE", 3), ("onset_base", "Onset base", 3), ("onset_auprc", "Onset AUPRC", 3), ("foreseen", "Foreseen", 3),
        ("onset_foreseen", "Onset foreseen", 3), ("reward_r2", "Reward R2", 2), ("image_error", "Image error", 4),
        ("copy_error", "Copy error", 4), ("image_over_copy", "Image / copy", 2),
    )
)  # fmt: skip
WINDOW = tuple(
    Column(key, title, digits=3)
    for key, title in (
        ("base", "Base rate"), ("auprc", "AUPRC"), ("recall", "Recall"), ("foreseen", "Foreseen"), ("false_alarms", "False alarms"),
        ("persistence", "Persistence, AUPRC"), ("cost_correlation", "Summed cost, correlation with the real sum"),
    )
)  # fmt: skip
FILTERED = (
    Column("auprc", "AUPRC", digits=3), Column("base", "Base rate", digits=3), Column("predicted_over_base", "Predicted / base"),
    Column("image_error", "Image error", digits=4), Column("image_variance", "of the mean image", digits=4),
)  # fmt: skip
ENDS = (Column("ends_base", "Base rate", digits=3), Column("ends_auprc", "AUPRC", digits=3), Column("ends_over_base", "Predicted / base"))

Document = Mapping[str, Any]


def dataset_warnings(contents: Document) -> list[str]:
    sources, share = contents[ALL]["sources"], contents[ALL]["costly_share"]
    if not sources:
        return []
    warnings = [f"no step costs by {kind}" for kind, part in sources.items() if part == 0.0]
    low, high = COSTLY_SHARE
    if not low <= share <= high:
        warnings.append(f"{share:.1%} of the steps cost, not {low:.0%} to {high:.0%}")
    return warnings


def with_warnings(layout: Layout, trained: Iterable[Trained]) -> tuple[Trained, ...]:
    """Add to the summary of every dataset what is wrong with it, as `warning`."""

    def judged(artifact: Trained) -> Trained:
        if artifact.kind != "dataset" or "warning" in artifact.summary:
            return artifact
        try:
            warnings = dataset_warnings(read_json(layout, artifact, "contents.json"))
        except UNREADABLE:
            return artifact
        return replace(artifact, summary={**artifact.summary, "warning": "; ".join(warnings)}) if warnings else artifact

    return tuple(map(judged, trained))


def contents_markdown(contents: Document) -> str:
    sources = [_percent(kind, kind, 2) for kind in contents[ALL]["sources"]]
    rows = [((name,), {**row, **row["sources"]}) for name, row in contents.items()]
    notes = [
        "Return, goals and cost (env steps that cost) are means per episode; costly steps and the cost sources are shares of the decision "
        "steps, and one step may cost by several sources.",
        *(f"Warning: {text}." for text in dataset_warnings(contents)),
    ]
    return _table("What the dataset holds", ("Behaviour",), (*CONTENTS, *sources), rows, notes)


def open_loop_markdown(sets: Document) -> str:
    parts = ["# What the world model foresees\n"]
    for name, table in sets.items():
        named = ", ".join(f"{behaviour} {count}" for behaviour, count in table["episodes"].items())
        total, moments = sum(table["episodes"].values()), f"imagined {len(table['steps'])} steps ahead from {table['starts']} moments"
        parts += [f"# {SETS.get(name, name)}\n", f"{total} episodes ({named}), {moments}.\n", *_foreseen(table)]
    window = next(iter(sets.values()))["window"]
    parts.append(
        "From and to are a 95 % interval of the AUPRC over resampled episodes. Persistence says that the cost stays what it is now, copy "
        "that the image does. Recall is at 10 % false alarms. Onset counts only starts that do not cost themselves. Foreseen is the share "
        "of the real costs before which the safety gate would have fired: the expected costly steps of the window, discounted by "
        f"{window['gamma']:g} a step, were above {window['threshold']:g}; false alarms is the share of windows without a cost in which "
        "they were too. ECE is the mean distance of predicted and seen over ten bins. Image errors are squared, per pixel, for values in "
        "[0, 1].\n"
    )
    return "\n".join(parts)


def _foreseen(table: Document) -> Iterator[str]:
    steps, window = table["steps"], table["window"]
    by_step = [((str(row["k"]),), row) for row in steps]
    yield _table("Step by step", ("k",), FORESEEN, by_step)
    starts = [
        ((title,), {column.key: window.get(f"{prefix}{column.key}") for column in WINDOW})
        for title, prefix in (("all", ""), ("onset", "onset_"))
    ]
    yield _table(f"Any cost within {len(steps)} steps", ("Starts",), WINDOW, starts)
    yield _table("The filtered state itself (k = 0)", ("Cost",), FILTERED, [(("all",), table["filter"])])
    told = table.get("readout")
    if told:  # older diagnostics have none
        places = (("filtered latent", "filtered"), ("embedding of the image", "embedding"), (f"imagined, step {told['step']}", "imagined"))
        note = "What a ridge regression tells of the privileged vector, as R2, fitted on the episodes that were learned from."
        columns = [Column(group, group) for group in told["filtered"]]
        yield _table("What is read from the latent", ("read from",), columns, [((title,), told[key]) for title, key in places], [note])
    sources = list(steps[0]["foreseen_by_source"]) if steps else []
    if len(sources) > 1:
        rows = [((str(row["k"]),), row["foreseen_by_source"]) for row in steps]
        yield _table(
            "Share of the costs of each source that were foreseen", ("k",), [Column(kind, kind, digits=3) for kind in sources], rows
        )
    if any((row["ends_base"] or 0) > 0 for row in steps):
        yield _table("Episodes that end there by the task's own rule", ("k",), ENDS, by_step)


def quality_markdown(quality: Document) -> str:
    columns = (Column("conformity", "to the expert's action", digits=3), Column("fidelity", "to the command", digits=3))
    rows = [((kind, ratio), row) for kind, by_ratio in quality.items() for ratio, row in by_ratio.items()]
    return _table("What denoising does to commands", ("Command", "Ratio"), columns, rows)


def _table(
    title: str,
    labels: tuple[str, ...],
    columns: Sequence[Column],
    rows: Iterable[tuple[tuple[str, ...], Document]],
    notes: Sequence[str] = (),
) -> str:
    filled = tuple(Row(names, tuple(Value(numbers[column.key]) for column in columns)) for names, numbers in rows)
    return markdown(Table("part", title, labels, tuple(columns), filled, tuple(notes), grouped=False, ranked=False))
