"""`wasp bench planner`: the time of a decision, beside that of its floating-point operations as plain matrix products in the same run.

Untrained weights: the arithmetic does not depend on them. Both gates are opened or shut by their thresholds, so that each kind of decision
is timed as it runs in the closed loop.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile
from torch.utils.flop_counter import FlopCounterMode

from wasp_cli.learning.configs.latent import CriticsConfig, PoliciesConfig
from wasp_cli.learning.configs.shared import ReturnsConfig
from wasp_cli.learning.configs.world import WorldModelConfig
from wasp_cli.learning.world_model import build
from wasp_cli.memory import keep_memory
from wasp_cli.methods.configs import WASPConfig
from wasp_cli.methods.wasp.assistant import WASP
from wasp_cli.methods.wasp.imagine import Imagination
from wasp_cli.models.base import Latent
from wasp_cli.models.critics import LatentCritics
from wasp_cli.models.policy import Skills
from wasp_cli.operators.base import EpisodeNoise, Operator, OperatorContext, build_operator
from wasp_cli.report.stats.summary import Value
from wasp_cli.report.tables.table import Column, Row, Table
from wasp_cli.tasks.motors import UNKNOWN

ACTIONS = 2
NEVER = 1e9
"""A threshold that nothing exceeds."""
ROOF_SHAPES = ((300, 256, 768), (300, 512, 512), (1024, 512, 512))
"""[M, K] x [K, N] of the plain products: the planner's own shapes; the fastest is the roof."""
THRESHOLDS = {"quiet": (NEVER, NEVER), "task": (NEVER, -NEVER), "safety": (-NEVER, NEVER)}
"""(tau_c, tau_r) under which each kind of decision comes about."""

COLUMNS = (
    Column("ms", "ms", digits=1),
    Column("ms_p50", "ms, median", digits=1),
    Column("gflop", "GFLOP"),
    Column("ratio", "time / products"),
)
MEANINGS = {
    "quiet": "both gates silent", "task": "the expert's action after the task gate", "safety": "search after the safety gate",
}  # fmt: skip
TABLE1: Mapping[str, float] = {"race1": 0.15, "formula1": 0.20, "goal1": 0.25}
"""Intervention rates of WASP in Table 1 of the paper."""
DECISION_SECONDS: Mapping[str, float] = {"race1": 0.16, "formula1": 0.16, "goal1": 0.08}
"""Simulated time of a decision of four env steps."""


@dataclass(frozen=True)
class Timing:
    """One kind of decision."""

    kind: str
    """`quiet`, `task` or `safety` (MEANINGS)"""
    ms: float
    """fastest, for the whole batch"""
    ms_p50: float
    """median"""
    gflop: float
    """floating-point operations of its matrix products, 1e9, where every one-hot row is multiplied"""
    ratio: float
    """time over that of the same operations as plain matrix products"""


