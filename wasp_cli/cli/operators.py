"""`wasp operators`: the simulated operators alone, and whether their severities are accepted."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

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

operators_app = typer.Typer()


@operators_app.command(
    epilog="[bold]wasp operators specs/table1.yaml --task goal1[/]   ·   "
    "[bold]wasp operators specs/quickstart.yaml --set 'operators={laggy: {mild: 0.5, moderate: 0.7}}'[/]\n\n"
    "Exit codes: 0 nothing is refused, 1 an operator is not accepted or some cells failed, 2 usage, 3 invalid spec, 130 interrupted."
)
@expected_errors
def operators(
    spec: SpecArgument,
    jobs: JobsOption = None,
    results: ResultsOption = Path("results"),
    task: TaskOption = None,
    timeout: TimeoutOption = None,
    retries: RetriesOption = 0,
    backend: BackendOption = "loky",
    scheduler: SchedulerOption = None,
    set_: SetOption = None,
    json: Annotated[bool, typer.Option("--json", help="Every number and verdict, for machines.")] = False,
) -> None:
    """Measure the simulated operators alone, beside the expert, and judge their severities.

    Accepted is an operator whose return falls with every severity, and whose moderate one loses at least a quarter of the expert's.
    Computes what is missing of these cells; `wasp run` of the same spec takes them as they are.
    """
    from wasp_cli.console import out
    from wasp_cli.plan.plan import cells_with_keys
    from wasp_cli.report.render.files import make_own, write_pages
    from wasp_cli.report.render.text import terminal
    from wasp_cli.report.stats.severity_check import read_checks, require_accepted, verdict_lines
    from wasp_cli.report.summarize import wanted_cells
    from wasp_cli.report.tables.severity_check import as_json, check_table, judged
    from wasp_cli.run.session import restricted, run_spec
    from wasp_cli.spec.operators import operators_alone

    loaded = restricted(operators_alone(spec, set_ or ()), task)
    session = run_spec(loaded, results, way_of(jobs, timeout, retries, backend, scheduler))
    # Also after failures: what is there is worth seeing.
    wanted, _ = wanted_cells(session.layout, loaded.spec, cells_with_keys(session.plan.grid))
    checks, frame = read_checks(loaded.spec, wanted)
    table = check_table(checks, frame)
    folder = session.layout.reports(loaded.spec.name)
    make_own(folder)
    files = write_pages(folder, {}, [judged(table, checks)])
    if json:
        print_json(as_json(loaded.spec.name, checks, frame))
    else:
        out().print(terminal(table, out().width))
        for line in ("", *verdict_lines(checks), f"table: {', '.join(map(str, files))}"):
            out().print(line, markup=False, soft_wrap=True)
    session.require_complete()
    require_cells(frame.missing, session.layout)
    require_accepted(checks)
