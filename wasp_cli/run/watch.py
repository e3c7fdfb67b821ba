"""How far a run is: read from its plan, its journal, which it keeps locked, and the small files of
running nodes.

The process itself is not asked, so that this works from another terminal, from another machine, and
after the process has ended.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from statistics import median
from typing import Any, Literal

from wasp_cli.cells.runs import PlannedNode, RunRecord
from wasp_cli.errors import ArtifactError, StoreError
from wasp_cli.plan.unmeasured import DRIVES
from wasp_cli.run.process import is_gone
from wasp_cli.store.layout import Layout, is_key
from wasp_cli.store.lock import is_held
from wasp_cli.store.plain import read_json_lines
from wasp_cli.store.records import read_record

State = Literal["running", "ended", "interrupted", "died", "not started"]
# a running node writes about every second; one that has not written for so long is called silent
STALE_SECONDS = 30.0
ENDS = ("done", "shared", "failed", "blocked")  # events after which a node does not run any more


@dataclass(frozen=True)
class Active:
    """A node that runs, as its file says."""

    key: str
    label: str
    kind: str
    share: float
    text: str
    started: datetime | None
    seen: datetime | None
    memory_mb: float | None
    gone: bool  # its process does not exist any more


@dataclass(frozen=True)
class Failed:
    """A node that failed."""

    key: str
    label: str
    message: str
    log: str


@dataclass(frozen=True)
class RunState:
    """How far a run is."""

    run_id: str
    spec: str
    state: State
    started: datetime | None
    ended: datetime | None  # when it ended or was interrupted; of one that died, its last event
    total: int  # nodes that it was to compute; where there are none, those that it needed
    done: int
    shared: int
    failed: tuple[Failed, ...]
    blocked: int
    retried: int
    draining: bool
    deserted: str  # that no worker is left, and how the run goes on; empty where that is not so
    active: tuple[Active, ...]
    # what remains, by the estimates of the plan; None of a run that does not go on, or when unknown
    left_seconds: float | None
    unknown: int  # nodes to come without an estimate: what remains takes longer by them
    # decisions to come in an environment that no node has measured yet: as above
    unmeasured: int
    idle: bool  # nothing had to be computed; what counts as done was there before
    short: tuple[str, ...] = ()  # what falls short of its bar, a line each

    @property
    def finished(self) -> int:
        """How many nodes have ended, however they did."""
        return self.done + self.shared + len(self.failed) + self.blocked

    @property
    def running(self) -> int:
        """Nodes that run now: none where the run is over, though a killed one leaves their
        files behind.
        """
        return sum(not node.gone for node in self.active) if self.state == "running" else 0

    @property
    def waiting(self) -> int:
        """How many nodes have not begun."""
        return max(self.total - self.finished - self.running, 0)


def state_of(layout: Layout, run: RunRecord, now: datetime | None = None) -> RunState:
    """Return how far a run is; `now` is the time at which that is asked."""
    now = now or datetime.now(UTC)
    events = events_of(layout, run.run_id)
    by_event: dict[str, list[dict[str, Any]]] = {}
    for event in events:
        by_event.setdefault(str(event.get("event")), []).append(event)
    (start, *_) = by_event.get("run started", ({},))

    # How its nodes ended. One that died with its worker and runs again ends twice; the last time
    # counts.
    ends = {
        str(event.get("key")): str(event["event"]) for event in events if event.get("event") in ENDS
    }
    failed = {}
    for event in by_event.get("failed", ()):
        key = str(event.get("key"))
        if ends[key] == "failed":
            message = str(event.get("message") or "unknown cause")
            label = _line(event.get("label"), key)
            failed[key] = Failed(key, label, message, _line(event.get("log"), ""))
    active = _active(layout, run.run_id, ends) if events else ()

    # Whether it lives. The lock of the journal is seen where the process is not, such as from
    # another container of the same host name. If locks do not reach this machine, running nodes
    # still write. A run writes its last event before it releases the lock, so the journal is read
    # again.
    locked = start.get("locked") is True
    held = locked and is_held(layout.journal(run.run_id))
    state, ended = _life(run, events, is_gone(start) and not held)
    silent = all((now - node.seen).total_seconds() > STALE_SECONDS for node in active if node.seen)
    if state == "running" and locked and silent and not held:
        state, ended = _life(run, events_of(layout, run.run_id), gone=True)
    going = state == "running"
    deserted = _desertion_now(events) if going else ""

    # How much there is, and how long the rest takes.
    total = sum(node.runs for node in run.nodes.values()) or int(_number(start, "nodes") or 0)
    before = 0 if total else sum(node.state != "unneeded" for node in run.nodes.values())
    seconds: float | None = None
    unknown = 0
    unmeasured = 0
    if going and not deserted:
        workers = max(int(_number(start, "jobs") or 1), 1)
        threads = max(int(_number(start, "threads") or 1), 1)
        left = [node for node in run.nodes.values() if node.runs and node.key not in ends]
        left, unmeasured = with_decisions(left, run, by_event.get("done", ()))
        seconds, unknown = _left(left, active, workers, threads, now)

    counts = Counter(ends.values())
    return RunState(
        run_id=run.run_id,
        spec=run.spec,
        state=state,
        started=moment(start.get("at")),
        ended=ended,
        total=total or before,
        done=before + counts["done"],
        shared=counts["shared"],
        failed=tuple(failed.values()),
        blocked=counts["blocked"],
        retried=len(by_event.get("retry", ())),
        draining="draining" in by_event and going,
        deserted=deserted,
        active=active,
        left_seconds=seconds,
        unknown=unknown,
        unmeasured=unmeasured,
        idle=not total,
        short=tuple(
            dict.fromkeys(
                f"{_line(event.get('label'), 'a node')}: {_line(event.get('message'), '')}"
                for event in by_event.get("short", ())
            )
        ),
    )


def shown_runs(layout: Layout, runs: Sequence[RunRecord]) -> list[RunState]:
    """Return the runs that go on; if none does, the last one. `runs` are newest first."""
    states = [state_of(layout, run) for run in runs]
    return [state for state in states if state.state == "running"] or states[:1]


def moment(text: object) -> datetime | None:
    """Return a time of a record; None if it is malformed. Without a zone it is taken as UTC."""
    with suppress(ValueError, OverflowError):
        time = datetime.fromisoformat(str(text))
        return (time.replace(tzinfo=UTC) if time.tzinfo is None else time).astimezone(UTC)
    return None


def events_of(layout: Layout, run_id: str) -> list[dict[str, Any]]:
    """Return the events of a run's journal; none if it has no journal that can be read."""
    with suppress(OSError, StoreError):
        return read_json_lines(layout.within(layout.run(run_id)) / "journal.jsonl")
    return []


