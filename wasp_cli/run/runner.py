"""Carries out a plan: each node is computed once, as soon as its inputs are there. If one fails,
only the nodes that need it are not computed.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import suppress
from dataclasses import dataclass, field, replace

from wasp_cli.errors import ArtifactError, StoreError
from wasp_cli.plan.bars import Shortfall
from wasp_cli.plan.judged import judged
from wasp_cli.plan.node import Node, with_upstream
from wasp_cli.plan.plan import Plan
from wasp_cli.plan.schedule import Schedule, durations
from wasp_cli.registry import searched_beside
from wasp_cli.run.heartbeat import forget
from wasp_cli.run.job import NodeJob, NodeResult
from wasp_cli.run.limit import HINT, was_ended
from wasp_cli.run.numbers import numbers_line
from wasp_cli.run.pools.base import Pool, WorkersDied
from wasp_cli.run.process import this_process
from wasp_cli.run.record import Journal
from wasp_cli.run.stop import Stop
from wasp_cli.run.worker import KILLED, attempts, is_seen, record_failure, unclosed_file, unseen
from wasp_cli.stages.registry import STAGES
from wasp_cli.store.artifact import exists, read_manifest
from wasp_cli.store.layout import Layout
from wasp_cli.store.lock import is_held
from wasp_cli.store.provenance import provenance
from wasp_cli.store.records import read_record
from wasp_cli.tasks.foreign.closing import HINT as CLOSE_HINT

UNEXPLAINED = 5  # deaths of idle workers, for each worker, after which all nodes are suspected
DEATH_SECONDS = 2.0  # within which a whole pool notices that one of its workers was killed
LOOK_SECONDS = 0.5
POLL_SECONDS = 0.1
# within which an artifact of another machine is seen here: shared file systems remember for a while
# that a name did not exist
ARRIVAL_SECONDS = 60.0
ELSEWHERE = (
    "the worker writes to another folder of this name: every machine needs the same one; then "
    "run again"
)


@dataclass(frozen=True)
class Flight:
    """A node that a worker computes."""

    node: Node
    job: NodeJob
    alone: bool = False
    memory: float | None = None  # what it held when its worker was killed before, in MB
    since: float = field(default_factory=time.monotonic)


@dataclass(frozen=True)
class Death:
    """A node that was lost with its worker."""

    flight: Flight
    suspected: bool
    """Whether it may have killed the worker, so that it runs again in a process of its own."""
    reason: str
    """The backend's message; empty for a process on this machine, for which there is none."""


@dataclass
class Summary:
    """How a run went."""

    done: int = 0
    shared: int = 0
    failed: list[tuple[Node, NodeResult]] = field(default_factory=list)
    blocked: list[tuple[Node, Node]] = field(default_factory=list)
    """Nodes that could not run, each with the failed node that it needs."""
    seconds: float = 0.0
    busy: float = 0.0  # seconds that workers spent on nodes, all together
    workers: int = 1
    untold: StoreError | None = None  # why the journal could not be written

    @property
    def busy_share(self) -> float:
        """The share of the workers' time that they spent on nodes."""
        return self.busy / (self.workers * self.seconds) if self.seconds else 0.0

    @property
    def complete(self) -> bool:
        """Whether no node failed or was blocked."""
        return not self.failed and not self.blocked

    @property
    def only_short(self) -> bool:
        """Whether everything that failed is stored, and fell short of its bar."""
        return all(result.short for _, result in self.failed)


