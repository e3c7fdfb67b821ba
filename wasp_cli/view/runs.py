"""The first page with its runs, a run with its nodes, the log of a node, and what can be asked of a run that goes on."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from wasp_cli.console import duration
from wasp_cli.errors import StoreError, UsageError
from wasp_cli.plan.recorded import PlannedNode, PlannedRun, named_run, planned_runs
from wasp_cli.report.notes import invalid, notes_of
from wasp_cli.run import control
from wasp_cli.run.show import as_json, find_log, life, pace
from wasp_cli.run.watch import ENDS, RunState, events_of, state_of
from wasp_cli.store.artifact import stored_keys, stored_kinds
from wasp_cli.store.plain import open_plain, printable
from wasp_cli.view.site import Site

LISTED = 30
"""Runs on the first page; the newest ones."""
TAIL = 200_000
"""Bytes of a log that are shown: its end."""
NODES = 400
"""Nodes of a stage that are listed."""
FACTS = {"done": "done", "shared": "done", "failed": "failed", "blocked": "blocked", "cancelled": "cancelled"}
UNNEEDED = "not needed"
"""Said of a node that is not in the store, since everything that needs it was there."""
STATES = ("done", "running", "failed", "blocked", "cancelled", "waiting", "cached", UNNEEDED)
ASKS = {"pause": "begins nothing new; what runs goes on to its end", "resume": "goes on", "cancel": "takes a node back, and what needs it"}

BOX, GAP, HIGH = 168, 44, 46
"""Of the graph in px: width and height of a stage, and between layers."""


class Stage(NamedTuple):
    """The nodes of a kind."""

    kind: str
    counts: Mapping[str, int]
    """by state"""
    nodes: Sequence[tuple[PlannedNode, str]]
    """those listed, each with its state"""
    total: int


@dataclass(frozen=True)
class Box:
    """A stage in the graph, in px."""

    kind: str
    x: float
    y: float
    parts: tuple[tuple[str, float, float], ...]
    """state, left edge and width of each part of its bar"""
    words: str


def runs_of(site: Site) -> list[PlannedRun]:
    """Return the runs of a folder, newest first; none where it has none."""
    try:
        return planned_runs(site.layout)
    except StoreError:
        return []


def home_page(site: Site) -> str:
    """Return the first page: runs, what the store holds, notes."""
    runs = runs_of(site)
    states = [state_of(site.layout, run) for run in runs[:LISTED]]
    kinds = [(kind, len(stored_keys(site.layout, kind))) for kind in stored_kinds(site.layout)]
    published = _published(site)
    problems = list(site.cells.problems)
    notes = []
    try:
        notes = notes_of(site.layout)
    except StoreError as error:
        problems.append(error.message)
    return site.render(
        "home.html", "Results", states=[(state, life(state, datetime.now(UTC))) for state in states], more=max(len(runs) - LISTED, 0),
        kinds=kinds, published=published, notes=notes[-50:][::-1], left_out=len(invalid(notes)), problems=problems,
        cells=len(site.cells.listed()), refs={cell.key: site.ref(cell) for cell in site.cells.listed()},
    )  # fmt: skip


def reports(site: Site) -> Iterator[Path]:
    """List the folders of the reports that the results folder holds."""
    for folder in (site.layout.root / "reports", site.layout.published / "reports"):
        with suppress(OSError, StoreError):
            yield from (each for each in sorted(site.layout.within(folder).iterdir()) if each.is_dir() and not each.is_symlink())


def _published(site: Site) -> list[tuple[str, list[tuple[str, str]]]]:
    """The reports, and their pages by name, with addresses where there are any."""
    found = []
    for each in reports(site):
        pages = sorted(path for path in each.iterdir() if path.suffix in (".html", ".md") and path.stem == "report")
        name = str(each if site.links.live else each.relative_to(site.layout.root))
        found.append((name, [(path.name, site.links.report(str(path))) for path in pages]))
    return found


def run_page(site: Site, run_id: str) -> str:
    """Return a run: its progress, which the page follows, its nodes, and what can be asked of it.

    Raises:
        UnknownName: there is no such run.
    """
    run = named_run(runs_of(site), run_id)
    state = state_of(site.layout, run)
    return site.render("run.html", f"Run of {run.spec}", run=run, now=run_now(site, run_id), live=state.state == "running")


def run_now(site: Site, run_id: str) -> Any:
    """Return what changes while a run goes on, as a part of its page."""
    from markupsafe import Markup

    run = named_run(runs_of(site), run_id)
    state = state_of(site.layout, run)
    stages = stages_of(site, run, state)
    boxes, edges, size = graph(run, stages)
    bar = _parts(Counter({"done": state.done + state.shared, "running": state.running, "failed": len(state.failed)}), state.total, 640.0)
    moment = datetime.now(UTC)
    running = [(node, duration((moment - node.started).total_seconds()) if node.started else "") for node in state.active if not node.gone]
    return Markup(
        site.render(
            "now.html", "", run=run, state=state, life=life(state, moment), pace=pace(state), bar=bar, stages=stages, boxes=boxes,
            edges=edges, size=size, running=running if state.state == "running" else [], states=STATES,
        )
    )  # fmt: skip


def run_json(site: Site, run_id: str) -> dict[str, Any]:
    """Return what `wasp status --json` prints of a run."""
    found: dict[str, Any] = as_json([state_of(site.layout, named_run(runs_of(site), run_id))])[0]
    return found


def stages_of(site: Site, run: PlannedRun, state: RunState) -> list[Stage]:
    """Sort the nodes of a run by stage and state; stages in the order of what they need."""
    ends = {str(event.get("key")): FACTS[str(event["event"])] for event in events_of(site.layout, run.run_id) if event.get("event") in ENDS}
    active = {node.key for node in state.active if not node.gone} if state.state == "running" else set()
    by_kind: dict[str, list[tuple[PlannedNode, str]]] = {}
    for node in run.nodes.values():
        before = UNNEEDED if node.state == "unneeded" else "waiting" if node.runs else "cached"
        here = "running" if node.key in active else ends.get(node.key) or before
        by_kind.setdefault(node.kind, []).append((node, here))
    place = layers(run)
    stages = []
    for kind in sorted(by_kind, key=lambda each: (place[each], each)):
        nodes = sorted(by_kind[kind], key=lambda each: (STATES.index(each[1]), each[0].label))
        first = [each for each in nodes if each[1] in ("failed", "running")] + [
            each for each in nodes if each[1] not in ("failed", "running")
        ]
        stages.append(Stage(kind, Counter(here for _, here in nodes), first[:NODES], len(nodes)))
    return stages


def layers(run: PlannedRun) -> dict[str, int]:
    """Return the layer of each stage: one below the deepest one that it needs; stages that need each other share what they have."""
    needs: dict[str, set[str]] = {}
    for node in run.nodes.values():
        kinds = {run.nodes[key].kind for key in node.needs if key in run.nodes}
        needs.setdefault(node.kind, set()).update(kinds - {node.kind})
    place = dict.fromkeys(needs, 0)
    for _ in range(len(needs)):
        moved = {kind: max((place[each] + 1 for each in needs[kind]), default=0) for kind in needs}
        if moved == place or max(moved.values(), default=0) >= len(needs):  # the latter: a circle, which no plan of ours has
            break
        place = moved
    return place


def graph(run: PlannedRun, stages: Sequence[Stage]) -> tuple[list[Box], list[str], tuple[float, float]]:
    """Lay the stages out in columns by layer; returns boxes, the paths between them, and width and height in px."""
    place, rows = layers(run), Counter[int]()
    boxes: dict[str, Box] = {}
    for stage in stages:
        layer = place[stage.kind]
        x, y = layer * (BOX + GAP) + 1.0, rows[layer] * (HIGH + 14) + 1.0
        rows[layer] += 1
        words = ", ".join(f"{stage.counts[name]} {name}" for name in STATES if stage.counts.get(name))
        boxes[stage.kind] = Box(stage.kind, x, y, tuple(_parts(stage.counts, stage.total, BOX - 16.0)), words)
    pairs = {
        (run.nodes[key].kind, node.kind)
        for node in run.nodes.values()
        for key in node.needs
        if key in run.nodes and run.nodes[key].kind != node.kind
    }
    edges = []
    for first, second in sorted(pairs):
        # What is reached through another stage anyway is not drawn.
        if any((first, middle) in pairs and (middle, second) in pairs for middle in boxes):
            continue
        a, b = boxes[first], boxes[second]
        x, y, u, v = a.x + BOX, a.y + HIGH / 2, b.x, b.y + HIGH / 2
        edges.append(f"M{x:g},{y:g} C{x + GAP / 2:g},{y:g} {u - GAP / 2:g},{v:g} {u:g},{v:g}")
    width = max((box.x for box in boxes.values()), default=0.0) + BOX + 2
    height = max((box.y for box in boxes.values()), default=0.0) + HIGH + 2
    return list(boxes.values()), edges, (width, height)


def _parts(counts: Mapping[str, int], total: int, width: float) -> list[tuple[str, float, float]]:
    found, x = [], 0.0
    for name in sorted(STATES, key=lambda each: each != "cached"):  # what was there before comes first
        wide = width * min(counts.get(name, 0) / max(total, 1), 1.0)
        if wide and name not in ("waiting", UNNEEDED):
            found.append((name, round(x, 1), round(wide, 1)))
        x += wide
    return found


def log_page(site: Site, run_id: str, key: str) -> str:
    """Return the log of a node, its end where it is long.

    Raises:
        UsageError: it has none.
        UnknownName: there is no such node.
        StoreError: it cannot be read.
    """
    run = named_run(runs_of(site), run_id)
    log = find_log(site.layout, [run], key)
    try:
        with open_plain(site.layout.within(log.path)) as file:
            size = file.seek(0, 2)
            file.seek(max(size - TAIL, 0))
            text = file.read(TAIL).decode("utf-8", "replace")
    except OSError as error:
        raise StoreError(f"cannot read '{log.path}': {(error.strerror or str(error)).lower()}") from error
    lines = [printable(line.rpartition("\r")[2]) for line in text.replace("\r\n", "\n").split("\n")]
    return site.render("log.html", f"Log of {log.label}", run=run, log=log, text="\n".join(lines), cut=size > TAIL)


def confirm_page(site: Site, run_id: str, what: str, node: str) -> str:
    """Return the question before something is asked of a run.

    Raises:
        UsageError: nothing of this kind can be asked, or the run is over.
    """
    (run,) = _live(site, run_id, what)
    label = _node(run, node).label if what == "cancel" else ""
    return site.render("confirm.html", f"{what} {run.spec}?", run=run, what=what, meaning=ASKS[what], node=node, label=label)


def asked(site: Site, run_id: str, what: str, node: str) -> str:
    """Ask a run to pause, to go on, or to take a node back, as the commands do; returns what was done, in words.

    Raises:
        UsageError: nothing of this kind can be asked, or the run is over.
    """
    runs = _live(site, run_id, what)
    if what == "pause":
        control.pause(site.layout, runs[0])
        return "paused"
    if what == "resume":
        return "goes on" if control.resume(site.layout, runs[0]) else "was not paused"
    taken = control.cancel(site.layout, runs, _node(runs[0], node).key)
    return f"{taken[0].node.label} is taken back"


def _live(site: Site, run_id: str, what: str) -> list[PlannedRun]:
    if what not in ASKS:
        raise UsageError(f"'{what}' cannot be asked of a run")
    return control.live_runs(site.layout, runs_of(site), run_id)


def _node(run: PlannedRun, key: str) -> PlannedNode:
    if key not in run.nodes:
        raise UsageError(f"the run has no node '{key}'")
    return run.nodes[key]
