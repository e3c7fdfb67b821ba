"""The commands about whole results folders: `wasp report`, `compare`, `gc`, `publish` and
`verify`.
"""

from __future__ import annotations

import os
import sys
import time
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from wasp_cli.cli import options
from wasp_cli.cli.options import (
    argument,
    command,
    directory,
    flag,
    option,
    parse_folder,
    print_json,
)
from wasp_cli.console import err, say, size, waiting_aloud
from wasp_cli.console import out as console
from wasp_cli.errors import (
    ArtifactError,
    CellsFailed,
    DrawingError,
    NotAccepted,
    StoreError,
    UnknownName,
    UsageError,
    WaspError,
    first,
    refusal,
)
from wasp_cli.store.layout import Layout, slug

if TYPE_CHECKING:
    from wasp_cli.cells.asked import Asked
    from wasp_cli.cells.runs import LastRuns
    from wasp_cli.compare import Compared
    from wasp_cli.report.films import Draw
    from wasp_cli.report.summarize import Report
    from wasp_cli.spec.paper import Paper


class NotWritten(WaspError):
    """The files of a report cannot be written; what it prints was printed."""


@command(
    "wasp report results/",
    "wasp report results/ --spec table1 --strict",
    codes="0 done, 1 part of the results cannot be read (with --strict also: something is "
    "missing; with --verify also: a file was "
    "changed), 2 usage, 3 invalid paper",
)
def report(
    results: options.Folder,
    spec: Annotated[
        str | None, option("NAME", "Only the spec of this name. (default: all that ran)")
    ] = None,
    paper: Annotated[
        Path | None,
        option(
            "FILE|none",
            "File with a paper's numbers and claims. (default: specs/paper.yaml; none: no paper)",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        directory("Write to DIR/<spec>. (default: reports/ in the results folder)", "--out", "-o"),
    ] = None,
    strict: Annotated[
        bool, flag("--strict", "Exit with 1 if cells or counterfactual branches are missing.")
    ] = False,
    verify: Annotated[
        bool,
        flag(
            "--verify",
            "Compare the SHA-256 of every file with its manifest; exit with 1 if one differs.",
        ),
    ] = False,
    films: Annotated[
        bool, flag("--films/--no-films", "Add films: one episode of each task with every method.")
    ] = True,
    trained: Annotated[
        bool, flag("--trained/--no-trained", "Draw each trained part, in the folder trained/.")
    ] = True,
) -> None:
    """Print tables; write them, figures and an HTML report."""
    from wasp_cli.cells.asked import asked_of
    from wasp_cli.report.summarize import missing_words
    from wasp_cli.run.watch import is_gone
    from wasp_cli.spec.paper import load_paper
    from wasp_cli.store.records import read_record

    claimed = None if paper == Path("none") else load_paper(paper)
    layout, last = _reported(results.path, spec)
    damaged = list(last.damaged)
    gaps: list[str] = []
    missing: list[str] = []
    changed: list[str] = []
    unwritten: list[NotWritten] = []
    for name, run in last.runs.items():
        try:
            asked = asked_of(run)
            if verify:
                changed += _changed(asked)
            to = None if out is None else out / slug(name)
            shown = show_report(asked, claimed, films=films, trained=trained, to=to)
            # the run was killed before it wrote its own
            if to is None and is_gone(read_record(layout.reporting(run.run_id)) or {}):
                layout.reporting(run.run_id).unlink(missing_ok=True)
            damaged += (*shown.damaged, *(gap.reason for gap in shown.missing if gap.damaged))
            gaps += [f"{name}: {missing_words(shown.frame)}"] if shown.missing else []
            missing += [f"{name}: {cell.label}: {cell.reason}" for cell in shown.missing]
            gaps += [f"{name}: {sentence}" for sentence in asked.absent]
        except NotWritten as error:
            unwritten.append(error)
        except WaspError as error:  # the other specs are still worth seeing
            damaged.append(error.message)
    if changed:
        told = [
            f"files are not those that were stored ({len(changed)}):",
            *(f"  {text}" for text in (*damaged, *changed)),
        ]
        hint = (
            "remove the folder of each in store/, and run the spec again: what is gone is "
            "computed again"
        )
        raise ArtifactError("\n".join(told), hint)
    if damaged:
        lines = "\n".join(f"  {text}" for text in dict.fromkeys(damaged))
        raise ArtifactError(
            f"part of the results cannot be read:\n{lines}",
            "run the spec again: only damaged results are computed again",
        )
    if unwritten:
        raise NotWritten("\n".join(error.message for error in unwritten), unwritten[0].hint)
    if strict and gaps:
        raise CellsFailed(
            "\n".join([f"{'; '.join(gaps)}:", *first([f"  {cell}" for cell in missing], 10)]),
            "run the spec again",
        )


def _reported(results: Path, spec: str | None) -> tuple[Layout, LastRuns]:
    """The results folder, with the last run of each spec, or of one."""
    from wasp_cli.cells.runs import LastRuns, last_runs, results_of

    layout = results_of(results)
    last = last_runs(layout)
    if not last.runs and not last.damaged:
        hint = "wasp run SPEC --results DIR writes there, and copies published results"
        raise StoreError(f"no results in '{layout.root}': it holds no runs", hint)
    if spec is None:
        return layout, last
    if last.runs and spec not in last.runs:
        raise UnknownName("spec in these results", spec, last.runs)
    runs = {name: run for name, run in last.runs.items() if name == spec}
    return layout, LastRuns(runs, last.damaged)


def _changed(asked: Asked) -> list[str]:
    """Which artifacts of a run have other bytes than their manifests say; the number of those
    that were read is told.
    """
    from wasp_cli.report.provenance import altered

    read, wrong = altered(asked.layout, asked.artifacts)
    say(
        f"SHA-256 of {asked.spec.name}: {read - len(wrong)} of {read} results are as "
        "they were stored"
    )
    return wrong


def show_report(
    asked: Asked,
    paper: Paper | None,
    *,
    films: bool = False,
    trained: bool = False,
    redraw: bool = True,
    to: Path | None = None,
) -> Report:
    """Print the report of one run, then write it. Where the files cannot be written, what is
    printed is there all the same.

    `to` is the folder of the files; None: that of the spec in the results folder.
    """
    from wasp_cli.report.summarize import report_run

    report = report_run(asked, paper)
    try:
        report.terminal(console())  # first: figures take longer than all that is printed
    finally:  # also where the terminal has gone
        page = _written(
            report,
            asked.layout.reports(asked.spec.name) if to is None else to,
            films=films,
            trained=trained,
            redraw=redraw,
        )
    say(
        f"report: {page} (in the same folder: tables as Markdown, CSV and LaTeX, figures "
        "as PNG and SVG)"
    )
    return report


def _written(report: Report, folder: Path, *, films: bool, trained: bool, redraw: bool) -> Path:
    try:
        with err().status("report") as status:
            draw: Draw | None = None
            if films:
                from wasp_cli.video.film import sprite_of as draw  # needs MuJoCo
            _, page, *_ = report.write(
                folder,
                draw,
                lambda text: status.update(f"drawing {text}"),
                evidence=trained,
                redraw=redraw,
            )
    except DrawingError as error:
        raise NotWritten(
            f"the report of {report.name} cannot be written: {error.message}", error.hint
        ) from error
    except (OSError, StoreError) as error:
        refused = error if isinstance(error, WaspError) else refusal(error)
        hint = "wasp report DIR --out FOLDER writes it elsewhere"
        raise NotWritten(
            f"the report of {report.name} cannot be written: {refused.message}", hint
        ) from error
    return page


@command(
    "wasp export results/ --tensorboard runs/",
    "wasp export results/ --spec quickstart --trackio trackio/",
)
def export(
    results: options.Folder,
    spec: Annotated[
        str | None, option("NAME", "Only the spec of this name. (default: all that ran)")
    ] = None,
    tensorboard: Annotated[Path | None, directory("Write event files to DIR/<spec>.")] = None,
    trackio: Annotated[Path | None, directory("Write Trackio projects to DIR, one a spec.")] = None,
) -> None:
    """Write curves and tables for TensorBoard or Trackio.

    Only stored results are read. Look at them with `tensorboard --logdir DIR`, or `TRACKIO_DIR=DIR
    trackio show`.
    """
    from wasp_cli.cells.asked import asked_of
    from wasp_cli.report.summarize import report_run
    from wasp_cli.report.trained.figures import series_of, to_tensorboard, to_trackio

    if tensorboard is None and trackio is None:
        raise UsageError(
            "nothing to write: neither --tensorboard nor --trackio is given",
            "wasp export results/ --tensorboard runs/",
        )
    _, last = _reported(results.path, spec)
    for name, run in last.runs.items():
        report = report_run(asked_of(run))
        for folder, write in ((tensorboard, to_tensorboard), (trackio, to_trackio)):
            if folder is not None:
                series = series_of(report.layout, report.trained, report.frame)
                count = write(name, series, folder)
                say(f"{name}: {count} runs in {folder}")
    if last.damaged:
        lines = [f"  {text}" for text in last.damaged]
        raise ArtifactError("\n".join(["part of the results cannot be read:", *lines]))


@command(
    "wasp compare results/ ../before/results",
    "wasp compare results/ results/ --spec-a table1 --spec-b mine",
    codes="0 compared, 1 with --strict: they differ, 2 a folder or a spec does not exist",
)
def compare(
    first: Annotated[Path, argument("A", "A results folder.", parser=parse_folder)],
    second: Annotated[Path, argument("B", "Another results folder.", parser=parse_folder)],
    spec: Annotated[
        str | None, option("NAME", "Only the spec of this name. (default: all that ran in both)")
    ] = None,
    spec_a: Annotated[str | None, option("NAME", "The spec in A; needs --spec-b.")] = None,
    spec_b: Annotated[str | None, option("NAME", "The spec in B; needs --spec-a.")] = None,
    out: Annotated[
        Path | None,
        directory(
            "Also write the comparison there, as Markdown, CSV, LaTeX and HTML.", "--out", "-o"
        ),
    ] = None,
    strict: Annotated[
        bool,
        flag(
            "--strict", "Exit with 1 if a cell differs by more than noise, or is missing in A or B."
        ),
    ] = False,
    json: options.JsonOption = False,
) -> None:
    """Compare two results folders, cell by cell.

    What changed, and is it more than noise? The last run of each spec counts. Only stored rows are
    read; nothing is computed.
    """
    from wasp_cli.compare import compare as compared_runs
    from wasp_cli.compare import pairs
    from wasp_cli.compare.text import as_json, show, write

    if out is not None and out.exists() and not out.is_dir():
        raise UsageError(
            f"'{out}' is not a folder", "--out names a folder; it is created if it does not exist"
        )
    comparisons: list[Compared] = [
        compared_runs(*pair) for pair in pairs(first, second, spec, spec_a, spec_b)
    ]
    paths = [] if out is None else write(comparisons, out)
    if json:
        print_json([as_json(compared) for compared in comparisons])
    else:
        for compared in comparisons:
            show(compared, console())
        if paths:
            say(f"written: {paths[0]} (its tables are in the same folder)")
    unlike = [compared.first.spec.name for compared in comparisons if not compared.alike]
    if strict and unlike:
        raise NotAccepted(
            f"not alike: {', '.join(unlike)}",
            "the comparison names what is missing, not installed here or beyond noise",
        )


@command(
    "wasp gc --dry-run",
    "wasp gc --keep specs/table1.yaml --older-than 30",
    codes="0 done, 1 the results cannot be read, 2 usage, 3 invalid spec",
)
def gc(
    results: options.Folder,
    keep: Annotated[
        list[Path] | None,
        option("SPEC", "Also keep what this spec needs, as it is now (repeatable)."),
    ] = None,
    older_than: Annotated[
        float | None, option("DAYS", "Only what is older than this.", min=0)
    ] = None,
    runs: Annotated[
        bool,
        flag("--runs", "Also remove run folders and their logs, except the newest of each spec."),
    ] = False,
    dry_run: Annotated[bool, flag("--dry-run", "Only show what would be removed.")] = False,
    yes: Annotated[bool, flag("--yes", "Do not ask. Required without a terminal.", "-y")] = False,
) -> None:
    """Remove results that no spec needs.

    Kept is what the newest whole run of each spec needs, what later runs with --task, --method or
    --limit need, what active runs need, what a person drove, what a note is about, and everything
    that these were computed from.
    """
    from wasp_cli.cells.runs import results_of
    from wasp_cli.report.notes import notes_of
    from wasp_cli.run.reach import kept_keys, remove_unreached, show_rubbish, unreached

    layout = results_of(results.path)
    kept, before = (
        kept_keys(layout, keep or ()),
        None if older_than is None else time.time() - older_than * 86400,
    )
    kept |= {note.key for note in notes_of(layout)}
    rubbish = unreached(layout, kept, runs=runs, before=before)
    show_rubbish(rubbish, console())
    if not rubbish or dry_run:
        return
    if not yes and not (sys.stdin.isatty() and sys.stdout.isatty()):
        console().print(
            "nothing was removed: there is no terminal to ask on, and --yes was not given",
            markup=False,
        )
    elif yes or typer.confirm("Remove all of it?"):
        kept |= {note.key for note in notes_of(layout)}  # somebody may have written one since
        count, freed = remove_unreached(layout, kept, rubbish, runs=runs, before=before)
        console().print(f"{count} removed, {size(freed)} freed", markup=False)


@command(
    "wasp publish specs/quickstart.yaml --reuse published --dry-run",
    "wasp publish specs/table1.yaml --select 'task=goal1' --select 'stage=world_model'",
    codes="0 done, 1 a result is missing, damaged or names this machine, 2 usage, 3 invalid spec",
)
def publish(
    asked: options.SizedSpec,
    to: Annotated[
        Path | None, directory("Destination folder. (default: published/ in the results folder)")
    ] = None,
    select: options.SelectOption = None,
    largest: Annotated[float, option("MB", "Leave out larger artifacts.", min=0)] = 8.0,
    reuse: Annotated[
        str,
        option(
            "none|published|DIR", "none: only what this code computed; otherwise as for wasp run."
        ),
    ] = "none",
    steps: Annotated[
        int | None,
        option("N", "Of each cell only the steps of the first N episodes. (default: all)", min=0),
    ] = None,
    images: Annotated[
        bool, flag("--images/--no-images", "Publish the images of diagnostics too.")
    ] = True,
    archive: Annotated[
        Path | None,
        option(
            "FILE", "Also pack the destination: FILE.tar.gz with checksums, licence and a card."
        ),
    ] = None,
    dry_run: Annotated[bool, flag("--dry-run", "Only show what would be published.")] = False,
) -> None:
    """Copy the results of a spec to a folder for git.

    With its report. Later runs use them instead of training (--reuse published). What is published
    already and unchanged stays as it is.
    """
    from wasp_cli.cells.runs import results_of
    from wasp_cli.run.publish import (
        carry_publication,
        fewer_steps,
        publication,
        require_archive,
        show_publication,
        write_archive,
    )
    from wasp_cli.store.lock import held
    from wasp_cli.store.slim import Slimming

    if archive is not None:
        require_archive(archive)
    spec, layout = asked.load().spec, results_of(asked.results.absolute())
    target = Layout(layout.within(layout.published) if to is None else to.absolute())
    # Meanwhile nothing is removed; nobody does where the folder cannot be written.
    free = dry_run or not os.access(layout.root, os.W_OK)
    with (
        nullcontext()
        if free
        else held(layout.planning, waiting_aloud("waiting for wasp gc"), shared=True)
    ):
        planned = publication(spec, layout, target, select or (), largest * 1e6, reuse)
        show_publication(planned, largest * 1e6)
        if cut := fewer_steps(planned, target, steps):
            say(
                f"{cut} of the cells there have fewer steps and stay as they are: remove "
                f"them from '{target.root}' to publish more"
            )
        if dry_run:
            return
        carry_publication(planned, spec, layout, target, Slimming(steps, images=images))
    if target.root.is_dir():
        say(f"published in {target.root}")
    if archive is not None:
        say(f"packed: {write_archive(target, spec.name, archive)} files in {archive}")


@command(
    "wasp verify results/ --cells 30 --seed 7",
    codes="0 all are the same, 1 some are not, or the folder cannot be read, 2 usage",
)
def verify(
    results: options.Folder,
    cells: Annotated[int, option("N", "Cells that are drawn.", min=1)] = 30,
    seed: Annotated[int, option("N", "Seed of the draw.", min=0)] = 0,
    anywhere: Annotated[
        bool, flag("--anywhere", "Draw also from cells that another kind of processor computed.")
    ] = False,
    jobs: options.JobsOption = None,
) -> None:
    """Compute some cells again and compare to the bit.

    They are drawn, and computed from the models beside them. Nothing in the folder changes. Wall
    times are not compared. What differs with AVX512 is computed once more with AVX2.
    """
    from wasp_cli.run.cores import cores
    from wasp_cli.run.verify import draw, kind, show_answer
    from wasp_cli.run.verify import verify as verified

    layout = Layout(results.path.absolute())
    drawn = draw(layout, cells, seed, anywhere=anywhere)
    others = (
        f"{drawn.others} others cannot be: models are not in the folder, a person drove, or a "
        "module is not wasp's"
    )
    left = (
        f"; {drawn.elsewhere} of another kind of processor are left out (--anywhere)"
        if drawn.elsewhere
        else ""
    )
    say(f"{len(drawn.cells)} of {drawn.of} cells are computed again{left}; {others}")
    answers = []
    for answer in verified(layout, drawn.cells, cores() if jobs is None else max(1, jobs)):
        answers.append(answer)
        show_answer(answer, console())
    same = sum(not answer.differing for answer in answers)
    console().print(f"{same} of {len(drawn.cells)} cells are the same to the bit", markup=False)
    if elsewhere := sum(
        bool(answer.means) and kind(answer.then) != kind(answer.here) for answer in answers
    ):
        remark = (
            "processors round differently, and an episode may then go another way: see how far "
            "the means are apart"
        )
        say(f"{elsewhere} of the others were computed on another processor; {remark}")
    if same < len(drawn.cells):
        raise typer.Exit(1)
