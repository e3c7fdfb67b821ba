"""What does each assistant give for how often it acts? Vary its one knob, print the curves and the operating points, and draw the figure.

python docs/examples/curves.py                  from the published rows
python docs/examples/curves.py ROWS RESULTS     first measure them, with the models and thresholds of `wasp run assistants` in RESULTS
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
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
from wasp_cli.spec.load import load
from wasp_cli.store.layout import Layout
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.registry import TASKS

ROOT = Path(__file__).parents[2]
ROWS, PICTURE = ROOT / "results" / "published" / "curves.parquet", ROOT / "docs" / "pictures" / "curves.png"
SEED, EPISODES = 500, 10
OPERATORS = {"noisy": 0.45, "laggy": 0.7, "limited-skill": 0.25, "reaction-time": 0.24}


@dataclass(frozen=True)
class Knob:
    """What is varied of an assistant, and the values; the value of every other table is `default`."""

    symbol: str
    values: tuple[float, ...]
    default: float = 1.0


KNOBS = {
    "ida": Knob("tau_Q, times", (0.0, 0.5, 1.0, 2.0, 4.0)),
    "diffusion": Knob("ratio", (0.1, 0.2, 0.4, 0.6, 0.8), 0.4),
    "saferl": Knob("residual, times", (0.25, 0.5, 0.75, 1.0, 1.5)),
    "filter": Knob("tau_c, times", (0.25, 0.5, 1.0, 2.0, 4.0)),
    "wasp": Knob("tau_r, times", (0.5, 0.7, 1.0, 1.4, 2.0)),
}
LEAST_RETURN = 0.98
"""The operating point is the value of least effective intervention rate among those that keep this share of the best return of the curve;
both are means over the tasks."""


class Scaled:
    """An assistant of whose corrections a share is executed."""

    def __init__(self, assistant: Assistant, share: float) -> None:
        self.assistant, self.share, self.reset = assistant, share, assistant.reset

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        decision = self.assistant.decide(latent, a_h, operator)
        return decision._replace(action=(a_h + self.share * (decision.action - a_h)).clamp(-1, 1))


def turned(method: str, value: float, parts: Parts, config: dict[str, Any]) -> Assistant:
    """Build an assistant with its knob at a value."""
    known = dict(parts.thresholds)
    if method == "diffusion":
        config = config | {"ratio": value}
    elif method != "saferl":
        known[{"ida": "tau_q", "filter": "tau_c", "wasp": "tau_r"}[method]] *= value
    assistant = build_assistant(method, config, replace(parts, thresholds=known))
    return Scaled(assistant, value) if method == "saferl" else assistant


def measured(results: Path) -> Iterator[dict[str, Any]]:
    """Run every assistant with every value of its knob on the same episodes, and return a row for each episode."""
    torch.set_num_threads(1)
    spec = load(ROOT / "specs" / "assistants.yaml", ["variants=[full]"]).spec
    layout = Layout(results.absolute())
    grid = lay_out_over(spec, layout, None)
    nodes = {(cell.task, cell.method): node for cell, node in grid.cells if cell.operator in OPERATORS and cell.method in KNOBS}
    for (name, method), node in nodes.items():
        info = TASKS[name]
        inputs = {kind: layout.artifact(needed.kind, needed.key) for kind, needed in node.needs.items()}
        parts = load_parts(inputs, spec.returns, motors=info.motors)
        worlds = [seeds.layout_seed(name, SEED, e) for e in range(EPISODES)]
        for operator, severity in OPERATORS.items():
            for value in KNOBS[method].values:
                task = make_task(name, EPISODES, action_repeat=spec.action_repeat, observe=("pixels",), threads=1)
                mistakes = EpisodeNoise([seeds.operator_seed(name, operator, SEED, e) for e in range(EPISODES)])
                context = OperatorContext(parts.skills.at, task.action_size, task.decision_seconds)
                impaired = build_operator(operator, severity, context, mistakes, EPISODES)
                own = [seeds.method_seed(name, operator, SEED, e, method) for e in range(EPISODES)]
                assistant = turned(method, value, parts, node.axes["method_config"])
                loop = run_episodes(task, parts.world_model, impaired, assistant, worlds, own)
                for e, found in enumerate(trajectories(loop)[0]):
                    forces = np.linalg.norm(info.motors.force(found.a) - info.motors.force(found.a_h), axis=1)
                    yield {
                        "task": name, "method": method, "value": value, "operator": operator, "episode": e, "steps": found.steps,
                        "return": float(found.reward.sum()), "cost": int(found.cost_env.sum()),
                        "interventions": int((found.deviation > 0).sum()), "effective": int((forces > 1e-6).sum()),
                        "deviation": float(found.deviation.sum()),
                    }  # fmt: skip


def point(rows: pa.Table, task: str, method: str, value: float) -> dict[str, float]:
    """Return means over operators at one value of a knob."""
    here = rows.filter((pc.field("task") == task) & (pc.field("method") == method) & (pc.field("value") == value))
    found: dict[str, list[float]] = {name: [] for name in ("return", "cost", "interventions", "effective", "deviation")}
    for operator in OPERATORS:
        part = here.filter(pc.field("operator") == operator)
        steps = pc.sum(part["steps"]).as_py()
        for name, values in found.items():
            values.append(pc.mean(part[name]).as_py() if name in ("return", "cost") else pc.sum(part[name]).as_py() / steps)
    return {name: float(np.mean(values)) for name, values in found.items()}


def chosen(curves: Sequence[Mapping[float, Mapping[str, float]]]) -> float:
    """Return the operating point of an assistant by the rule of LEAST_RETURN, from its points on every task."""

    def mean(value: float, name: str, unit: Callable[[Mapping[float, Mapping[str, float]]], float]) -> float:
        return float(np.mean([points[value][name] / unit(points) for points in curves]))

    shares = {value: mean(value, "return", lambda points: max(each["return"] for each in points.values())) for value in curves[0]}
    return min((mean(value, "effective", lambda points: 1.0), value) for value, share in shares.items() if share >= LEAST_RETURN)[1]


def shown(rows: pa.Table) -> str:
    """Write the table of the defaults and of the operating points."""
    lines = [
        "| task | assistant | knob | return | cost | Int. | effective | Mag. | |",
        "| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | --- |",
    ]
    for method, knob in KNOBS.items():
        curves = {task: {value: point(rows, task, method, value) for value in knob.values} for task in TASKS_SHOWN}
        rule = chosen(list(curves.values()))
        for task, points in curves.items():
            for value, each in points.items():
                shares = (f"{each[name]:.2f}" for name in ("interventions", "effective", "deviation"))
                numbers = " | ".join((f"{each['return']:.1f}", f"{each['cost']:.1f}", *shares))
                marks = ["default"] * (value == knob.default) + ["by the rule"] * (value == rule)
                title = f"{TASKS[task].title} | {METHODS[method].title} | {knob.symbol} {value:g}"
                lines += [f"| {title} | {numbers} | {', '.join(marks)} |"] * bool(marks)
    return "\n".join(lines)


TASKS_SHOWN = ("race1", "formula1", "goal1")
COLOURS = {"ida": "#0072b2", "diffusion": "#e69f00", "saferl": "#009e73", "filter": "#999999", "wasp": "#d55e00"}


def draw(rows: pa.Table, path: Path) -> None:
    """Draw return and cost against the effective intervention rate: a column for each task."""
    figure, axes = plt.subplots(2, 3, figsize=(11, 6), sharex="col", layout="constrained")
    for column, task in enumerate(TASKS_SHOWN):
        for row, measure in enumerate(("return", "cost")):
            panel = axes[row, column]
            for method, knob in KNOBS.items():
                points = {value: point(rows, task, method, value) for value in knob.values}
                x, y = ([each[name] for each in points.values()] for name in ("effective", measure))
                panel.plot(x, y, "o-", ms=4, lw=1.2, color=COLOURS[method], label=METHODS[method].title)
                at = points[knob.default]
                panel.plot(at["effective"], at[measure], "o", ms=10, mfc="none", color=COLOURS[method])
            panel.set(
                title=TASKS[task].title if not row else "", ylabel=measure if not column else "", xlabel="effective Int." if row else ""
            )
            panel.spines[["top", "right"]].set_visible(False)
    axes[0, 0].legend(frameon=False, fontsize=8)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    source = ROWS
    if len(sys.argv) > 2:
        source = Path(sys.argv[1])
        pq.write_table(pa.Table.from_pylist(list(measured(Path(sys.argv[2])))), source, compression="zstd")
    published = pq.read_table(source)
    print(shown(published))
    draw(published, PICTURE)
