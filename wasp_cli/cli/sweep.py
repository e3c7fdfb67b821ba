"""`wasp sweep`: a spec with several values of one setting."""

from __future__ import annotations

from typing import Annotated

from wasp_cli.cli import options
from wasp_cli.cli.command import command
from wasp_cli.cli.completion import setting_names
from wasp_cli.cli.options import print_json
from wasp_cli.cli.parameters import option
from wasp_cli.cli.plan import print_plan
from wasp_cli.cli.run import require_cells
from wasp_cli.console import out, say
from wasp_cli.errors import StoreError, UsageError
from wasp_cli.store.layout import Layout


@command(
    "wasp sweep specs/quickstart.yaml --vary diffusion.ratio=0,0.2,0.4,0.6",
    "wasp sweep specs/quickstart.yaml --vary wasp.tau_c=0.3,0.5,1 --json",
    codes="0 done, 1 some cells failed, 2 usage, 3 the spec is invalid with one of the values, "
    "130 interrupted",
)
def sweep(
    asked: options.SizedSpec,
    vary: Annotated[
        list[str],
        option(
            "KEY=V1,V2,...",
            "The setting and its values, each written as for --set.",
            among=setting_names,
        ),
    ],
    work: options.Work,
    method: options.MethodOption = None,
    reuse: options.ReuseOption = None,
    json: options.JsonOption = False,
) -> None:
    """Run a spec with several values of one setting.

    What does not depend on the setting is computed once. Results that are in the results folder
    already are used. Without --method, Human-only and the method of the setting run, or all methods
    where it is no method's.
    """
    from wasp_cli.cells.asked import asked_of_grid
    from wasp_cli.report.sweep import report_sweep
    from wasp_cli.run.session import planned_sweep, run_sweep
    from wasp_cli.spec.load import read_sweep

    if len(vary) > 1:
        raise UsageError(
            "--vary is given twice; a sweep varies one setting",
            "run one sweep for each, or set the other with --set",
        )
    varied = read_sweep(asked.spec, vary[0], method or (), asked.settings, asked.task)
    how = work.options()
    if work.dry_run:
        print_plan(
            planned_sweep(varied, Layout(asked.results.absolute()), reuse),
            varied.name,
            how.jobs,
            json=json,
        )
        return
    session, grids = run_sweep(varied, asked.results, how, reuse)
    layout = session.layout
    # Also after failures: the report shows what there is, and names what is missing.
    values = [
        asked_of_grid(layout, session.run_id, point.loaded.spec, grid)
        for point, grid in zip(varied.points, grids, strict=True)
    ]
    report = report_sweep(varied, values)
    try:
        page, *_ = report.write(layout.reports(varied.name))
    except (OSError, StoreError) as error:
        session.require_complete(f"the report cannot be written: {error}")
        raise
    layout.reporting(session.run_id).unlink(missing_ok=True)
    if json:
        print_json({**report.as_json(), "report": str(page)})
    else:
        report.terminal(out())
        say(f"report: {page} (its table is in the same folder as CSV, LaTeX and HTML)")
    session.require_complete()
    require_cells(report.missing, layout)
