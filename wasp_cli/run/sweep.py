"""One `wasp sweep` from its specs to a filled store: one plan over all values, so that what they share is computed once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from wasp_cli.console import plain
from wasp_cli.errors import UsageError
from wasp_cli.plan.grid import Grid, together
from wasp_cli.plan.plan import plan_against
from wasp_cli.plan.reuse import lay_out_over
from wasp_cli.run.record import new_sweep
from wasp_cli.run.session import RunOptions, Session, carry_out, planning, prepared, restricted
from wasp_cli.spec.sweep import Sweep
from wasp_cli.stages.registry import stages_of
from wasp_cli.store.layout import Layout


@dataclass(frozen=True)
class SweepSession:
    """A sweep that is over."""

    session: Session
    """One run over the nodes of all values."""
    grids: tuple[Grid, ...]
    """What each value asks for."""


def on_task(sweep: Sweep, task: str | None) -> Sweep:
    """The sweep with one of the spec's tasks only (or as it is).

    Raises:
        UnknownName: the spec has no such task.
    """
    return replace(sweep, points=tuple(replace(point, loaded=restricted(point.loaded, task)) for point in sweep.points))


def run_sweep(sweep: Sweep, results: Path, options: RunOptions) -> SweepSession:
    """Compute what is missing of a spec under every value of a setting.

    Args:
        sweep: the setting and its values.
        results: the results folder.
        options: how it is carried out.

    Raises:
        UsageError: there are no cells, or they are the same under every value.
        StoreError: the results folder cannot be written.
        Interrupted: Ctrl-C or SIGTERM; finished nodes are kept.
    """
    grids = tuple(lay_out_over(point.loaded.spec, Layout(results.absolute())) for point in sweep.points)
    _require_effect(sweep, grids)
    layout = prepared(results, options)
    with planning(layout):
        plan = plan_against(together(grids), layout)
        run_id = new_sweep(layout, sweep, plan, grids)
    users = _users(grids)
    plain(_shares(sweep, grids, users))
    names = {node.key: _name(sweep, node.label, users[node.key]) for node in plan.grid.nodes}
    return SweepSession(carry_out(plan, layout, run_id, options, names), grids)


def _require_effect(sweep: Sweep, grids: Sequence[Grid]) -> None:
    cells = [frozenset(node.key for _, node in grid.cells) for grid in grids]
    if not any(cells):
        raise UsageError("there is nothing to compare: the spec evaluates no method", "list methods and operators in the spec")
    if len(set(cells)) == 1:
        methods = ", ".join(sweep.points[0].loaded.spec.methods)
        raise UsageError(f"'{sweep.key}' changes no cell of {methods}: every value would have the same rows", "choose others with --method")


def _users(grids: Sequence[Grid]) -> dict[str, tuple[int, ...]]:
    """Which values need a node, by its key."""
    users: dict[str, tuple[int, ...]] = {}
    for index, grid in enumerate(grids):
        for node in grid.nodes:
            users[node.key] = (*users.get(node.key, ()), index)
    return users


def _name(sweep: Sweep, label: str, users: tuple[int, ...]) -> str:
    """A label, and the values that a node is for where these are not all."""
    if len(users) == len(sweep.points):
        return label
    return f"{label} [{sweep.key}={', '.join(sweep.points[index].text for index in users)}]"


def _shares(sweep: Sweep, grids: Sequence[Grid], users: dict[str, tuple[int, ...]]) -> str:
    """What the values share, and what is trained for each of them: that is what takes time."""
    shared = sum(len(values) == len(grids) for values in users.values())
    own = [node for grid in grids for node in grid.nodes if len(users[node.key]) < len(grids)]
    trained_kinds = stages_of("chain", "round")
    trained = ", ".join(dict.fromkeys(node.kind for node in own if node.kind in trained_kinds))
    text = f"{len(grids)} values of {sweep.key}: {shared} of {len(users)} nodes are the same for all of them"
    return f"{text}; trained for each: {trained}" if trained else text