class Runner:
    """Carries out one plan with a pool of workers."""

    def __init__(
        self,
        layout: Layout,
        run_id: str,
        pool: Pool,
        *,
        cores: int = 1,
        threads: int | None = None,
        limit: float | None = None,
        retries: int = 0,
        strict: bool = False,
    ) -> None:
        """Take a plan's settings.

        Args:
            cores: of this machine, which nodes share. Cores that they leave free are used for
                physics and cameras.
            threads: of a node at most; None: no limit of its own.
            limit: seconds that a node may take; None: no limit.
            retries: further attempts of a node that failed by chance.
            strict: whether a node that falls short of its bar counts as failed.
        """
        self._layout = layout
        self._run_id = run_id
        self._pool = pool
        self._cores = cores
        self._threads = threads
        self._limit = limit
        self._retries = retries
        self._strict = strict
        self._journal = Journal(layout.journal(run_id))
        self._unexplained = 0  # deaths of workers that computed nothing
        # what workers compute now, in the order in which it began
        self._flying: dict[Future[NodeResult], Flight] = {}
        self._elsewhere: list[Flight] = []  # what another run computes
        self._suspects: list[Flight] = []  # what ran when a worker was killed
        self._jobs: dict[str, NodeJob] = {}  # what runs again, by key
        self._tries: dict[str, int] = {}  # further attempts that are left, by key
        self._deaths: list[Death] = []  # those that are not in the journal yet
        self._told: set[str] = set()  # what was said of environments that did not close
        # by key of a cell the key of another one that has its first episodes
        self._begun: Mapping[str, str] = {}
        self._deserted = False  # whether all workers are gone
        self._waits = False  # whether it was said that another run computes what is needed
        self.stop = Stop(layout.stop(run_id), lambda: self._journal.write("draining"))
        self.summary = Summary()

    def run(self, plan: Plan) -> Summary:
        """Compute everything that a plan is to run, and return how it went.

        Raises:
            KeyboardInterrupt: the run was asked to stop.
            StoreError: a worker does not see the results folder.
        """
        started = time.monotonic()
        nodes = plan.to_run()
        self._begun = plan.begun
        self.summary.workers = self._pool.jobs
        facts = {
            "nodes": len(nodes),
            "jobs": self._pool.jobs,
            "threads": min(self._cores, self._threads or self._cores),  # of a node at most
            "backend": self._pool.name,
            "locked": self._journal.locked,
        }
        self._journal.write("run started", **facts, **this_process())
        try:
            schedule = Schedule(nodes, durations(nodes, plan.seconds))
            for node, found in short_before(self._layout, plan):
                self._tell_short(node, found)
                if self._strict:
                    self.summary.failed.append((node, short_result(node, found)))
                    self._give_up(schedule, node)
            self._carry_out(schedule)
            if self.stop.asked:
                raise KeyboardInterrupt
            self._journal.write(
                "run ended",
                done=self.summary.done,
                failed=len(self.summary.failed),
                blocked=len(self.summary.blocked),
            )
        except BaseException as error:
            self._journal.write(
                "run interrupted", cause=type(error).__name__, done=self.summary.done
            )
            raise
        finally:
            self.summary.seconds = time.monotonic() - started
            self._journal.close()
            self.summary.untold = self._journal.failure
        return self.summary

    def _carry_out(self, schedule: Schedule) -> None:
        """Keep every worker busy until nothing is left: a node that ends makes room for others, and
        lets those that need it begin.
        """
        while True:
            self._begin(schedule)
            if not self._flying and (self.stop.asked or not (self._elsewhere or len(schedule))):
                return
            for flight, result in self._landed():
                self._handle(schedule, flight, result)
            self._tell_deaths()
            self._tell_desertion()

    def _tell_deaths(self) -> None:
        """Write to the journal which nodes were lost with workers since the last time."""
        if not self._deaths:
            return
        suspects = [death.flight for death in self._deaths if death.suspected]
        self._journal.write(
            "worker killed",
            suspects=[flight.node.key for flight in suspects],
            labels=[flight.node.label for flight in suspects],
            memory_mb={flight.node.key: flight.memory for flight in suspects},
            reason=self._deaths[0].reason,
        )
        self._deaths = []

    def _tell_desertion(self) -> None:
        """Write to the journal that the last worker of a cluster has gone, after which nothing goes
        on, or that one has come back.
        """
        gone = self._pool.gone
        if (gone is None) == self._deserted:
            self._deserted = gone is not None
            self._journal.write(
                "workers gone" if self._deserted else "workers back",
                backend=self._pool.name,
                start=gone,
            )

    def _begin(self, schedule: Schedule) -> None:
        """Give every free worker a node: first suspects, then what is ready, then what another run
        has computed or given up.
        """
        while self._has_room() and not self.stop.asked:
            alone = any(flight.alone for flight in self._flying.values())
            if self._pool.local and self._flying and (self._suspects or alone):
                return  # a suspect runs alone
            if self._suspects:
                flight = self._suspects.pop(0)
                self._flying[self._pool.alone(flight.job)] = replace(
                    flight, alone=True, since=time.monotonic()
                )
            elif len(schedule):
                threads = self._share(len(schedule))
                node = schedule.pop()
                job = self._jobs.pop(node.key, None) or job_of(self._layout, self._run_id, node)
                job = replace(
                    job,
                    earlier=self._begun.get(node.key),
                    threads=threads,
                    limit=self._limit,
                )
                self._flying[self._pool.submit(job)] = Flight(node, job)
            else:
                flight_elsewhere = self._waited()
                if flight_elsewhere is None:
                    return
                self._flying[self._pool.submit(flight_elsewhere.job)] = flight_elsewhere

    def _has_room(self) -> bool:
        """Whether another node may begin. A node with several threads counts as several, so that a
        run never uses more cores than it was given.
        """
        room = max(self._pool.jobs, self._cores)
        return len(self._flying) < self._pool.jobs and self._threads_in_use() < room

    def _share(self, ready: int) -> int:
        """The threads of the next node, if `ready` nodes can begin: an equal share of the cores, as
        far as they are free.
        """
        together = min(self._pool.jobs, len(self._flying) + ready)
        share = min(self._cores // together, self._cores - self._threads_in_use())
        if self._threads is not None:
            share = min(share, self._threads)
        return max(share, 1)

    def _threads_in_use(self) -> int:
        return sum(flight.job.threads for flight in self._flying.values())

    def _waited(self) -> Flight | None:
        """A node whose lock another run has released: it has computed it, or given it up. None
        while it holds all of them. The lock is tried here, since on Slurm asking a worker takes a
        job.
        """
        for place, flight in enumerate(self._elsewhere):
            if not is_held(self._layout.lock(flight.node.key)):
                return self._elsewhere.pop(place)
        return None

    def _landed(self) -> list[tuple[Flight, NodeResult | WorkersDied]]:
        """Wait until a node ends, or its worker."""
        if not self._flying:
            if not self._waits and self._elsewhere:
                self._waits = True
                self._journal.write("waiting")
            time.sleep(LOOK_SECONDS)
            return []
        done, _ = wait(self._flying, LOOK_SECONDS, FIRST_COMPLETED)
        if any(map(_death, done)):
            # A worker that is killed ends its whole pool: the other nodes there are lost too.
            done, _ = wait(self._flying, DEATH_SECONDS)
        # In the order in which they began, so that the order of a journal does not depend on
        # timing.
        ended = [future for future in self._flying if future in done]
        return [(self._flying.pop(future), _death(future) or future.result()) for future in ended]

    def _handle(self, schedule: Schedule, flight: Flight, end: NodeResult | WorkersDied) -> None:
        """Handle the end of a node: begin the nodes that waited for it, run it again, or give up
        the nodes that need it.
        """
        node = flight.node
        job = flight.job
        result: NodeResult | None
        if isinstance(end, WorkersDied):
            result = self._after_death(schedule, flight, str(end))
        else:
            result = end
        if result is None or result.state == "skipped":
            return
        self._tell_unclosed(node, result)

        # Its artifact has to be visible from here.
        if result.state == "unseen":
            raise StoreError(result.message, result.hint)
        if result.state in ("done", "shared") and not self._arrived(job):
            result = self._killed(
                flight, f"its worker says that it is done, but it is not in '{job.root}'", ELSEWHERE
            )

        if result.state == "busy":
            self._elsewhere.append(replace(flight, alone=False))
        elif self._may_run_again(node, result):
            self._tries[node.key] -= 1
            self._jobs[node.key] = replace(job, attempt=job.attempt + 1)
            self._journal.write(
                "retry",
                key=job.key,
                label=job.label,
                message=result.message,
                attempt=job.attempt + 1,
            )
            schedule.put(node)
        else:
            self._finish(schedule, node, result)

    def _may_run_again(self, node: Node, result: NodeResult) -> bool:
        """Whether a failure may be due to chance, and the node has attempts left."""
        left = self._tries.setdefault(node.key, self._retries)
        return result.state == "failed" and result.by_chance and left > 0

    def _finish(self, schedule: Schedule, node: Node, result: NodeResult) -> None:
        """Let the nodes that waited for a node begin, or give them up if it failed, or falls short
        in a strict run.
        """
        short = judged(self._layout, node.kind, node.key) if result.state != "failed" else []
        if short and self._strict:
            result = replace(short_result(node, short), seconds=result.seconds, log=result.log)
        self._ended(node, result)
        if result.short:
            self._give_up(schedule, node)
        elif result.state == "failed":
            self._block(schedule.failed(node), node)
        else:
            self._tell_short(node, short)
            schedule.ended(node)

    def _arrived(self, job: NodeJob) -> bool:
        """Whether an artifact is here. A shared file system may show it later than on the
        machine of its worker.
        """
        end = time.monotonic() + ARRIVAL_SECONDS
        while not exists(self._layout, job.kind, job.key):
            if not is_seen(self._layout, self._run_id):
                raise unseen(job.root, self._run_id)
            if time.monotonic() > end:
                return False
            time.sleep(POLL_SECONDS)
        return True

    def _after_death(self, schedule: Schedule, flight: Flight, reason: str) -> NodeResult | None:
        """The result of a node whose worker was killed; None if it runs again.

        A node that was running is a suspect. Suspects run again one by one in processes of their
        own, so that the one that kills its worker is found, and the others finish.
        """
        job = flight.job
        local = self._pool.local

        # What it last wrote about itself.
        running = self._layout.running(self._run_id, job.key)
        was_running = running.exists()
        memory = None
        with suppress(ArtifactError):  # it was killed while it wrote
            memory = (read_record(running) or {}).get("memory_mb")
        forget(running)

        # It had finished, or the cause of its end is known.
        unclosed = self._unclosed(job)
        if exists(self._layout, job.kind, job.key):
            manifest = read_manifest(self._layout, job.kind, job.key)
            seconds = float(manifest["provenance"]["seconds"])
            return NodeResult(job.key, "done", seconds, manifest["summary"], unclosed=unclosed)
        if unclosed:
            return self._killed(flight, unclosed[0], CLOSE_HINT)
        overdue = self._layout.overdue(self._run_id, job.key)
        if was_ended(overdue):
            return self._killed(
                flight,
                "it exceeded its time limit and did not stop, so its process was ended",
                HINT,
            )
        if flight.alone:
            message = KILLED if local else f"its process ended twice: {reason}"
            memory = memory or flight.memory
            if memory:
                message += f"; it last held {memory:.0f} MB"
            return self._killed(flight, message, None)

        # It runs again. If workers die many times before any node writes that it runs, all nodes
        # are suspects.
        if not was_running:
            self._unexplained += 1
        often = self._unexplained > UNEXPLAINED * self._pool.jobs
        suspected = was_running or not local or often
        lost = replace(flight, memory=memory)
        if suspected:
            self._suspects.append(lost)
        else:
            self._jobs[job.key] = job
            schedule.put(flight.node)
        self._deaths.append(Death(lost, suspected, "" if local else reason))
        return None

    def _unclosed(self, job: NodeJob) -> tuple[str, ...]:
        """A sentence, if the process of a node was ended because its environment did not come back
        from `close()`; else empty.
        """
        marker = unclosed_file(self._layout, job)
        ended = was_ended(marker)
        marker.unlink(missing_ok=True)
        if not ended:
            return ()
        return (
            f"environment '{job.task}' did not come back from close(), so its process was ended",
        )

    def _killed(self, flight: Flight, message: str, hint: str | None) -> NodeResult:
        job = flight.job
        seconds = time.monotonic() - flight.since
        log = self._layout.log(job.run_id, job.label, job.key)
        result = NodeResult(job.key, "failed", seconds, message=message, hint=hint, log=str(log))
        record_failure(self._layout, job, result)
        self._layout.overdue(self._run_id, job.key).unlink(missing_ok=True)
        return result

    def _ended(self, node: Node, result: NodeResult) -> None:
        facts = {"key": node.key, "label": node.label, "seconds": round(result.seconds, 3)}
        self.summary.busy += result.seconds
        if result.state == "failed":
            self.summary.failed.append((node, result))
            self._journal.write("failed", **facts, message=result.message, log=result.log)
        else:
            self.summary.done += result.state == "done"
            self.summary.shared += result.state == "shared"
            self._journal.write(result.state, **facts, numbers=numbers_line(result.summary))

    def _tell_unclosed(self, node: Node, result: NodeResult) -> None:
        """Write to the journal what did not close; once, since it is the same after every node of
        its task.
        """
        for message in result.unclosed:
            if message not in self._told:
                self._told.add(message)
                self._journal.write(
                    "unclosed", key=node.key, label=node.label, message=message, hint=CLOSE_HINT
                )

    def _tell_short(self, node: Node, found: Sequence[Shortfall]) -> None:
        """Write to the journal how a stored node falls short."""
        for each in found:
            self._journal.write(
                "short", key=node.key, label=node.label, message=each.sentence, hint=each.remedy
            )

    def _give_up(self, schedule: Schedule, node: Node) -> None:
        """Begin no more nodes that build on one that falls short. Its artifact stays, for runs that
        are not strict.
        """
        begun = {node.key, *(flight.node.key for flight in self._flying.values())}
        for base in built_on(node):
            self._block(schedule.given_up(base.key, begun), node)

    def _block(self, lost: Iterable[Node], cause: Node) -> None:
        for node in lost:
            self.summary.blocked.append((node, cause))
            self._journal.write(
                "blocked", key=node.key, label=node.label, by=cause.key, by_label=cause.label
            )


def short_before(layout: Layout, plan: Plan) -> list[tuple[Node, list[Shortfall]]]:
    """Return the nodes that a plan builds on, that are stored already and that fall short of their
    bars.
    """
    targets = plan.grid.targets if plan.wanted is None else plan.wanted
    asked = [step.node for step in plan.steps if step.node.key in targets]
    scope = {node.key for node in with_upstream(asked)}
    falling_short = []
    for step in plan.steps:
        if step.state in ("cached", "published") and step.node.key in scope:
            shortfalls = judged(layout, step.node.kind, step.node.key)
            if shortfalls:
                falling_short.append((step.node, shortfalls))
    return falling_short


def short_result(node: Node, found: Sequence[Shortfall]) -> NodeResult:
    """Return the result of a node that falls short, in a strict run: it counts as failed."""
    message = "; ".join(each.sentence for each in found)
    hint = "; ".join(dict.fromkeys(each.remedy for each in found))
    return NodeResult(node.key, "failed", 0.0, message=message, hint=hint, short=True)


def built_on(node: Node) -> tuple[Node, ...]:
    """Return the nodes on which nothing more is built if a node falls short: the node itself, and
    for `diagnostics` also the world model that they judge.
    """
    judges = node.kind == "diagnostics" and "world_model" in node.needs
    return (node, node.needs["world_model"]) if judges else (node,)


def job_of(layout: Layout, run_id: str, node: Node) -> NodeJob:
    """Return what a worker has to know to compute a node, with one thread and without a time
    limit.
    """
    return NodeJob(
        root=str(layout.root),
        run_id=run_id,
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
        sources=node.sources,
        attempt=attempts(layout, node.key) + 1,
        provenance=provenance(),
        folders=searched_beside(),
    )


def _death(future: Future[NodeResult]) -> WorkersDied | None:
    """The error of a future whose worker was killed; None for any other."""
    if not future.done():
        return None
    error = future.exception()
    if isinstance(error, WorkersDied):
        return error
    return None