@dataclass(frozen=True)
class Bench:
    """A planner on the models of a preset."""

    batch: int
    threads: int
    roof: float
    """plain matrix products, GFLOP/s"""
    timings: tuple[Timing, ...]
    shares: Mapping[str, float]
    """share of the time of a `safety` decision by operator, the largest first"""

    def ms(self, kind: str) -> float:
        """Return the fastest time of a kind in milliseconds per episode of the batch."""
        return next(timing.ms for timing in self.timings if timing.kind == kind) / self.batch

    def mean_ms(self, safety: float, task: float) -> float:
        """Return the mean milliseconds of a decision where the gates fire at these rates, and every safety gate asks for a search."""
        return safety * self.ms("safety") + task * self.ms("task") + (1 - safety - task) * self.ms("quiet")

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON values."""
        return asdict(self) | {"shares": dict(self.shares)}


def bench_planner(
    world_model: WorldModelConfig, policies: PoliciesConfig, critics: CriticsConfig, wasp: WASPConfig, returns: ReturnsConfig,
    *, batch: int, threads: int, repeats: int,
) -> Bench:  # fmt: skip
    """Time every kind of decision for `batch` episodes side by side."""
    keep_memory()  # as every worker does
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        with torch.inference_mode():
            return _bench(Setup(world_model, policies, critics, wasp, returns, batch), batch, threads, repeats)
    finally:
        torch.set_num_threads(before)


class Setup:
    """An assistant of untrained models and a laggy operator."""

    def __init__(
        self, world_model: WorldModelConfig, policies: PoliciesConfig, critics: CriticsConfig, wasp: WASPConfig, returns: ReturnsConfig,
        batch: int,
    ) -> None:  # fmt: skip
        torch.manual_seed(0)
        model = build(world_model, ACTIONS).eval().requires_grad_(False)
        values = LatentCritics(model.feature_size, critics.hidden, critics.bins, critics.reach).requires_grad_(False)
        skills = Skills([1.0], model.feature_size, policies.hidden, ACTIONS).requires_grad_(False)
        context = OperatorContext(skill=skills.at, action_size=ACTIONS, decision_seconds=0.1)
        self.imagination = Imagination(model, values, skills.expert, returns.gamma_r, returns.gamma_c, returns.lam)
        self.operator: Operator = build_operator("laggy", 0.7, context, EpisodeNoise(list(range(batch))), batch)
        self.latent: Latent = model.initial(batch)
        self.a_h = self.operator.command(self.latent.features)
        self.assistant = WASP(wasp, self.imagination, {}, UNKNOWN)
        self.reference = WASP(wasp, replace(self.imagination, pack=False), {}, UNKNOWN)
        self.batch = batch

    def decision(self, kind: str, *, reference: bool = False) -> Callable[[], Any]:
        """Return a call that makes one decision of a kind, each time the same one.

        `reference`: by the world model's own steps, every one-hot row a product, whose floating-point operations are counted.
        """
        assistant = self.reference if reference else self.assistant
        seeds = list(range(self.batch))
        everyone = torch.ones(self.batch, dtype=torch.bool)

        def decide() -> None:
            assistant.reset(everyone, seeds)
            assistant.tau_c, assistant.tau_r = THRESHOLDS[kind]
            assistant.decide(self.latent, self.a_h, self.operator)

        return decide


def _bench(setup: Setup, batch: int, threads: int, repeats: int) -> Bench:
    works = {kind: setup.decision(kind) for kind in THRESHOLDS}
    times: dict[str, list[float]] = {kind: [] for kind in works}
    roof = 0.0
    for work in works.values():
        work()
    # Roof and decisions in turn, so that a neighbour on the machine slows both down.
    for _ in range(repeats):
        roof = max(roof, matrix_rate())
        for kind, work in works.items():
            times[kind].append(_seconds(work))
    timings = []
    for kind in works:
        flop = products(setup, kind)
        best, middle = min(times[kind]), sorted(times[kind])[len(times[kind]) // 2]
        timings.append(Timing(kind, 1000 * best, 1000 * middle, flop / 1e9, best * roof / flop))
    return Bench(batch, threads, roof / 1e9, tuple(timings), _shares(works["safety"]))


def products(setup: Setup, kind: str) -> int:
    """Count the floating-point operations of a decision's matrix products, as the world model's own steps multiply."""
    with FlopCounterMode(display=False) as counter:
        setup.decision(kind, reference=True)()
    total: int = counter.get_total_flops()
    return total


def matrix_rate(shapes: Sequence[tuple[int, int, int]] = ROOF_SHAPES, repeats: int = 20) -> float:
    """Measure the floating-point operations per second of plain matrix products [M, K] x [K, N]: the fastest shape."""
    best = 0.0
    for m, k, n in shapes:
        a, b, out = torch.randn(m, k), torch.randn(k, n), torch.empty(m, n)

        def multiply(a: torch.Tensor = a, b: torch.Tensor = b, out: torch.Tensor = out) -> None:
            torch.mm(a, b, out=out)

        multiply()
        best = max(best, 2 * m * k * n / min(_seconds(multiply) for _ in range(repeats)))
    return best


def _seconds(work: Callable[[], Any]) -> float:
    begun = time.perf_counter()
    work()
    return time.perf_counter() - begun


def _shares(work: Callable[[], Any], most: int = 8) -> dict[str, float]:
    """Share of the self time by operator: what the time is spent on besides the matrix products."""
    with profile(activities=[ProfilerActivity.CPU]) as profiled:
        work()
    rows = {row.key.removeprefix("aten::"): float(row.self_cpu_time_total) for row in profiled.key_averages()}
    total = sum(rows.values())
    ranked = sorted(rows.items(), key=lambda row: -row[1])
    shares = {name: spent / total for name, spent in ranked[:most]}
    return shares | {"the rest": 1.0 - sum(shares.values())}


def bench_table(found: Mapping[str, Bench]) -> Table:
    """Time of every kind of decision, for the whole batch."""
    rows = [
        Row((name, timing.kind), tuple(Value(getattr(timing, column.key), ranked=False) for column in COLUMNS))
        for name, bench in found.items()
        for timing in bench.timings
    ]
    last = list(found.values())[-1]
    episodes = f"{last.batch} episode{'s side by side' if last.batch > 1 else ''}"
    threads = f"{last.threads} thread{'s' if last.threads > 1 else ''}"
    said = (
        f"{episodes}, {threads}; plain matrix products reach {last.roof:.0f} GFLOP/s in the same run.",
        "; ".join(f"{kind}: {meaning}" for kind, meaning in MEANINGS.items()) + ".",
    )
    return Table("planner", "A decision of WASP", ("Planner", "Decision"), COLUMNS, tuple(rows), said)


def notes(name: str, bench: Bench) -> Iterator[str]:
    """Say what the time goes to, and the mean decision at the paper's intervention rates."""
    spent = ", ".join(f"{operator} {100 * share:.0f} %" for operator, share in bench.shares.items())
    yield f"{name}: time of a safety decision by operator: {spent}"
    for task, rate in TABLE1.items():
        # The paper does not say which gate fired: half of the interventions each.
        mean = bench.mean_ms(rate / 2, rate / 2)
        yield f"{name}: mean decision at Int. {rate:.2f} ({task}): {mean:.0f} ms; a decision lasts {1000 * DECISION_SECONDS[task]:.0f} ms"
