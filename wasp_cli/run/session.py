"""One `wasp run`, or one `wasp sweep`, from a valid spec to a filled store: plan, pool, board,
signals, summary.

A sweep is one run with one plan over all values, so that what they share is computed once.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from wasp_cli.console import duration, plain, waiting_aloud
from wasp_cli.errors import ArtifactError, CellsFailed, Interrupted, UsageError, first
from wasp_cli.plan.grid import Grid, stage_class, together
from wasp_cli.plan.node import Node
from wasp_cli.plan.offered import forget_digests
from wasp_cli.plan.plan import Plan, plan_against
from wasp_cli.plan.planned import laid_out
from wasp_cli.plan.schedule import durations, simulated
from wasp_cli.plan.selection import select
from wasp_cli.plan.text import reason_lines
from wasp_cli.run.board import board
from wasp_cli.run.cores import cores, thread_limit
from wasp_cli.run.pools.choice import LOCAL, pool_of, require_backend
from wasp_cli.run.record import new_run, new_sweep
from wasp_cli.run.runner import Runner, Summary, short_before, short_result
from wasp_cli.run.shared_memory import require_semaphores
from wasp_cli.run.signals import SIGNALS
from wasp_cli.run.stop import listening
from wasp_cli.spec.load import Loaded, Sweep
from wasp_cli.stages.registry import stages_of
from wasp_cli.store.artifact import invalidate, read_manifest, sweep
from wasp_cli.store.layout import Layout
from wasp_cli.store.lock import held
from wasp_cli.store.published import import_artifact
from wasp_cli.store.slim import WITHOUT_STEPS, without_steps


@dataclass(frozen=True)
class Session:
    """A run that has ended, however it went."""

    layout: Layout
    run_id: str
    plan: Plan
    summary: Summary
    names: Mapping[str, str]  # what users call a node, by its key, if that is not its label

    def require_complete(self, *also: str) -> None:
        """Raise an error unless every node ended well.

        Args:
            also: further lines of the error, about other problems.

        Raises:
            CellsFailed: a node failed.
            StoreError: the journal could not be written.
        """
        summary = self.summary
        if summary.untold is not None:
            raise summary.untold
        if summary.complete:
            return
        hint = "run the same command again to compute it"
        if summary.failed:
            hint = "run the same command again to retry what failed"
            if summary.only_short:
                hint = "what is stored stays; without --strict, a run goes on with it"
        lines = [*self._failures(), *self._blocked(), *also]
        raise CellsFailed("\n".join(lines), hint)

    def _failures(self) -> list[str]:
        if not self.summary.failed:
            return []
        lines = [f"{len(self.summary.failed)} failed:"]
        for node, result in self.summary.failed:
            lines.append(f"  {self._name(node)}: {result.message}")
            if result.hint:
                lines.append(f"      {result.hint}")
            if result.log:
                lines.append(f"      log: {result.log}")
        return lines

    def _blocked(self) -> list[str]:
        if not self.summary.blocked:
            return []
        names = [
            f"  {self._name(node)} (needs {self._name(cause)})"
            for node, cause in self.summary.blocked
        ]
        return [f"{len(names)} blocked by them:", *first(names, 10)]

    def _name(self, node: Node) -> str:
        return self.names.get(node.key, node.label)


@dataclass(frozen=True)
class RunOptions:
    """How a run is carried out. None of it changes a result."""

    jobs: int  # worker processes at most; 0 computes in this process
    limit: float | None = None  # seconds that a node may take
    retries: int = 0
    backend: str = LOCAL
    scheduler: str | None = None
    # whether this process writes a report afterwards, and then removes `Layout.reporting`
    reports: bool = False
    strict: bool = False  # whether a stage that falls short of its bar counts as failed


def run_spec(
    loaded: Loaded,
    results: Path,
    options: RunOptions,
    chosen: Sequence[str] = (),
    reuse: str | None = None,
    *,
    failed: bool = False,
) -> Session:
    """Compute what is missing of a spec.

    Args:
        chosen: selectors (`plan.selection`); none: everything.
        reuse: which published results are used; None: what the spec says.
        failed: only nodes that failed before, and those that wait for them.

    Raises:
        UsageError: the backend cannot be used, or no node is selected.
        Interrupted: the run was asked to stop.
    """
    grid = laid_out(loaded, Layout(results.absolute()), reuse)
    selected = select(grid, chosen)
    with planning(results, options) as layout:
        plan = plan_against(grid, layout, wanted=selected, failed_only=failed)
        _require_workers(plan, options)
        _take_back(plan, layout)
        run_id = new_run(layout, loaded, plan, reports=options.reports)
    return carry_out(plan, layout, run_id, options, {})


def _require_workers(plan: Plan, options: RunOptions) -> None:
    """Check that worker processes can be started here, before anything is written. A single one is
    not needed, since this process can compute instead.
    """
    workers = _workers(plan, options)
    if options.backend == LOCAL and workers > 1:
        require_semaphores(workers)


def _workers(plan: Plan, options: RunOptions) -> int:
    """How many worker processes will have something to do; idle ones would only take memory."""
    nodes = plan.to_run()
    if not nodes:
        return 0
    _, side_by_side = simulated(nodes, durations(nodes, plan.seconds), None)
    return min(options.jobs, side_by_side)


def _take_back(plan: Plan, layout: Layout) -> None:
    """Take cells out of use that were published without steps which are needed now."""
    for node in (step.node for step in plan.steps if step.state == "damaged"):
        with suppress(ArtifactError):  # it may have been removed or repaired meanwhile
            if without_steps(read_manifest(layout, node.kind, node.key)):
                invalidate(layout, node.kind, node.key, WITHOUT_STEPS)


@contextmanager
def planning(results: Path, options: RunOptions) -> Iterator[Layout]:
    """Yield a results folder that can be written, for a run that is being planned. What killed runs
    have left is removed, and `wasp gc` waits until the block ends.

    Raises:
        UsageError: the backend cannot be used.
        StoreError: the folder cannot be written.
    """
    require_backend(options.backend, options.scheduler)
    layout = Layout(results.absolute())
    layout.prepare()
    sweep(layout)
    with held(layout.planning, waiting_aloud("waiting for wasp gc"), shared=True):
        yield layout


def carry_out(
    plan: Plan, layout: Layout, run_id: str, options: RunOptions, names: Mapping[str, str]
) -> Session:
    """Copy published results, compute the rest, and print how it went.

    Args:
        names: what users call a node, by its key, if that is not its label.

    Raises:
        ArtifactError: a published result is damaged.
        Interrupted: the run was asked to stop.
    """
    for note in plan.grid.notes:
        plain(note)

    # Published results are copied into the store, so that workers need not know about them.
    offers = [
        plan.grid.reused[step.node.key].offer for step in plan.steps if step.state == "published"
    ]
    for offer in offers:
        wait = waiting_aloud(f"waiting for {offer.kind}/{offer.key}, which another run computes")
        try:
            import_artifact(layout, offer, wait)
        except ArtifactError:
            forget_digests(offer.source)  # so that the next plan leaves it alone
            raise
    if offers:
        reasons = reason_lines(plan, "published")
        plain("\n  ".join([f"{len(offers)} published results are used:", *reasons]))

    if plan.to_run():
        summary = _compute(plan, layout, run_id, options, names)
    else:
        summary = Summary()
        if options.strict:
            short = short_before(layout, plan)
            summary.failed = [(node, short_result(node, found)) for node, found in short]

    parts = [f"{summary.done} computed", *_idle(plan, summary.shared)]
    if summary.failed:
        parts.append(f"{len(summary.failed)} failed")
    if summary.blocked:
        parts.append(f"{len(summary.blocked)} blocked")
    took = duration(summary.seconds)
    if summary.done and summary.workers > 1:
        took += f", workers busy {summary.busy_share:.0%} of it"
    plain(f"{', '.join(parts)} in {took}")
    return Session(layout, run_id, plan, summary, names)


def _compute(
    plan: Plan, layout: Layout, run_id: str, options: RunOptions, names: Mapping[str, str]
) -> Summary:
    """Compute the nodes of a plan. Raises Interrupted if the run was asked to stop."""
    # The workers, and what to expect of them.
    nodes = len(plan.to_run())
    most = _threads_of_a_node(plan) if options.backend == LOCAL else None
    pool = pool_of(options.backend, _workers(plan, options), options.scheduler)
    shared = min(cores(), max(options.jobs, 1)) if pool.local else 1
    seconds, unknown = plan.estimate(pool.jobs, min(shared, most or shared))
    estimate = f", about {duration(seconds)}" if seconds and not unknown else ""
    if estimate and plan.unmeasured:
        estimate += " and the time in the environment, which is not known yet"
    plain(
        f"{nodes} to compute, {', '.join(_idle(plan))}{estimate}; logs in "
        f"{layout.run(run_id) / 'logs'}"
    )
    runner = Runner(
        layout,
        run_id,
        pool,
        cores=shared,
        threads=most,
        limit=options.limit,
        retries=options.retries,
        strict=options.strict,
    )

    # The run itself.
    try:
        with listening(runner.stop), board(layout, run_id, nodes, names):
            summary = runner.run(plan)
        if runner.stop.asked:  # after the last node has ended
            raise KeyboardInterrupt
    except BaseException as error:
        for number in SIGNALS:
            signal.signal(number, signal.SIG_IGN)  # one more Ctrl-C must not leave workers behind
        pool.close(kill=True)
        if not isinstance(error, KeyboardInterrupt):
            raise
        kept = (
            f"{runner.summary.done + runner.summary.shared} of {nodes} nodes were finished and "
            "are kept"
        )
        raise Interrupted(
            f"interrupted: {kept}", "run the same command again to continue"
        ) from None
    pool.close()
    return summary


def _threads_of_a_node(plan: Plan) -> int | None:
    """How many threads the user's variables allow a node; None if there is no limit.

    Raises:
        UsageError: a stage of a plugin computes with more; fewer would round differently.
    """
    limit = thread_limit()
    if limit is None:
        return None
    name, most = limit
    for kind in dict.fromkeys(node.kind for node in plan.to_run()):
        needed = getattr(stage_class(kind), "torch_threads", 1)
        if needed > most:
            raise UsageError(
                f"the stage '{kind}' computes with {needed} threads, and {name} allows {most}",
                f"set {name}={needed}, or unset it: with other threads it rounds differently",
            )
    return most


def _idle(plan: Plan, shared: int = 0) -> list[str]:
    published = plan.count("published")
    counts = [f"{plan.count('cached') + shared} computed before"]
    if published:
        counts.append(f"{published} published")
    return counts


def planned_sweep(sweep: Sweep, layout: Layout, reuse: str | None = None) -> Plan:
    """Return the plan that `run_sweep` would carry out; the results folder need not be there."""
    return plan_against(together(_grids(sweep, layout, reuse)), layout)


def run_sweep(
    sweep: Sweep, results: Path, options: RunOptions, reuse: str | None = None
) -> tuple[Session, tuple[Grid, ...]]:
    """Compute what is missing of a spec under every value of a setting, in one run over the nodes
    of all values.

    Returns:
        The run, and the grid of each value.

    Raises:
        UsageError: there are no cells, or they are the same under every value.
        Interrupted: the run was asked to stop.
    """
    grids = _grids(sweep, Layout(results.absolute()), reuse)
    with planning(results, options) as layout:
        plan = plan_against(together(grids), layout)
        _require_workers(plan, options)
        _take_back(plan, layout)
        run_id = new_sweep(layout, sweep, plan, grids, reports=options.reports)

    # Which nodes the values share, as one line.
    users: dict[str, list[int]] = {}
    for index, grid in enumerate(grids):
        for node in grid.nodes:
            users.setdefault(node.key, []).append(index)
    for_some = [node for node in plan.grid.nodes if len(users[node.key]) < len(grids)]
    same = len(users) - len(for_some)
    line = (
        f"{len(grids)} values of {sweep.key}: {same} of {len(users)} nodes are the same for all of "
        "them"
    )
    # Parts that are trained for each value take most of the time.
    trained = dict.fromkeys(node.kind for node in for_some if node.kind in stages_of("chain"))
    if trained:
        line += f"; trained for each: {', '.join(trained)}"
    plain(line)

    # The other nodes are named with their values.
    values = {
        node.key: ", ".join(sweep.points[index].text for index in users[node.key])
        for node in for_some
    }
    names = {node.key: f"{node.label} [{sweep.key}={values[node.key]}]" for node in for_some}
    return carry_out(plan, layout, run_id, options, names), grids


def _grids(sweep: Sweep, layout: Layout, reuse: str | None) -> tuple[Grid, ...]:
    grids = tuple(laid_out(point.loaded, layout, reuse) for point in sweep.points)
    cells = [frozenset(node.key for _, node in grid.cells) for grid in grids]
    if not any(cells):
        raise UsageError(
            "there is nothing to compare: the spec evaluates no method",
            "list methods and operators in the spec",
        )
    if len(set(cells)) == 1:
        methods = ", ".join(sweep.points[0].loaded.spec.methods)
        raise UsageError(
            f"'{sweep.key}' changes no cell of {methods}: every value would have the same rows",
            "choose others with --method",
        )
    return grids
