"""`wasp bench oracle`: from a spec and a results folder to what the planner reaches on the true dynamics, as a table.

The planner on the true dynamics needs torch and MuJoCo, which are imported when it runs: wrong usage is refused before.
"""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from wasp_cli.console import duration, following
from wasp_cli.errors import ArtifactError, UnknownName, UsageError
from wasp_cli.methods.configs import WASPConfig
from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import OPERATORS
from wasp_cli.plan.node import Node
from wasp_cli.plan.reuse import lay_out_over
from wasp_cli.report.stats.summary import Value
from wasp_cli.report.tables.main import PAPER_COLUMNS
from wasp_cli.report.tables.table import Column, Row, Table
from wasp_cli.report.tables.titles import operator_title, task_title, who_title
from wasp_cli.run.session import restricted
from wasp_cli.spec.load import load
from wasp_cli.spec.model import Spec
from wasp_cli.store.artifact import damage
from wasp_cli.store.layout import Layout
from wasp_cli.tasks.registry import TASKS

if TYPE_CHECKING:
    from wasp_cli.studies.oracle import Cell, Outcome

WITHOUT_CRITICS = tuple(variant for variant in METHODS["wasp"].variants if variant != "no-rollout")
"""The variants that look ahead; `no-rollout` judges by critics, and a simulator has none."""

COLUMNS = (
    *PAPER_COLUMNS,
    Column("safety_gate", "Safety gate", digits=3),
    Column("task_gate", "Task gate", digits=3),
    Column("case2", "Case II", digits=3, optional=True),
)
COMPARED = ("return", "cost")
"""Columns with a spread over episodes, and the difference to Human-only."""
MEANINGS = (
    "WASP imagines in the task itself: its model is perfect, and knows where the next goals will be. The imagined operator makes mistakes "
    "of its own, and nothing is foreseen beyond the horizon. Operator and imagination read the privileged observation.",
    "± is the standard deviation over episodes, in brackets the mean difference to Human-only in the same episodes.",
)


def measure_oracle(
    path: Path,
    task: str | None,
    operator: str,
    variants: Sequence[str],
    *,
    episodes: int,
    tau_r: float,
    threads: int,
    results: Path,
    settings: Sequence[str],
) -> tuple[Cell, list[Outcome]]:
    """Run Human-only, then WASP in some of its variants, in the same episodes.

    Args:
        path: of the spec, for the planner's sizes, the first seed, and the expert.
        task: one of the spec's; None where it has only one.
        operator: as `laggy=0.7`.
        variants: of WASP.
        episodes: of each.
        tau_r: threshold of the task gate.
        threads: of the simulators.
        results: where the expert is.
        settings: texts `a.b=value` over the spec.

    Raises:
        UnknownName: no such task, operator or variant.
        UsageError: the operator's severity is not one, or the task is not said.
        ArtifactError: the expert has not been trained.
    """
    from wasp_cli.studies.oracle import Cell, assisted  # needs torch and MuJoCo: what is wrong with the spec is told before

    loaded = load(path, settings)
    spec = restricted(loaded, [_task_of(loaded.spec, task)]).spec
    variant, value = _operator_of(operator, spec)
    configs = [_planner(spec, name, tau_r) for name in dict.fromkeys(variants)]
    layout = Layout(results.absolute())
    expert = _expert_of(spec, layout)
    if (reason := damage(layout, expert.kind, expert.key)) is not None:
        raise ArtifactError(f"there is no {expert.label} of this spec in '{results}': {reason}", _training(path, spec, results, settings))
    evaluate: Any = spec.stage("evaluate")
    cell = Cell(
        task=expert.task, seed=spec.seeds[0], variant=variant, value=value, episodes=episodes, action_repeat=spec.action_repeat,
        gamma_r=spec.returns.gamma_r, gamma_c=spec.returns.gamma_c, safe_cost=evaluate.safe_cost,
        success_goals=evaluate.success_goals or TASKS[expert.task].success_goals, expert=layout.artifact(expert.kind, expert.key),
    )  # fmt: skip
    found = []
    for config in (None, *configs):
        with following("Human-only" if config is None else f"WASP {config.variant}") as progress:
            found.append(assisted(cell, config, threads, progress))
    return cell, found


