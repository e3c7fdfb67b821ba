"""Carries out a plan: wave after wave, each node once, and what failed takes only its dependents along."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

from wasp_cli.plan.closure import source_hashes
from wasp_cli.plan.node import Node
from wasp_cli.plan.plan import Plan
from wasp_cli.plan.waves import waves
from wasp_cli.run.journal import Journal
from wasp_cli.run.order import Order, Outcome
from wasp_cli.run.pool import Pool, WorkersDied
from wasp_cli.run.progress import NAMES, Board, Quiet, running_nodes
from wasp_cli.run.worker import attempts, record_failure
from wasp_cli.stages.registry import STAGES
from wasp_cli.store.artifact import is_published, read_manifest
from wasp_cli.store.layout import Layout
from wasp_cli.store.provenance import provenance

# Longest first, so that a wave does not end with one worker busy and the others idle.
_LONG = (
    "expert", "world_model", "rollouts", "residual", "dataset", "denoiser",
    "policies", "critics", "diagnostics", "ida_q", "heldout", "calibration", "evaluate",
)  # fmt: skip
KILLED = "its process was killed, twice (out of memory, or by a signal)"


@dataclass(frozen=True)
class Failure:
    """A node that failed, and why."""

    node: Node
    outcome: Outcome


@dataclass
class Summary:
    """How a run ended."""

    done: int = 0
    shared: int = 0
    failed: list[Failure] = field(default_factory=list)
    blocked: list[tuple[Node, Node]] = field(default_factory=list)
    """Nodes that could not run, each with the failed node that it needs."""
    seconds: float = 0.0

    @property
    def complete(self) -> bool:
        """Whether every node ended well."""
        return not self.failed and not self.blocked


class Runner:
    """One run over one store."""

    def __init__(self, layout: Layout, run_id: str, pool: Pool, *, cores: int = 1, board: Board | None = None) -> None:
        self._layout, self._run_id, self._pool = layout, run_id, pool
        self._cores = cores
        self._board: Board = board or Quiet()
        self._broken: dict[str, Node] = {}
        """Failed node by key of itself and of everything that needs it."""
        self._nodes: dict[str, Node] = {}
        self.summary = Summary()

    def run(self, plan: Plan) -> Summary:
        """Compute what the plan says, and nothing else."""
        started = time.monotonic()
        journal = self._journal = Journal(self._layout.run(self._run_id) / "journal.jsonl")
        journal.write("run started", nodes=len(plan.to_run()))
        try:
            for wave in waves(plan.to_run()):
                self._wave(wave, plan)
        except BaseException as error:
            journal.write("run interrupted", cause=type(error).__name__, done=self.summary.done)
            raise
        finally:
            self.summary.seconds = time.monotonic() - started
        journal.write("run ended", done=self.summary.done, failed=len(self.summary.failed), blocked=len(self.summary.blocked))
        journal.close()
        return self.summary

    def _wave(self, wave: list[Node], plan: Plan) -> None:
        ready = [node for node in wave if not self._blocked(node)]
        ready.sort(key=lambda node: _rank(node, plan))
        threads = max(1, self._cores // max(1, min(self._pool.jobs, len(ready))))
        pending = {node.key: (node, self._order(node, threads)) for node in ready}
        for outcome in self._outcomes([order for _, order in pending.values()]):
            node, _ = pending.pop(outcome.key)
            self._ended(node, outcome)

    def _outcomes(self, orders: list[Order]) -> Iterator[Outcome]:
        """Outcomes of all orders, over the deaths of workers.

        A killed worker takes its pool along. What was in flight then runs again, each node alone in a process, so that the one
        that kills is named and the others finish.
        """
        left = {order.key: order for order in orders}
        while left:
            try:
                for outcome in self._pool.run(list(left.values())):
                    del left[outcome.key]
                    yield outcome
            except WorkersDied:
                # Asked before anything else runs: a killed worker leaves its running file behind.
                in_flight = self._in_flight()
                for order in [order for order in left.values() if is_published(self._layout, order.kind, order.key)]:
                    del left[order.key]
                    yield self._stored(order)
                suspects = [order for order in left.values() if order.key in in_flight] or list(left.values())
                labels = ", ".join(order.label for order in suspects)
                self._board.note(f"a worker was killed; what it could have been doing runs again, one at a time: {labels}")
                self._journal.write("worker killed", suspects=[order.key for order in suspects])
                for order in suspects:
                    del left[order.key]
                    yield self._alone(order)

    def _alone(self, order: Order) -> Outcome:
        started = time.monotonic()
        try:
            return self._pool.alone(order)
        except WorkersDied:
            if is_published(self._layout, order.kind, order.key):
                return self._stored(order)
            log = str(self._layout.log(order.run_id, order.label, order.key))
            outcome = Outcome(order.key, "failed", time.monotonic() - started, message=KILLED, log=log)
            record_failure(self._layout, order, outcome)
            return outcome
        finally:
            self._layout.running(self._run_id, order.key).unlink(missing_ok=True)

    def _in_flight(self) -> set[str]:
        found = {node.key for node in running_nodes(self._layout.run(self._run_id) / "running")}
        for key in found:
            self._layout.running(self._run_id, key).unlink(missing_ok=True)
        return found

    def _stored(self, order: Order) -> Outcome:
        manifest = read_manifest(self._layout, order.kind, order.key)
        log = str(self._layout.log(order.run_id, order.label, order.key))
        return Outcome(order.key, "done", float(manifest["provenance"]["seconds"]), manifest["summary"], log=log)

    def _ended(self, node: Node, outcome: Outcome) -> None:
        facts = {"key": node.key, "label": node.label, "seconds": round(outcome.seconds, 3)}
        if outcome.state == "failed":
            self._broken[node.key] = node
            self.summary.failed.append(Failure(node, outcome))
            self._journal.write("failed", **facts, message=outcome.message, log=outcome.log)
        else:
            self.summary.done += outcome.state == "done"
            self.summary.shared += outcome.state == "shared"
            self._journal.write(outcome.state, **facts)
        self._board.ended(node, outcome)

    def _blocked(self, node: Node) -> bool:
        cause = next((self._broken[needed.key] for needed in node.needs.values() if needed.key in self._broken), None)
        if cause is None:
            return False
        self._broken[node.key] = cause
        self.summary.blocked.append((node, cause))
        self._journal.write("blocked", key=node.key, label=node.label, by=cause.key)
        self._board.blocked(node, cause)
        return True

    def _order(self, node: Node, threads: int) -> Order:
        return Order(
            root=str(self._layout.root),
            run_id=self._run_id,
            kind=node.kind,
            key=node.key,
            label=node.label,
            task=node.task,
            seed=node.seed,
            stage=STAGES[node.kind].target,
            axes=node.axes,
            config=node.config,
            settings=node.settings,
            inputs={name: (needed.kind, needed.key) for name, needed in node.needs.items()},
            sources=source_hashes(node.modules),
            attempt=attempts(self._layout, node.key) + 1,
            threads=threads,
            provenance=provenance(),
        )


def _rank(node: Node, plan: Plan) -> tuple[float, int]:
    measured = plan.seconds.get(node.sort)
    return (-measured if measured is not None else 0.0), _LONG.index(node.kind) if node.kind in _LONG else len(_LONG)


def failures_text(failures: Iterable[Failure], names: Mapping[str, str] = NAMES) -> str:
    """Failed nodes with their causes and logs, for people; `names` are by key, where a label does not say enough."""
    parts = []
    for failure in failures:
        outcome = failure.outcome
        parts.append(f"  {names.get(outcome.key, failure.node.label)}: {outcome.message}")
        if outcome.hint:
            parts.append(f"      {outcome.hint}")
        if outcome.log:
            parts.append(f"      log: {outcome.log}")
    return "\n".join(parts)
