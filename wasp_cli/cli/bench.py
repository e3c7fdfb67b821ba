"""`wasp bench planner` and `wasp bench oracle`: what the planner costs, and what it reaches without model errors."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from wasp_cli.cli import completion as complete
from wasp_cli.cli.options import (
    JsonOption,
    ResultsOption,
    SetOption,
    SpecArgument,
    argument,
    expected_errors,
    option,
    print_json,
)

bench_app = typer.Typer(no_args_is_help=True, help="Measure the planner: its speed, and its results with oracle dynamics.")


@bench_app.command(
    epilog="[bold]wasp bench planner[/]   ·   [bold]wasp bench planner specs/quickstart.yaml --threads 1 --batch 10 --json[/]\n\n"
    "Run it on an idle machine: other processes slow it down."
)
@expected_errors
def planner(
    spec: Annotated[
        Path | None,
        argument(metavar="[SPEC]", help="Sizes of models and planner. (default: the preset cpu)", autocompletion=complete.specs),
    ] = None,
    threads: Annotated[int | None, option("--threads", min=1, metavar="N", help="CPU threads. (default: all cores)")] = None,
    batch: Annotated[int, typer.Option("--batch", min=1, metavar="B", help="Episodes decided side by side.")] = 1,
    repeats: Annotated[int, typer.Option("--repeats", min=1, metavar="N", help="Timed decisions of each kind.")] = 5,
    json: JsonOption = False,
    set_: SetOption = None,
) -> None:
    """Time one decision: the safety gate, both gates, and the planner after each gate.

    Times are compared with plain matrix products of the same sizes. Two planners run on the same models: one with the paper's sizes and
    one rollout per candidate, one with the sizes of the spec.
    """
    from wasp_cli.console import out, say
    from wasp_cli.report.render.text import terminal
    from wasp_cli.run.session import cores
    from wasp_cli.spec.derived import bench_configs

    # Read when torch is loaded. Threads that wait too long for one that a busy neighbour delays take its core too.
    os.environ.setdefault("GOMP_SPINCOUNT", "10000")
    os.environ.setdefault("KINETO_LOG_LEVEL", "99")  # torch's profiler says on stderr when it starts and stops
    from wasp_cli.studies.planner_timing import bench_planner, bench_table, notes

    timings = {
        name: bench_planner(*configs, batch=batch, threads=cores() if threads is None else threads, repeats=repeats)
        for name, configs in bench_configs(spec, set_ or ()).items()
    }
    if json:
        print_json({name: bench.as_json() for name, bench in timings.items()})
        return
    out().print(terminal(bench_table(timings), out().width))
    for name, bench in timings.items():
        say(*notes(name, bench))


@bench_app.command(epilog="[bold]wasp bench times results/ > wasp_cli/plan/times.json[/]\n\nCompute the results on an idle machine first.")
@expected_errors
def times(folders: Annotated[list[Path], argument(metavar="DIR...", help="Results folders that this machine computed.")]) -> None:
    """Print what nodes took in results folders, as `wasp plan` estimates from it."""
    from wasp_cli.plan.recorded import planned_runs
    from wasp_cli.plan.times import figures_of
    from wasp_cli.run.record import read_run, results_of
    from wasp_cli.store.artifact import exists, read_manifest

    found = {}
    for folder in folders:
        layout = results_of(folder)
        for run in planned_runs(layout):
            preset = read_run(layout, run.run_id).spec.preset
            for node in run.nodes.values():
                if exists(layout, node.kind, node.key):
                    manifest = read_manifest(layout, node.kind, node.key)
                    if manifest["provenance"].get("run") == run.run_id:
                        found[node.key] = (preset, manifest)
    print_json(figures_of(found.values()))


@bench_app.command("ceiling", hidden=True)  # the name of earlier versions
@bench_app.command(
    epilog="[bold]wasp bench oracle specs/quickstart.yaml --operator laggy=0.7[/]   ·   "
    "[bold]wasp bench oracle specs/table1.yaml --task goal1 --operator noisy=0.4 --variant full --variant safety-only --json[/]\n\n"
    "Eight episodes take minutes: every imagined step is a step of the simulator. Nothing is written to the results folder."
)
@expected_errors
def oracle(
    spec: SpecArgument,
    operator: Annotated[str, option("--operator", metavar="NAME=VALUE", help="Operator to assist: laggy=0.7.")],
    task: Annotated[
        str | None,
        option("--task", "-t", metavar="TASK", help="The task, of a spec that has several.", autocompletion=complete.tasks),
    ] = None,
    episodes: Annotated[int, typer.Option("--episodes", min=1, metavar="N", help="Episodes per method.")] = 8,
    variant: Annotated[
        list[str] | None,
        option("--variant", metavar="NAME", help="WASP variant (repeatable). (default: full)", autocompletion=complete.variants),
    ] = None,
    tau_r: Annotated[
        float, typer.Option("--tau-r", min=0.0, metavar="GAIN", help="Threshold of the task gate (it is not calibrated here).")
    ] = 0.3,
    threads: Annotated[int | None, option("--threads", min=1, metavar="N", help="Simulator threads. (default: all cores)")] = None,
    results: ResultsOption = Path("results"),
    json: JsonOption = False,
    set_: SetOption = None,
) -> None:
    """Run WASP with oracle dynamics: the simulator takes the place of the world model.

    This shows what the planner reaches when the model makes no errors, beside Human-only in the same episodes. The planner is the spec's;
    operator and imagination use the expert that a run of this spec has trained.
    """
    from wasp_cli.console import out
    from wasp_cli.report.render.text import terminal
    from wasp_cli.run.session import cores
    from wasp_cli.studies.oracle_run import measure_oracle, oracle_table

    cell, outcomes = measure_oracle(
        spec, task, operator, variant or ["full"],
        episodes=episodes, tau_r=tau_r, threads=cores() if threads is None else threads, results=results, settings=set_ or (),
    )  # fmt: skip
    if json:
        print_json({"task": cell.task, "operator": cell.variant, "value": cell.value, "seed": cell.seed, "tau_r": tau_r,
                    "rows": [outcome.as_json() for outcome in outcomes]})  # fmt: skip
        return
    out().print(terminal(oracle_table(cell, outcomes), out().width))