def _task_of(spec: Spec, task: str | None) -> str:
    if task is None and len(spec.tasks) > 1:
        raise UsageError(f"the spec has {len(spec.tasks)} tasks: {', '.join(spec.tasks)}", "name one with --task")
    return task or spec.tasks[0]


def _operator_of(text: str, spec: Spec) -> tuple[str, float]:
    """Variant and severity of `laggy=0.7`."""
    name, _, severity = text.partition("=")
    info = OPERATORS[name.strip()]
    try:
        value = float(severity)
    except ValueError:
        raise UsageError(
            f"'{text}' has no severity", f"for example {info.name}={(info.low + min(info.high, 1.0)) / 2:g} ({info.unit})"
        ) from None
    if not info.low <= value <= info.high:
        raise UsageError(f"the severity of {info.name} lies between {info.low:g} and {info.high:g} ({info.unit}), not at {severity}")
    checkpoints: Sequence[float] = getattr(spec.stage("expert"), "checkpoints", ())
    if info.name == "limited-skill" and value not in checkpoints:
        raise UsageError(f"the expert has no checkpoint at {value:g}", "checkpoints: " + ", ".join(f"{share:g}" for share in checkpoints))
    return info.name, value


def _planner(spec: Spec, variant: str, tau_r: float) -> WASPConfig:
    if variant not in WITHOUT_CRITICS:
        raise UnknownName("variant of wasp without critics", variant, WITHOUT_CRITICS)
    # Nothing is calibrated here: the unimpaired expert's gains under a perfect model would be another number for every expert.
    return WASPConfig.model_validate(spec.method("wasp", variant).model_dump() | {"tau_r": tau_r})


def _expert_of(spec: Spec, layout: Layout) -> Node:
    """The expert of the spec's only task and its first seed."""
    nodes = lay_out_over(spec.model_copy(update={"methods": (), "stages": ("expert",)}), layout).nodes
    return next(node for node in nodes if node.seed == spec.chain_seed(spec.seeds[0]))


def _training(path: Path, spec: Spec, results: Path, settings: Sequence[str]) -> str:
    """The command that trains no more than the expert."""
    only = ["methods=[]", "stages=[expert]", *(["variants=[full]"] if spec.variants != ("full",) else [])]
    options = [word for text in (*settings, *only) for word in ("--set", text)]
    return shlex.join(["wasp", "run", str(path), "--results", str(results), "--task", spec.tasks[0], *options])


def oracle_table(cell: Cell, found: Sequence[Outcome]) -> Table:
    """Tabulate the outcomes, a row per assistant, Human-only first."""
    alone = found[0]
    rows = [Row((_title(outcome),), tuple(_value(outcome, alone, column) for column in COLUMNS)) for outcome in found]
    episodes = f"{cell.episodes} episode{'s' if cell.episodes > 1 else ''}"
    title = f"Oracle dynamics: {task_title(cell.task)}, {operator_title(cell.variant)} {cell.value:g}, seed {cell.seed}, {episodes}"
    times = ", ".join(f"{_title(outcome)} {duration(outcome.seconds)}" for outcome in found)
    notes = (f"time: {times}",)
    return Table("oracle", title, ("Method",), COLUMNS, tuple(rows), notes, MEANINGS, grouped=False, ranked=False)


def _title(outcome: Outcome) -> str:
    if outcome.variant is None:
        return METHODS["human"].title
    return who_title("wasp", outcome.variant)


def _value(outcome: Outcome, alone: Outcome, column: Column) -> Value:
    mean = outcome.pooled()[column.key]
    if column.key not in COMPARED:
        return Value(mean)
    values, reference = outcome.column(column.key), alone.column(column.key)
    sd = float(np.std(values, ddof=1)) if len(values) > 1 else None
    return Value(mean, sd, delta=None if outcome is alone else float((values - reference).mean()))
