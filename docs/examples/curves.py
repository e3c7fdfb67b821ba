"""What does each assistant give for how often it acts? Vary its one knob, print the curves and the
operating points, and draw the figure.

python docs/examples/curves.py                          from the published rows of `field`
python docs/examples/curves.py field RESULTS TASK ...   measure what is not in RESULTS yet, with the
published models of that spec
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import torch
from torch import Tensor

from wasp_cli import seeds
from wasp_cli.learning.assistants import build_assistant, load_parts
from wasp_cli.learning.closed_loop import run_episodes
from wasp_cli.learning.evaluation import trajectories
from wasp_cli.methods.base import Assistant, Decision, Parts
from wasp_cli.methods.registry import METHODS
from wasp_cli.models.base import Latent
from wasp_cli.operators.base import EpisodeNoise, Operator, OperatorContext, build_operator
from wasp_cli.plan.reuse import lay_out_over
from wasp_cli.report.canvas import drawn
from wasp_cli.report.styles import style_of
from wasp_cli.spec.load import load
from wasp_cli.store.layout import Layout
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.registry import TASKS

ROOT = Path(__file__).parents[2]
PUBLISHED = ROOT / "results" / "published"
PICTURE = ROOT / "docs" / "pictures" / "curves.png"
SEED, EPISODES = 500, 10
OPERATORS = {"noisy": 0.45, "laggy": 0.7, "limited-skill": 0.25, "reaction-time": 0.24}


@dataclass(frozen=True)
class Knob:
    """What is varied of an assistant, and the values; `used` is that of `specs/field.yaml` and
    of Table 1.
    """

    symbol: str
    values: tuple[float, ...]
    used: float = 1.0


KNOBS = {
    "ida": Knob("tau_Q, times", (0.0, 0.5, 1.0, 2.0, 4.0), 0.0),
    "ida-least": Knob("tau_Q, times", (0.0, 0.5, 1.0, 2.0), 0.0),
    "ida-guarded": Knob("tau_Q, times", (0.0, 0.5, 1.0, 2.0), 0.0),
    "diffusion": Knob("ratio", (0.1, 0.2, 0.4, 0.6, 0.8), 0.6),
    "csa": Knob("ratio", (0.2, 0.4, 0.55, 0.69), 0.4),
    "saferl": Knob("residual, times", (0.25, 0.5, 0.75, 1.0, 1.5)),
    "filter": Knob("tau_c, times", (0.25, 0.5, 1.0, 2.0, 4.0)),
    "reach": Knob("gamma, times", (0.5, 0.75, 0.9, 1.0)),
    "mpmi": Knob("tau_c, times", (0.5, 1.0, 2.0, 4.0)),
    "wasp": Knob("tau_r, times", (0.0, 0.25, 0.5, 0.7, 1.0, 1.4, 2.0)),
}
THRESHOLDS = {"filter": "tau_c", "mpmi": "tau_c", "reach": "gamma", "wasp": "tau_r"}
"""What is multiplied. tau_Q is of its default, the 95th percentile: at the quantile .5 of
`specs/field.yaml` it is 0.
"""
LEAST_RETURN = 0.98
"""The operating point is the value of least effective intervention rate among those that keep this
share of the best return of the curve; both are means over the tasks. Where none keeps it on all
tasks together, the value that keeps most."""


class Scaled:
    """An assistant of whose corrections a share is executed."""

    def __init__(self, assistant: Assistant, share: float) -> None:
        self.assistant, self.share, self.reset = assistant, share, assistant.reset

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        decision = self.assistant.decide(latent, a_h, operator)
        return decision._replace(action=(a_h + self.share * (decision.action - a_h)).clamp(-1, 1))


def published(spec: str) -> Path:
    """Return the file of the published curves of a spec."""
    return PUBLISHED / f"{spec}-curves.parquet"


def turned(method: str, value: float, parts: Parts, config: dict[str, Any]) -> Assistant:
    """Build an assistant with its knob at a value."""
    known = dict(parts.thresholds)
    if method in ("diffusion", "csa"):
        config = config | {"ratio": value}
    elif method in THRESHOLDS:
        known[THRESHOLDS[method]] *= value
    elif method != "saferl":
        known["tau_q"] = max(0.0, known["margin_p95"]) * value
    assistant = build_assistant(method, config, replace(parts, thresholds=known))
    return Scaled(assistant, value) if method == "saferl" else assistant


def measure(name: str, results: Path, tasks: Sequence[str]) -> None:
    """Run every assistant with every value of its knob on the same episodes, and write a row
    for each episode: a file each.
    """
    torch.set_num_threads(1)
    (results / "curves").mkdir(parents=True, exist_ok=True)
    spec = load(
        ROOT / "specs" / f"{name}.yaml", ["variants=[full]", f"tasks=[{', '.join(tasks)}]"]
    ).spec
    layout = Layout(PUBLISHED)
    grid = lay_out_over(spec, layout, str(PUBLISHED))
    nodes = {
        (cell.task, cell.method): node
        for cell, node in grid.cells
        if cell.operator in OPERATORS and cell.method in KNOBS
    }
    for (task, method), node in nodes.items():
        path = results / "curves" / f"{task}-{method}.parquet"
        rows: list[dict[str, Any]] = pq.read_table(path).to_pylist() if path.exists() else []
        missing = [
            value for value in KNOBS[method].values if value not in {row["value"] for row in rows}
        ]
        if not missing:
            continue
        inputs = {
            kind: layout.artifact(needed.kind, needed.key) for kind, needed in node.needs.items()
        }
        parts = load_parts(inputs, spec.returns, motors=TASKS[task].motors)
        for value in missing:
            assistant = turned(method, value, parts, node.axes["method_config"])
            rows += [
                {"value": value, **row}
                for row in driven(task, method, assistant, parts, spec.action_repeat)
            ]
        pq.write_table(pa.Table.from_pylist(rows), path)


def driven(
    name: str, method: str, assistant: Assistant, parts: Parts, action_repeat: int
) -> Iterator[dict[str, Any]]:
    """Yield a row for each episode of an assistant under every operator."""
    worlds = [seeds.layout_seed(name, SEED, e) for e in range(EPISODES)]
    for operator, severity in OPERATORS.items():
        task = make_task(
            name, EPISODES, action_repeat=action_repeat, observe=("pixels",), threads=1
        )
        mistakes = EpisodeNoise(
            [seeds.operator_seed(name, operator, SEED, e) for e in range(EPISODES)]
        )
        context = OperatorContext(parts.skills.at, task.action_size, task.decision_seconds)
        impaired = build_operator(operator, severity, context, mistakes, EPISODES)
        own = [seeds.method_seed(name, operator, SEED, e, method) for e in range(EPISODES)]
        loop = run_episodes(task, parts.world_model, impaired, assistant, worlds, own)
        for e, episode in enumerate(trajectories(loop)[0]):
            forces = np.linalg.norm(
                parts.motors.force(episode.a) - parts.motors.force(episode.a_h), axis=1
            )
            yield {
                "task": name,
                "method": method,
                "operator": operator,
                "episode": e,
                "steps": episode.steps,
                "return": float(episode.reward.sum()),
                "cost": int(episode.cost_env.sum()),
                "interventions": int((episode.deviation > 0).sum()),
                "effective": int((forces > 1e-6).sum()),
                "deviation": float(episode.deviation.sum()),
            }


def point(rows: pa.Table, task: str, method: str, value: float) -> dict[str, float]:
    """Return means over operators at one value of a knob."""
    here = rows.filter(
        (pc.field("task") == task) & (pc.field("method") == method) & (pc.field("value") == value)
    )
    found: dict[str, list[float]] = {
        name: [] for name in ("return", "cost", "interventions", "effective", "deviation")
    }
    for operator in OPERATORS:
        part = here.filter(pc.field("operator") == operator)
        steps = pc.sum(part["steps"]).as_py()
        for name, values in found.items():
            values.append(
                pc.mean(part[name]).as_py()
                if name in ("return", "cost")
                else pc.sum(part[name]).as_py() / steps
            )
    return {name: float(np.mean(values)) for name, values in found.items()}


def chosen(curves: Sequence[Mapping[float, Mapping[str, float]]]) -> float:
    """Return the operating point of an assistant by the rule of LEAST_RETURN, from its points
    on every task.
    """

    def mean(
        value: float, name: str, unit: Callable[[Mapping[float, Mapping[str, float]]], float]
    ) -> float:
        return float(np.mean([points[value][name] / unit(points) for points in curves]))

    shares = {
        value: mean(value, "return", lambda points: max(each["return"] for each in points.values()))
        for value in curves[0]
    }
    enough = min(LEAST_RETURN, max(shares.values()))
    return min(
        (mean(value, "effective", lambda points: 1.0), value)
        for value, share in shares.items()
        if share >= enough
    )[1]


def shown(rows: pa.Table) -> str:
    """Write the values in use and those that the rule chooses: return / cost / effective
    intervention rate on every task.
    """
    tasks = shown_tasks(rows)
    lines = [
        f"| Assistant | knob | {' | '.join(TASKS[task].title for task in tasks)} | |",
        f"| --- | --- |{' ---: |' * len(tasks)} --- |",
    ]
    for method, knob in measured_in(rows):
        curves = {
            task: {value: point(rows, task, method, value) for value in knob.values}
            for task in tasks
        }
        rule = chosen(list(curves.values()))
        for value in sorted({knob.used, rule}):
            each = [curves[task][value] for task in tasks]
            numbers = " | ".join(
                f"{at['return']:.1f} / {at['cost']:.1f} / {at['effective']:.2f}" for at in each
            )
            marks = ["used"] * (value == knob.used) + ["by the rule"] * (value == rule)
            lines.append(
                f"| {METHODS[method].title} | {knob.symbol} {value:g} | {numbers} | "
                f"{', '.join(marks)} |"
            )
    return "\n".join(lines)


def shown_tasks(rows: pa.Table) -> list[str]:
    """Return the tasks that there are, in the order of tables."""
    there = set(rows["task"].to_pylist())
    return [task for task in ("race1", "formula1", "goal1") if task in there]


def measured_in(rows: pa.Table) -> list[tuple[str, Knob]]:
    """Return the assistants that there are, with the values that were measured."""
    there = {
        method: tuple(sorted(set(rows.filter(pc.field("method") == method)["value"].to_pylist())))
        for method in KNOBS
    }
    return [
        (method, replace(KNOBS[method], values=values))
        for method, values in there.items()
        if values
    ]


def draw(rows: pa.Table, path: Path) -> None:
    """Draw return and cost against the effective intervention rate: a column for each task."""
    tasks = shown_tasks(rows)
    with drawn((1 + 3.3 * len(tasks), 6), look={}, dpi=100) as figure:
        axes = figure.subplots(2, len(tasks), sharex="col", squeeze=False)
        for column, task in enumerate(tasks):
            for row, measure in enumerate(("return", "cost")):
                panel = axes[row, column]
                for method, knob in measured_in(rows):
                    points = {value: point(rows, task, method, value) for value in knob.values}
                    x, y = (
                        [each[name] for each in points.values()] for name in ("effective", measure)
                    )
                    colour, marker = style_of(method)
                    panel.plot(
                        x,
                        y,
                        "-",
                        marker=marker,
                        ms=4,
                        lw=1.2,
                        color=colour,
                        label=METHODS[method].title,
                    )
                    at = points[knob.used]
                    panel.plot(at["effective"], at[measure], "o", ms=10, mfc="none", color=colour)
                panel.set(
                    title=TASKS[task].title if not row else "",
                    ylabel=measure if not column else "",
                    xlabel="effective Int." if row else "",
                )
                panel.spines[["top", "right"]].set_visible(False)
        figure.legend(
            *axes[0, 0].get_legend_handles_labels(),
            frameon=False,
            fontsize=8,
            loc="outside right upper",
        )
        figure.savefig(path, dpi=110)


if __name__ == "__main__":
    spec, *measured = sys.argv[1:] or ["field"]
    source = published(spec)
    needed = ROOT / "specs" / f"{spec}.yaml" if measured else source
    if not needed.is_file():
        sys.exit(f"{needed} is not there\n\n{__doc__}")
    if measured:
        results, *tasks = measured
        measure(spec, Path(results), tasks)
        files = sorted((Path(results) / "curves").glob("*.parquet"))
        pq.write_table(
            pa.concat_tables([pq.read_table(path) for path in files]), source, compression="zstd"
        )
    rows = pq.read_table(source)
    print(shown(rows))
    draw(rows, PICTURE)
