"""`wasp sweep`: one setting, several values."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from wasp_cli.cli import completion as complete
from wasp_cli.cli.options import (
    BackendOption,
    JobsOption,
    ResultsOption,
    RetriesOption,
    SchedulerOption,
    SetOption,
    SpecArgument,
    TaskOption,
    TimeoutOption,
    expected_errors,
    print_json,
    require_cells,
    way_of,
)

sweep_app = typer.Typer()


@sweep_app.command(
    epilog="[bold]wasp sweep specs/quickstart.yaml --vary diffusion.ratio=0,0.2,0.4,0.6 --set 'seeds=[7]'[/]   ·   "
    "[bold]wasp sweep specs/quickstart.yaml --vary wasp.tau_c=0.3,0.5,1 --json[/]\n\n"
    "Exit codes: 0 done, 1 some cells failed, 2 usage, 3 invalid spec under some value, 130 interrupted."
)
@expected_errors
def sweep(
    spec: SpecArgument,
    vary: Annotated[
        list[str],
        typer.Option(
            "--vary",
            metavar="KEY=V1,V2,...",
            help="The setting and its values, each written as for --set.",
            show_default=False,
            autocompletion=complete.settings,
        ),
    ],
    task: TaskOption = None,
    method: Annotated[
        list[str] | None,
        typer.Option(
            "--method",
            "-m",
            metavar="NAME",
            help="Only this method of the spec. Repeatable. (default: the method of the setting and human, or all)",
            show_default=False,
            autocompletion=complete.methods,
        ),
    ] = None,
    jobs: JobsOption = None,
    results: ResultsOption = Path("results"),
    timeout: TimeoutOption = None,
    retries: RetriesOption = 0,
    backend: BackendOption = "loky",
    scheduler: SchedulerOption = None,
    set_: SetOption = None,
    json: Annotated[bool, typer.Option("--json", help="The rows for machines.")] = False,
) -> None:
    """Run a spec once for each value of one setting, and show what the setting does.

    What does not depend on the setting is computed once, and what is in the results folder already is used as it is.
    """
    from wasp_cli.console import out
    from wasp_cli.errors import UsageError
    from wasp_cli.plan.plan import cells_with_keys
    from wasp_cli.report.sweep import report_sweep
    from wasp_cli.run.sweep import on_task, run_sweep
    from wasp_cli.spec.sweep import read_sweep

    if len(vary) > 1:
        raise UsageError("--vary is given twice; a sweep varies one setting", "run one sweep for each, or set the other with --set")
    wanted = on_task(read_sweep(spec, vary[0], method or (), set_ or ()), task)
    done = run_sweep(wanted, results, way_of(jobs, timeout, retries, backend, scheduler))
    layout = done.session.layout
    # Also after failures: the other values are worth seeing, and the report names what is not there.
    report = report_sweep(layout.root, wanted, [cells_with_keys(grid) for grid in done.grids])
    page, *_ = report.write(layout.reports(wanted.name))
    if json:
        print_json({**report.as_json(), "report": str(page)})
    else:
        report.terminal(out())
        out().print(f"report: {page} (its tables, as text and for LaTeX, and the curves are beside it)", markup=False, soft_wrap=True)
    done.session.require_complete()
    require_cells(report.missing, layout)
