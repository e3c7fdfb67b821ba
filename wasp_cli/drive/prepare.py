"""What a session needs before it begins: its cells, their models, and what was driven of them
before.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from wasp_cli.drive.block import How
from wasp_cli.drive.participants import cells_of, driven, drivers, ordered
from wasp_cli.drive.session import Session
from wasp_cli.errors import UsageError
from wasp_cli.operators.registry import PERSON
from wasp_cli.plan.grid import Grid
from wasp_cli.plan.node import Cell, Node
from wasp_cli.plan.plan import plan_against
from wasp_cli.plan.reuse import lay_out_over
from wasp_cli.plan.selection import select
from wasp_cli.run.record import new_run
from wasp_cli.run.session import RunOptions, run_spec
from wasp_cli.run.worker import require_whole
from wasp_cli.spec.load import Loaded, limited, load
from wasp_cli.spec.model import Spec
from wasp_cli.stages.registry import stages_of
from wasp_cli.store.artifact import (
    discard,
    exists,
)
from wasp_cli.store.layout import Layout
from wasp_cli.store.people import SESSION_FILE
from wasp_cli.store.records import read_record

SHIPPED = Path("drive")  # the spec behind `wasp drive TASK`


def prepared(
    loaded: Loaded,
    results: Path,
    options: RunOptions,
    participant: int | None,
    how: How,
    *,
    recorded: bool = True,
    trains: bool = True,
) -> Session:
    """Find the cells that a participant is to drive, and compute or bring in what they need.

    Args:
        participant: None: the only one of the spec.
        recorded: whether the session has a run. A check has none: only what had to be computed
            is kept.
        trains: whether models that are neither here nor published are trained.

    Raises:
        UsageError: the spec has no such participant, or nobody can drive it; models are missing
            that are not to be trained; or a part was driven in another kind of session.
    """
    spec = loaded.spec
    participant = _participant(spec, participant)
    if spec.side_by_side != 1:
        raise UsageError("a person drives one episode at a time", "set side_by_side: 1 in the spec")

    # What the cells need is there, or is computed now.
    layout = Layout(results.absolute())
    grid = lay_out_over(spec, layout, None)
    read = dict.fromkeys(
        needed.kind
        for cell, node in grid.cells
        for needed in node.needs.values()
        if cell.operator == PERSON
    )
    chosen = [f"stage={'|'.join(read)}"]
    if not trains:
        _require_trained(loaded, grid, layout, chosen, results)
    # The run of a check has a name of its own: if it is killed, it must not be the last run of the
    # spec.
    asked = loaded
    if not recorded:
        asked = replace(loaded, spec=spec.model_copy(update={"name": f"{spec.name}-check"}))
    made = run_spec(asked, results, options, chosen)
    made.require_complete()
    mine = cells_of(grid, participant)
    if not recorded:
        discard(layout.run(made.run_id))
        return Session(loaded, layout, made.run_id, ordered(mine, participant), how, spec.study)

    begun = _begun(loaded, layout, mine, participant, how)
    run_id = new_run(layout, loaded, plan_against(grid, layout))
    return Session(loaded, layout, run_id, ordered(mine, participant), how, spec.study, begun=begun)


def _participant(spec: Spec, asked: int | None) -> int:
    """The number of the participant who is asked for. Raises UsageError."""
    numbers = drivers(spec)
    if asked is None and len(numbers) == 1:
        (asked,) = numbers
    if asked is not None and asked in numbers:
        return asked
    problem = f"'{spec.name}' has no participant {asked}"
    if asked is None:
        problem = f"'{spec.name}' has several participants"
    raise UsageError(problem, f"--participant takes {', '.join(map(str, numbers))}")


def _require_trained(
    loaded: Loaded, grid: Grid, layout: Layout, chosen: Sequence[str], results: Path
) -> None:
    """Refuse cells whose models would have to be trained first. Raises UsageError."""
    plan = plan_against(grid, layout, wanted=select(grid, chosen))
    missing = [node for node in plan.to_run() if node.kind in stages_of("chain")]
    if not missing:
        return
    command = ["wasp", "run", str(SHIPPED)]
    for each in loaded.overrides:
        if each.path[0] not in ("seeds", "operators", "episodes"):
            command += ["--set", each.text]
    command += ["--select", *chosen, "--results", str(results)]
    names = ", ".join(node.label for node in missing)
    raise UsageError(
        f"driving trains nothing, and these are not there: {names}",
        f"train them first: {shlex.join(command)}",
    )


def _begun(
    loaded: Loaded,
    layout: Layout,
    cells: Sequence[tuple[Cell, Node]],
    participant: int,
    how: How,
) -> dict[str, Path]:
    """By key of a cell that a participant has driven in part, the folder of the longest part."""
    counts = {int(manifest["config"]["episodes"]) for _, manifest in driven(layout, participant)}
    shorter = [
        dict(lay_out_over(limited(loaded, count).spec, layout, None).cells)
        for count in sorted(counts)
        if count < loaded.spec.episodes
    ]
    begun: dict[str, Path] = {}
    for cell, node in cells:
        parts = [part[cell] for part in shorter if exists(layout, part[cell].kind, part[cell].key)]
        folders = [layout.artifact(each.kind, each.key) for each in (node, *parts)]
        # Sessions of a script and of a person do not continue each other, nor do those of a study
        # and others; the same holds for parts.
        for folder in (*folders, layout.work(node.key)):
            before = read_record(folder / SESSION_FILE)
            if before is not None:
                _require_alike(before, loaded.spec, how, f"{node.label} was driven", layout)
        # Damaged files are found now, before anybody drives.
        if not exists(layout, node.kind, node.key):
            own = [node] if (folders[0] / SESSION_FILE).exists() else parts[-1:]
            require_whole(layout, [(each.kind, each.key) for each in (*own, *node.needs.values())])
            if parts:
                begun[node.key] = folders[-1]
    return begun


def _require_alike(
    before: Mapping[str, Any], spec: Spec, how: How, what: str, layout: Layout
) -> None:
    """Refuse to continue an earlier session (its record) of another kind, or of another study.

    Raises:
        UsageError: it was driven by a script and a person drives now, or the other way round; or it
            was driven for another spec, and one of the two is a study.
    """
    studied = spec.study is not None or before.get("study", False)
    if studied and before.get("spec") != spec.name:
        by = f"for '{before.get('spec')}'"
    elif before.get("simulated", False) != how.simulated:
        by = "by a person" if how.simulated else "by a script"
    else:
        return
    hint = "use another folder with --results, or delete it: --participant N --withdraw"
    raise UsageError(f"{what} {by} in '{layout.root}'", hint)


def shipped(
    task: str,
    methods: Sequence[str],
    participant: int,
    seeds: Sequence[int],
    preset: str | None = None,
    settings: Sequence[str] = (),
) -> Loaded:
    """Return the spec behind `wasp drive TASK`, with sessions as seeds. Without a preset it uses
    the published models.
    """
    sizes = []
    if preset is not None:
        # A preset changes the size of what is trained, but not how many episodes a person drives.
        sizes = [f"preset={preset}", f"episodes={load(SHIPPED).spec.episodes}"]
    return load(
        SHIPPED,
        [
            *sizes,
            f"tasks=[{task}]",
            f"methods=[{', '.join(methods)}]",
            f"seeds=[{', '.join(map(str, seeds))}]",
            f"operators={{{PERSON}: {{p{participant}: {participant}}}}}",
            *settings,
        ],
    )
