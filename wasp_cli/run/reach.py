"""What of a results folder somebody still wants.

That is what the newest run of each spec reaches, what the runs reach that are not over, and whatever a person did: that nobody can compute.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Mapping, Sequence, Set
from contextlib import suppress
from pathlib import Path

from rich.console import Console
from rich.text import Text

from wasp_cli.console import count_table, size, waiting_aloud
from wasp_cli.errors import ArtifactError, StoreError
from wasp_cli.operators.registry import PERSON
from wasp_cli.plan.recorded import PlannedRun, planned_run, run_ids
from wasp_cli.plan.reuse import NONE, lay_out_over
from wasp_cli.run.watch import is_gone, state_of
from wasp_cli.spec.load import load
from wasp_cli.store.artifact import read_manifest, read_record
from wasp_cli.store.find import KIND
from wasp_cli.store.gc import (
    FAILURES,
    LOCKS,
    RUNS,
    TMP,
    WORK,
    Rubbish,
    computed_from,
    locked,
    remove,
    rubbish,
    run_rubbish,
    stored,
    unfinished_sessions,
    with_inputs,
)
from wasp_cli.store.layout import SESSION_FILE, Layout
from wasp_cli.store.lock import held
from wasp_cli.store.reached import reached

BEGINS_SECONDS = 3600.0  # how long a run may take from making its folder to the first line of its journal


def kept_keys(layout: Layout, specs: Iterable[Path]) -> set[str]:
    """Return the keys of everything that specs ask for now, with published results in the place of nodes and without."""
    loaded = [load(path, ()).spec for path in specs]
    return {node.key for spec in loaded for reuse in {NONE, spec.reuse} for node in lay_out_over(spec, layout, reuse).nodes}


def reach_of_runs(layout: Layout, own: Set[str]) -> tuple[set[str], list[str]]:
    """Return the keys that count, and the runs that do not.

    Those are reached by the newest run of each spec name, by the runs that are not over, and by what people did (`own`).
    """
    counting: dict[str, PlannedRun] = {}
    of_people: set[str] = set()
    keys: set[str] = set()
    newest: set[str] = set()
    ids = run_ids(layout)
    for run_id in ids:
        run = planned_run(layout, run_id)
        if run is None:
            folder = layout.run(run_id)
            if os.path.lexists(folder / "plan.json") or os.path.lexists(folder / "sweep.json"):
                why = f"the plan of '{folder}' cannot be read, so what it needs is unknown"
                raise StoreError(why, "remove that folder if nobody needs the run")
            if _age(layout, run_id) < BEGINS_SECONDS:  # an older one was killed while it began
                raise StoreError(f"run '{run_id}' is being planned", "try again once it runs")
            continue
        if run.spec not in newest or _goes_on(layout, run):
            counting[run_id] = run
        newest.add(run.spec)
        if own & run.nodes.keys():  # a report finds a session by the run that asked for it
            of_people.add(run_id)
            keys |= _read_by(run, own)
    # A sweep that counts keeps the runs of its values: its reports are made from them.
    kept = {*counting, *of_people, *(part for run in counting.values() for part in run.parts)}
    keys |= {key for run in counting.values() for key in run.nodes}
    return keys, [run_id for run_id in ids if run_id not in kept]


def unreached(layout: Layout, keep: set[str], *, runs: bool, before: float | None) -> list[Rubbish]:
    """Return what of a results folder can go now; folders of `runs` too, and nothing that was written after `before` (seconds).

    `keep` are further keys to keep, with all that they were computed from. A StoreError where a run does not say what it reaches.
    """
    there = stored(layout)
    own = _of_people(layout, there)
    keys, other_runs = reach_of_runs(layout, own | unfinished_sessions(layout))
    needed = with_inputs(layout, {*keys, *keep, *locked(layout), *own, *computed_from(layout, own, there)}, there)
    return rubbish(layout, needed, there, before) + (run_rubbish(layout, other_runs, before) if runs else [])


def remove_unreached(layout: Layout, keep: set[str], shown: Iterable[Rubbish], *, runs: bool, before: float | None) -> tuple[int, int]:
    """Remove what someone has agreed to, as far as it can still go: a run may have begun since.

    The arguments are those of `unreached`, and `shown` is what was agreed to. Returns how many things went, and their bytes.
    """
    agreed = {item.path for item in shown}
    # While it is held, no run looks for what is there; what has looked before has written down what it reaches.
    with held(layout.planning, waiting_aloud("waiting for a run that is being planned")):
        return remove(layout, [item for item in unreached(layout, keep, runs=runs, before=before) if item.path in agreed])


def _of_people(layout: Layout, there: Mapping[str, list[str]]) -> set[str]:
    """The keys of the cells that a person drove, damaged ones too, and of the clones of people."""

    def driven(key: str) -> bool:
        if os.path.lexists(layout.artifact(KIND, key) / SESSION_FILE):
            return True
        try:
            axes = read_manifest(layout, KIND, key).get("axes")
        except ArtifactError:
            return False
        return isinstance(axes, dict) and axes.get("operator") == PERSON

    return {key for key, kinds in there.items() if "clone" in kinds or (KIND in kinds and driven(key))}


def _read_by(run: PlannedRun, keys: Set[str]) -> set[str]:
    return reached(keys & run.nodes.keys(), lambda key: run.nodes[key].needs if key in run.nodes else ())


def _goes_on(layout: Layout, run: PlannedRun) -> bool:
    with suppress(ArtifactError):  # a full disk
        record = read_record(layout.reporting(run.run_id))
        if record is not None and not is_gone(record):
            return True
    state = state_of(layout, run).state
    return state == "running" or (state == "not started" and _age(layout, run.run_id) < BEGINS_SECONDS)


def _age(layout: Layout, run_id: str) -> float:
    """Seconds since the folder of a run was changed, or until then where a clock was ahead."""
    try:
        return abs(time.time() - layout.run(run_id).lstat().st_mtime)
    except OSError:
        return 0.0


LAST = (WORK, FAILURES, RUNS, TMP, LOCKS)


def show_rubbish(rubbish: Sequence[Rubbish], console: Console) -> None:
    """Print how much of each kind can go."""
    if not rubbish:
        console.print("there is nothing to remove")
        return
    table = count_table("what can go", "count", "size")
    kinds = sorted({item.what for item in rubbish} - set(LAST)) + [what for what in LAST if any(item.what == what for item in rubbish)]
    for kind in kinds:
        sizes = [item.size for item in rubbish if item.what == kind]
        table.add_row(Text(kind), str(len(sizes)), size(sum(sizes)))
    table.add_section()
    table.add_row("total", str(len(rubbish)), size(sum(item.size for item in rubbish)), style="bold")
    console.print(table)


def removed_line(count: int, freed: int) -> str:
    """Return what a removal came to."""
    return f"{count} removed, {size(freed)} freed"
