"""`wasp run` and `wasp ablate`: a spec is computed, and its tables are printed."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from wasp_cli.cli import options
from wasp_cli.cli.command import command
from wasp_cli.cli.completion import spec_names, variant_names
from wasp_cli.cli.parameters import option
from wasp_cli.cli.plan import print_plan
from wasp_cli.cli.report import NotWritten, show_report
from wasp_cli.console import plain
from wasp_cli.errors import CellsFailed, StoreError, first
from wasp_cli.store.layout import Layout

if TYPE_CHECKING:
    from wasp_cli.cells.read import Missing
    from wasp_cli.run.session import RunOptions
    from wasp_cli.spec.load import Loaded


@command(
    "wasp run specs/quickstart.yaml",
    "wasp run specs/table1.yaml --task goal1 -j 8 --set episodes=10",
    codes="0 done, 1 some cells failed or a stage fell short (--strict), 2 usage, 3 invalid spec, "
    "130 interrupted",
)
def run(asked: options.SelectedSpec, work: options.Work) -> None:
    """Run a spec and print its tables.

    Only what is missing in the results folder is computed; failed nodes run again. The first Ctrl-C
    lets running nodes finish, the second stops at once. Finished nodes are kept either way.
    """
    from wasp_cli.plan.planned import planned

    loaded = asked.load()
    how = work.options()
    if work.dry_run:
        plan = planned(loaded, asked.results, asked.select or (), asked.reuse, failed=asked.failed)
        print_plan(plan, loaded.spec.name, how.jobs)
    else:
        run_and_report(
            loaded, asked.results, how, asked.select or (), asked.reuse, failed=asked.failed
        )


@command("wasp ablate --variant no-case2 --task goal1 --preset smoke --set 'seeds=[0]'")
def ablate(
    variant: Annotated[
        str, option("NAME", "The ablation, for example no-case2.", among=variant_names)
    ],
    asked: options.Sized,
    work: options.Work,
    spec: Annotated[
        Path, option("SPEC", "Gives operators, seeds and budgets.", among=spec_names)
    ] = Path("specs/table2.yaml"),
    reuse: options.ReuseOption = None,
) -> None:
    """Compare a method with one of its ablations.

    Both stand beside the operators alone. Operators, seeds and episodes are those of the spec. With
    many of them this takes long:
    --dry-run says how long, --set changes them.
    """
    from wasp_cli.plan.planned import planned
    from wasp_cli.spec.load import ablation

    how = work.options()
    loaded = ablation(spec, variant, asked.task, asked.preset, asked.set_ or ())
    print_plan(
        planned(loaded, asked.results, reuse=reuse),
        loaded.spec.name,
        how.jobs,
        aside=not work.dry_run,
    )
    if not work.dry_run:
        run_and_report(loaded, asked.results, how, reuse=reuse)


def run_and_report(
    loaded: Loaded,
    results: Path,
    how: RunOptions,
    select: Sequence[str] = (),
    reuse: str | None = None,
    *,
    failed: bool = False,
) -> None:
    """Compute what is missing of a spec, print its tables and write its report.

    Args:
        how: workers and limits.
        select: selectors of `--select`; none: everything.
        reuse: which published results are used; None: what the spec says.
        failed: only nodes that failed before.

    Raises:
        CellsFailed: a node failed, or cells cannot be read.
        NotWritten: the report cannot be written.
        Interrupted: the run was asked to stop.
    """
    from wasp_cli.cells.asked import asked_of_grid
    from wasp_cli.run.session import run_spec
    from wasp_cli.spec.paper import load_paper

    paper = load_paper()  # read first, so that a mistake in it is reported before anything runs
    session = run_spec(loaded, results, how, select, reuse, failed=failed)
    # Also after failures: the report shows what there is, and names what is missing.
    grid = session.plan.grid
    selected = session.plan.wanted
    asked = asked_of_grid(session.layout, session.run_id, loaded.spec, grid)
    try:
        report = show_report(asked, paper, redraw=False)
    except NotWritten as error:
        session.require_complete(error.message)
        raise
    session.layout.reporting(session.run_id).unlink(missing_ok=True)
    say_next(results, [(cell.method, node.label, node.key) for cell, node in grid.cells])
    session.require_complete()
    require_cells(
        [cell for cell in report.missing if selected is None or cell.key in selected],
        session.layout,
    )


def say_next(results: Path, cells: Sequence[tuple[str, str, str]]) -> None:
    """Print the commands that may follow a run; `cells` are method, label and key of each cell."""
    from wasp_cli.store.tables import cell_file, read_steps

    option = "" if results == Path("results") else f" --results {shlex.quote(str(results))}"
    plain(f"next: wasp view{option}   (every number leads to its episodes and decisions)")
    for _, label, key in sorted(cells, key=lambda cell: cell[0] != "wasp"):
        with suppress(StoreError):  # failed cells have no steps, and some published ones neither
            if read_steps(cell_file(Layout(results).artifact("evaluate", key))).num_rows:
                plain(
                    f"      wasp explain {shlex.quote(label)} --episode 0{option}   (what "
                    "the assistant did, and why)"
                )
                break
    plain(f"      wasp report {shlex.quote(str(results))}   (adds pictures of the trained parts)")


def require_cells(missing: Sequence[Missing], layout: Layout) -> None:
    """Raise CellsFailed if cells have no readable rows. Cells whose bytes differ from their
    manifests are taken out of use, so that the next run computes them again.

    A file that merely could not be read stays in use, and so does a cell that a person drove.
    """
    from wasp_cli.store.artifact import corruption, invalidate
    from wasp_cli.store.layout import SESSION_FILE

    unreadable = [cell for cell in missing if not cell.invalid]
    if not unreadable:
        return
    for cell in unreadable:
        if not cell.damaged or (layout.artifact(cell.kind, cell.key) / SESSION_FILE).exists():
            continue
        if corruption(layout, cell.kind, cell.key) is not None:
            invalidate(layout, cell.kind, cell.key, cell.reason)
    cells = "1 cell" if len(unreadable) == 1 else f"{len(unreadable)} cells"
    lines = first([f"  {cell.label}: {cell.reason}" for cell in unreadable], 10)
    raise CellsFailed(
        "\n".join([f"{cells} cannot be read:", *lines]),
        "run again: cells that have other bytes than were stored are computed again",
    )