def _life(
    run: RunRecord, events: Sequence[Mapping[str, Any]], gone: bool
) -> tuple[State, datetime | None]:
    """The state of a run by its events, and when it ended. `gone`: its process has ended."""
    if not events:
        if any(node.runs for node in run.nodes.values()):
            return "not started", None
        return "ended", None
    for event in reversed(events):
        if event.get("event") == "run ended":
            return "ended", moment(event.get("at"))
        if event.get("event") == "run interrupted":
            return "interrupted", moment(event.get("at"))
    if gone:
        return "died", moment(events[-1].get("at"))
    return "running", None


def running_records(layout: Layout, run_id: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the key of each node that runs, and what its file says."""
    with suppress(OSError, StoreError):
        for path in sorted(layout.within(layout.run(run_id) / "running").glob("*.json")):
            with suppress(ArtifactError):  # replaced while it was read
                record = read_record(path) if is_key(path.stem) else None
                if record is not None:
                    yield path.stem, record


def _active(layout: Layout, run_id: str, ends: Mapping[str, str]) -> tuple[Active, ...]:
    nodes = [
        Active(
            key=key,
            label=_line(record.get("label"), key),
            kind=_line(record.get("kind"), ""),
            share=min(max(_number(record, "share") or 0.0, 0.0), 1.0),
            text=_line(record.get("text"), ""),
            started=moment(record.get("started")),
            seen=moment(record.get("at")),
            memory_mb=_number(record, "memory_mb"),
            gone=is_gone(record) and not is_held(layout.lock(key)),
        )
        for key, record in running_records(layout, run_id)
        if key not in ends
    ]
    return tuple(
        sorted(
            nodes, key=lambda node: (node.started or datetime.max.replace(tzinfo=UTC), node.label)
        )
    )


def _line(value: object, otherwise: str) -> str:
    return " ".join(value.split()) if isinstance(value, str) else otherwise


def _number(record: Mapping[str, Any], name: str) -> float | None:
    value = record.get(name)
    return float(value) if isinstance(value, int | float) and abs(value) < 1e15 else None


def _desertion_now(events: Sequence[Mapping[str, Any]]) -> str:
    """That no worker is left, if that is what the journal said last of them; else empty."""
    for event in reversed(events):
        if event.get("event") == "workers gone":
            return desertion(event)
        if event.get("event") == "workers back":
            return ""
    return ""


def desertion(event: Mapping[str, Any]) -> str:
    """Return what an event `workers gone` says, in words."""
    return _line(
        f"all {event.get('backend')} workers are gone; the run waits, and goes on when one "
        f"is there: {event.get('start')}",
        "",
    )


def with_decisions(
    left: Iterable[PlannedNode], run: RunRecord, done: Iterable[Mapping[str, Any]]
) -> tuple[list[PlannedNode], int]:
    """Add the time of decisions in environments that were not measured when the run was planned,
    estimated from nodes that have ended since.

    Returns:
        The nodes, and how many decisions have no estimate yet.
    """
    beyond: dict[str, list[float]] = {}  # seconds of a decision, by task
    for event in done:
        node = run.nodes.get(str(event.get("key")))
        seconds = _number(event, "seconds")
        if node is None or node.kind not in DRIVES or not node.decisions or seconds is None:
            continue
        extra = max(seconds - (node.seconds or 0.0), 0.0)
        beyond.setdefault(node.task, []).append(extra / node.decisions)
    timed: list[PlannedNode] = []
    unmeasured = 0
    for node in left:
        if node.decisions and node.task in beyond and node.seconds is not None:
            driven = median(beyond[node.task]) * node.decisions
            timed.append(replace(node, seconds=node.seconds + driven))
        else:
            timed.append(node)
            unmeasured += node.decisions
    return timed, unmeasured


def _left(
    nodes: Iterable[PlannedNode],
    active: Sequence[Active],
    jobs: int,
    threads: int,
    now: datetime,
) -> tuple[float | None, int]:
    """Seconds for the nodes that have not ended, and how many of them have no estimate; None
    seconds if none has one.

    That is the larger of all work divided by the workers, and the longest chain of nodes that need
    each other. A node of a chain may use all `threads`, and divides the steps of its environment
    among as many processes.
    """
    running = {node.key: node for node in active if not node.gone}
    members = {node.key: node for node in nodes}
    work: list[float] = []
    chain: dict[str, float] = {}  # by key the longest chain that ends with a node
    unknown = 0
    for node in members.values():
        quickest = 0.0
        if node.seconds is None:
            unknown += 1
        else:
            saved = 0.0 if node.stepping is None else node.stepping.saved(threads)
            quickest = max(node.seconds - saved, 0.0)
            rest = _rest(running.get(node.key), quickest, now)
            work.append(node.seconds * rest)
            quickest *= rest
        before = max((chain.get(needed, 0.0) for needed in node.needs), default=0.0)
        chain[node.key] = before + quickest
    if not work:
        return (0.0 if not members else None), unknown
    return max(sum(work) / jobs, *chain.values()), unknown


def _rest(node: Active | None, seconds: float, now: datetime) -> float:
    """The share of a node that is still to come: as it reports itself, or by the time since it
    began, of the `seconds` that it takes.
    """
    if node is None:
        return 1.0
    if node.share > 0.0:
        return 1.0 - node.share
    if node.started is None or seconds <= 0.0:
        return 1.0
    return max(1.0 - (now - node.started).total_seconds() / seconds, 0.0)
