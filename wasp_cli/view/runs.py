"""The first page with its runs, a run with its nodes, the log of a node."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from wasp_cli.console import duration
from wasp_cli.errors import StoreError
from wasp_cli.plan.recorded import PlannedRun, named_run, planned_runs, upstream_first
from wasp_cli.report.notes import invalid, notes_of
from wasp_cli.run.show import find_log, life, pace
from wasp_cli.run.watch import ENDS, RunState, events_of, state_of
from wasp_cli.store.artifact import stored_keys, stored_kinds
from wasp_cli.store.plain import open_plain, printable
from wasp_cli.view.site import Site

LISTED = 30  # runs on the first page; the newest ones
TAIL = 200_000  # bytes of a log that are shown: its end
FACTS = {"done": "done", "shared": "done", "failed": "failed", "blocked": "blocked", "cancelled": "cancelled"}
UNNEEDED = "not needed"  # said of a node that is not in the store, since everything that needs it was there
STATES = ("done", "running", "failed", "blocked", "cancelled", "waiting", "cached", UNNEEDED)
BAR = 640  # of the bar of a run: its width in px


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
        listed={cell.key: cell for cell in site.cells.listed()},
    )  # fmt: skip


def reports(site: Site) -> Iterator[Path]:
    """List the folders of the reports that the results folder holds."""
    for folder in (site.layout.root / "reports", site.layout.published / "reports"):
        with suppress(OSError, StoreError):
            yield from (report for report in sorted(site.layout.within(folder).iterdir()) if report.is_dir() and not report.is_symlink())


def _published(site: Site) -> list[tuple[str, list[tuple[str, str]]]]:
    """The reports, and their pages by name, with addresses where there are any."""
    published = []
    for report in reports(site):
        pages = sorted(path for path in report.iterdir() if path.suffix in (".html", ".md") and path.stem == "report")
        name = str(report if site.links.live else report.relative_to(site.layout.root))
        published.append((name, [(path.name, site.links.report(str(path))) for path in pages]))
    return published


def run_page(site: Site, run_id: str) -> str:
    """Return a run: its progress, which the page follows, and its nodes."""
    run = named_run(runs_of(site), run_id)
    state = state_of(site.layout, run)
    return site.render("run.html", f"Run of {run.spec}", run=run, now=run_now(site, run_id), live=state.state == "running")


def run_now(site: Site, run_id: str) -> Any:
    """Return what changes while a run goes on, as a part of its page."""
    from markupsafe import Markup

    run = named_run(runs_of(site), run_id)
    state = state_of(site.layout, run)
    bar, x = [], 0.0
    for name, count in (("done", state.done + state.shared), ("running", state.running), ("failed", len(state.failed))):
        width = BAR * min(count / max(state.total, 1), 1.0)
        bar.append((name, round(x, 1), round(width, 1)))
        x += width
    moment, stages = datetime.now(UTC), stages_of(site, run, state)
    running = [(node, duration((moment - node.started).total_seconds()) if node.started else "") for node in state.active if not node.gone]
    return Markup(
        site.render(
            "now.html", "", run=run, state=state, life=life(state, moment), pace=pace(state), bar=bar,
            stages=stages, states=[name for name in STATES if any(counts[name] for counts in stages.values())],
            running=running if state.state == "running" else [],
        )
    )  # fmt: skip


def stages_of(site: Site, run: PlannedRun, state: RunState) -> dict[str, Counter[str]]:
    """Count the nodes of a run by stage and state; stages in the order of what they need."""
    ends = {str(event.get("key")): FACTS[str(event["event"])] for event in events_of(site.layout, run.run_id) if event.get("event") in ENDS}
    active = {node.key for node in state.active if not node.gone} if state.state == "running" else set()
    stages: dict[str, Counter[str]] = {}
    for node in upstream_first(run.nodes):
        before = UNNEEDED if node.state == "unneeded" else "waiting" if node.runs else "cached"
        stages.setdefault(node.kind, Counter())["running" if node.key in active else ends.get(node.key) or before] += 1
    return stages


def log_page(site: Site, run_id: str, key: str) -> str:
    """Return the log of a node, its end where it is long."""
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
