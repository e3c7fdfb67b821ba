"""One `wasp run` from a valid spec to a filled store: plan, pool, board, signals, summary."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

from wasp_cli.console import duration, plain
from wasp_cli.errors import CellsFailed, Interrupted, UnknownName
from wasp_cli.plan.grid import lay_out
from wasp_cli.plan.plan import Plan, plan_against
from wasp_cli.plan.waves import waves
from wasp_cli.run.pool import InlinePool, LokyPool, Pool
from wasp_cli.run.progress import NAMES, board
from wasp_cli.run.record import new_run
from wasp_cli.run.runner import Runner, Summary, failures_text
from wasp_cli.spec.load import Loaded
from wasp_cli.store.artifact import sweep
from wasp_cli.store.layout import Layout


def cores() -> int:
    """Cores that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)  # Linux only
    return len(affinity(0)) if affinity is not None else os.cpu_count() or 1


def useful_jobs(plan: Plan, jobs: int) -> int:
    """No more workers than nodes that can run side by side: a worker costs memory also while it is idle."""
    return min(jobs, max((len(wave) for wave in waves(plan.to_run())), default=jobs))


def restricted(loaded: Loaded, task: str | None) -> Loaded:
    """The spec with one of its tasks only (or as it is).

    Raises:
        UnknownName: the spec has no such task.
    """
    if task is None:
        return loaded
    if task not in loaded.spec.tasks:
        raise UnknownName("task of this spec", task, loaded.spec.tasks)
    return replace(loaded, spec=loaded.spec.model_copy(update={"tasks": (task,)}))


@dataclass(frozen=True)
class Session:
    """A run that is over."""

    layout: Layout
    plan: Plan
    summary: Summary
    names: Mapping[str, str] = field(default_factory=dict)
    """What people call a node, by its key, where that is not its label."""

    def require_complete(self) -> None:
        """Raise CellsFailed when a node failed."""
        if not self.summary.complete:
            raise CellsFailed(_failure_message(self.summary, self.names), "the same command runs what failed again")


def run_spec(loaded: Loaded, results: Path, jobs: int) -> Session:
    """Compute what is missing of a spec.

    Args:
        loaded: the spec.
        results: the results folder.
        jobs: worker processes at most; 0 computes in this process.

    Raises:
        StoreError: the results folder cannot be written.
        Interrupted: Ctrl-C or SIGTERM; workers have been killed, finished nodes are kept.
    """
    layout = prepared(results)
    plan = plan_against(lay_out(loaded.spec), layout)
    return carry_out(plan, layout, new_run(layout, loaded, plan), jobs)


def prepared(results: Path) -> Layout:
    """A results folder that can be written, without what killed runs have left."""
    layout = Layout(results.absolute())
    layout.prepare()
    sweep(layout)
    return layout


def carry_out(plan: Plan, layout: Layout, run_id: str, jobs: int, names: Mapping[str, str] = NAMES) -> Session:
    """Compute what a plan says, and say how it ended.

    Args:
        plan: what to compute.
        layout: the results folder.
        run_id: the run whose folder has the logs.
        jobs: worker processes at most; 0 computes in this process.
        names: what people call a node, by its key, where that is not its label.
    """
    summary = _compute(plan, layout, run_id, jobs, names) if plan.to_run() else Summary()
    plain(_summary_line(plan, summary))
    return Session(layout, plan, summary, names)


def _compute(plan: Plan, layout: Layout, run_id: str, jobs: int, names: Mapping[str, str]) -> Summary:
    jobs = useful_jobs(plan, jobs)
    workers = max(jobs, 1)
    seconds, unknown = plan.estimate(workers)
    estimate = f", about {duration(seconds)}" if seconds and not unknown else ""
    plain(f"{len(plan.to_run())} to compute, {plan.count('cached')} computed before{estimate}; logs in {layout.run(run_id) / 'logs'}")
    pool: Pool = LokyPool(jobs) if jobs else InlinePool()
    with _terminable(), board(len(plan.to_run()), layout.run(run_id) / "running", names) as shown:
        runner = Runner(layout, run_id, pool, cores=cores(), board=shown)
        try:
            summary = runner.run(plan)
        except KeyboardInterrupt:
            _kill(pool)
            kept = f"{runner.summary.done} of {len(plan.to_run())} nodes were finished and are kept"
            raise Interrupted(f"interrupted: {kept}", "the same command goes on from there") from None
        except BaseException:
            _kill(pool)
            raise
    pool.close()
    return summary


def _kill(pool: Pool) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a second Ctrl-C must not leave workers behind
    pool.close(kill=True)


@contextmanager
def _terminable() -> Iterator[None]:
    """SIGTERM ends a run like Ctrl-C; by default it would leave the workers alive."""

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _summary_line(plan: Plan, summary: Summary) -> str:
    parts = [f"{summary.done} computed", f"{plan.count('cached') + summary.shared} computed before"]
    if summary.failed:
        parts.append(f"{len(summary.failed)} failed")
    if summary.blocked:
        parts.append(f"{len(summary.blocked)} blocked")
    return f"{', '.join(parts)} in {duration(summary.seconds)}"


def _failure_message(summary: Summary, names: Mapping[str, str]) -> str:
    lines = [f"{len(summary.failed)} failed:", failures_text(summary.failed, names)]
    if summary.blocked:
        lines.append(f"{len(summary.blocked)} blocked by them:")
        lines += [
            f"  {names.get(node.key, node.label)} (needs {names.get(cause.key, cause.label)})" for node, cause in summary.blocked[:10]
        ]
        if len(summary.blocked) > 10:
            lines.append(f"  and {len(summary.blocked) - 10} more")
    return "\n".join(lines)
