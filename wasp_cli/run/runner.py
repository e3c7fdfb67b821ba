"""Carries out a plan: wave after wave, each node once, and what failed takes only its dependents along."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from wasp_cli.errors import ArtifactError
from wasp_cli.plan.closure import source_hashes
from wasp_cli.plan.node import Node, waves
from wasp_cli.plan.plan import Plan
from wasp_cli.run.interrupt import HINT, Stop, was_ended
from wasp_cli.run.job import NodeJob, NodeResult, Pool, WorkersDied
from wasp_cli.run.progress import NAMES, numbers
from wasp_cli.run.record import Journal
from wasp_cli.run.worker import KILLED, attempts, record_failure
from wasp_cli.stages.registry import STAGES
from wasp_cli.store.artifact import exists, read_manifest, read_record
from wasp_cli.store.layout import Layout
from wasp_cli.store.provenance import boot_id, provenance

UNEXPLAINED = 5
"""Deaths of idle workers that a run lives with."""


@dataclass(frozen=True)
class Failure:
    """A node that failed, and why."""

    node: Node
    result: NodeResult


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

    def __init__(self, layout: Layout, run_id: str, pool: Pool, *, cores: int = 1, limit: float | None = None, retries: int = 0) -> None:
        """Prepare a run.

        Args:
            layout: the results folder.
            run_id: the run, whose folder is there.
            pool: who computes.
            cores: of this machine; what a wave leaves free goes to physics and cameras.
            limit: seconds that a node may take; None for no limit.
            retries: further attempts at a node that fails by chance.
        """
        self._layout, self._run_id, self._pool = layout, run_id, pool
        self._cores, self._limit, self._retries = cores, limit, retries
        self._journal = Journal(layout.journal(run_id))
        self._unexplained = 0
        """Deaths of workers that computed nothing."""
        self._broken: dict[str, Node] = {}
        """Failed node by key of itself and of everything that needs it."""
        self.stop = Stop(layout.stop(run_id), lambda: self._journal.write("draining"))
        self.summary = Summary()

    def run(self, plan: Plan) -> Summary:
        """Compute what the plan says, and nothing else.

        Raises:
            KeyboardInterrupt: it was asked to stop; what was finished is kept.
        """
        started = time.monotonic()
        facts = {"pid": os.getpid(), "host": platform.node(), "boot": boot_id(), "jobs": self._pool.jobs, "backend": self._pool.name}
        self._journal.write("run started", nodes=len(plan.to_run()), **facts)
        try:
            for wave in waves(plan.to_run()):
                self._wave(wave, plan)
                if self.stop.asked:
                    raise KeyboardInterrupt
            self._journal.write("run ended", done=self.summary.done, failed=len(self.summary.failed), blocked=len(self.summary.blocked))
        except BaseException as error:
            self._journal.write("run interrupted", cause=type(error).__name__, done=self.summary.done)
            raise
        finally:
            self.summary.seconds = time.monotonic() - started
            self._journal.close()
        return self.summary

    def _wave(self, wave: list[Node], plan: Plan) -> None:
        ready = [node for node in wave if not self._blocked(node)]
        ready.sort(key=lambda node: _rank(node, plan))
        threads = max(1, self._cores // max(1, min(self._pool.jobs, len(ready))))
        nodes = {node.key: node for node in ready}
        for result in self._results([self._job(node, threads) for node in ready]):
            self._ended(nodes[result.key], result)

    def _results(self, node_jobs: list[NodeJob]) -> Iterator[NodeResult]:
        """Give the results of all nodes, over busy ones, further attempts and the deaths of workers.

        A killed worker takes its pool along. What was in flight then runs again, each node alone in a process, so that the one
        that kills is named and the others finish.
        """
        left = {job.key: job for job in node_jobs}
        tries = dict.fromkeys(left, self._retries)
        while left and not self.stop.asked:
            again: dict[str, NodeJob] = {}
            try:
                for result in self._pool.run(self._until_stopped(list(left.values()))):
                    job = left.pop(result.key)
                    if result.state == "busy":
                        # Another run computes it. It is waited for when nothing else of the wave is left to do.
                        again[job.key] = replace(job, wait=True)
                    elif result.state == "failed" and result.by_chance and tries[job.key]:
                        tries[job.key] -= 1
                        again[job.key] = self._another(job, result)
                    elif result.state != "skipped":
                        yield result
            except WorkersDied:
                if not self.stop.asked:
                    yield from self._after_death(left)
            left |= again

    def _until_stopped(self, node_jobs: list[NodeJob]) -> Iterator[NodeJob]:
        for job in node_jobs:
            if self.stop.asked:
                return
            yield job

    def _after_death(self, left: dict[str, NodeJob]) -> Iterator[NodeResult]:
        """The results of what was in flight when a worker died; taken out of `left`."""
        # Asked before anything else runs: a killed worker leaves its running file behind.
        in_flight = self._in_flight()
        for job in [job for job in left.values() if exists(self._layout, job.kind, job.key)]:
            del left[job.key]
            yield self._stored(job)
        suspects = [job for job in left.values() if job.key in in_flight]
        if not suspects:
            # It died between two nodes. Where that goes on, the one that kills before it can say that it runs is found one by one.
            self._unexplained += 1
            if self._unexplained > UNEXPLAINED:
                suspects = list(left.values())
        self._journal.write(
            "worker killed", suspects=[job.key for job in suspects], labels=[job.label for job in suspects], memory_mb=in_flight
        )
        for job in suspects:
            if self.stop.asked:
                return
            del left[job.key]
            yield self._alone(job, in_flight.get(job.key))

    def _alone(self, job: NodeJob, memory: float | None) -> NodeResult:
        """The result of a node that may have killed its worker."""
        started = time.monotonic()
        log = str(self._layout.log(job.run_id, job.label, job.key))
        overdue = self._layout.overdue(self._run_id, job.key)
        try:
            if not was_ended(overdue):
                return self._pool.alone(replace(job, wait=True))
            message, hint = "it did not react to its time limit, so its process was ended", HINT
        except WorkersDied:
            if exists(self._layout, job.kind, job.key):
                return self._stored(job)
            memory = self._in_flight().get(job.key, memory)
            message, hint = KILLED + (f"; it last held {memory:.0f} MB" if memory else ""), None
        result = NodeResult(job.key, "failed", time.monotonic() - started, message=message, hint=hint, log=log)
        record_failure(self._layout, job, result)
        overdue.unlink(missing_ok=True)
        return result

    def _another(self, job: NodeJob, result: NodeResult) -> NodeJob:
        self._journal.write("retry", key=job.key, label=job.label, message=result.message, attempt=job.attempt + 1)
        return replace(job, attempt=job.attempt + 1)

    def _in_flight(self) -> dict[str, float | None]:
        """The memory that each node last held which was running when its worker died, in MB."""
        found = {path.stem: _memory(path) for path in self._layout.run(self._run_id).glob("running/*.json")}
        for key in found:
            self._layout.running(self._run_id, key).unlink(missing_ok=True)
        return found

    def _stored(self, job: NodeJob) -> NodeResult:
        manifest = read_manifest(self._layout, job.kind, job.key)
        log = str(self._layout.log(job.run_id, job.label, job.key))
        return NodeResult(job.key, "done", float(manifest["provenance"]["seconds"]), manifest["summary"], log=log)

    def _ended(self, node: Node, result: NodeResult) -> None:
        facts = {"key": node.key, "label": node.label, "seconds": round(result.seconds, 3)}
        if result.state == "failed":
            self._broken[node.key] = node
            self.summary.failed.append(Failure(node, result))
            self._journal.write("failed", **facts, message=result.message, log=result.log)
        else:
            self.summary.done += result.state == "done"
            self.summary.shared += result.state == "shared"
            self._journal.write(result.state, **facts, numbers=numbers(result.summary))

    def _blocked(self, node: Node) -> bool:
        cause = next((self._broken[needed.key] for needed in node.needs.values() if needed.key in self._broken), None)
        if cause is None:
            return False
        self._broken[node.key] = cause
        self.summary.blocked.append((node, cause))
        self._journal.write("blocked", key=node.key, label=node.label, by=cause.key, by_label=cause.label)
        return True

    def _job(self, node: Node, threads: int) -> NodeJob:
        return NodeJob(
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
            limit=self._limit,
            provenance=provenance(),
        )


def _memory(path: Path) -> float | None:
    try:
        memory = (read_record(path) or {}).get("memory_mb")
    except ArtifactError:  # killed while it wrote
        return None
    return float(memory) if isinstance(memory, int | float) else None


def _rank(node: Node, plan: Plan) -> tuple[float, int]:
    """Longest first, so that a wave does not end with one busy worker."""
    measured = plan.seconds.get(node.sort)
    return (-measured if measured is not None else 0.0), -STAGES[node.kind].weight


def failures_text(failures: Iterable[Failure], names: Mapping[str, str] = NAMES) -> str:
    """Failed nodes with their causes and logs, for people; `names` are by key, where a label does not say enough."""
    parts = []
    for failure in failures:
        result = failure.result
        parts.append(f"  {names.get(result.key, failure.node.label)}: {result.message}")
        if result.hint:
            parts.append(f"      {result.hint}")
        if result.log:
            parts.append(f"      log: {result.log}")
    return "\n".join(parts)
