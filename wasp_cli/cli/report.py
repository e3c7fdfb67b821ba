"""`wasp report`: prints the tables of a results folder, and writes its reports."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from wasp_cli.cli import options
from wasp_cli.cli.command import command
from wasp_cli.cli.parameters import directory, flag, option
from wasp_cli.cli.runs import reported_runs
from wasp_cli.console import err, say
from wasp_cli.console import out as console
from wasp_cli.errors import (
    ArtifactError,
    CellsFailed,
    DrawingError,
    StoreError,
    WaspError,
    first,
    refusal,
)
from wasp_cli.store.layout import slug

if TYPE_CHECKING:
    from wasp_cli.cells.asked import Asked
    from wasp_cli.report.summarize import Report
    from wasp_cli.spec.paper import Paper


class NotWritten(WaspError):
    """The files of a report cannot be written; its tables were printed."""


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
    trained: Annotated[
        bool, flag("--trained/--no-trained", "Draw each trained part, in the folder trained/.")
    ] = True,
) -> None:
    """Print tables; write them, figures and an HTML report."""
    from wasp_cli.cells.asked import asked_of
    from wasp_cli.report.summarize import missing_words
    from wasp_cli.run.process import is_gone
    from wasp_cli.spec.paper import load_paper
    from wasp_cli.store.records import read_record

    claimed = None if paper == Path("none") else load_paper(paper)
    layout, last = reported_runs(results.path, spec)
    problems = _Problems(damaged=list(last.damaged))
    for name, run in last.runs.items():
        try:
            asked = asked_of(run)
            if verify:
                problems.changed += _changed(asked)
            to = None if out is None else out / slug(name)
            shown = show_report(asked, claimed, trained=trained, to=to)
        except NotWritten as error:
            problems.unwritten.append(error)
            continue
        except WaspError as error:  # the other specs are still worth seeing
            problems.damaged.append(error.message)
            continue
        # A run that was killed before it wrote its report has this one now.
        if to is None and is_gone(read_record(layout.reporting(run.run_id)) or {}):
            layout.reporting(run.run_id).unlink(missing_ok=True)
        problems.damaged += shown.damaged
        problems.damaged += [gap.reason for gap in shown.missing if gap.damaged]
        if shown.missing:
            problems.gaps.append(f"{name}: {missing_words(shown.frame)}")
        problems.missing += [f"{name}: {cell.label}: {cell.reason}" for cell in shown.missing]
        problems.gaps += [f"{name}: {sentence}" for sentence in asked.absent]
    problems.require_none(strict=strict)


@dataclass
class _Problems:
    """What went wrong in the reports of several specs; it is reported after the last one."""

    damaged: list[str]
    """What cannot be read."""
    changed: list[str] = field(default_factory=list)
    """Artifacts with other bytes than their manifests say."""
    unwritten: list[NotWritten] = field(default_factory=list)
    gaps: list[str] = field(default_factory=list)
    """What is incomplete, a sentence each."""
    missing: list[str] = field(default_factory=list)
    """Cells that are not there, each with its reason."""

    def require_none(self, *, strict: bool) -> None:
        """Raise WaspError for the most serious kind of problem. Gaps count only if `strict`."""
        if self.changed:
            lines = [f"  {text}" for text in (*self.damaged, *self.changed)]
            message = f"files are not those that were stored ({len(self.changed)}):"
            raise ArtifactError(
                "\n".join([message, *lines]),
                "remove the folder of each in store/, and run the spec again: what is gone is "
                "computed again",
            )
        if self.damaged:
            lines = [f"  {text}" for text in dict.fromkeys(self.damaged)]
            raise ArtifactError(
                "\n".join(["part of the results cannot be read:", *lines]),
                "run the spec again: only damaged results are computed again",
            )
        if self.unwritten:
            messages = [error.message for error in self.unwritten]
            raise NotWritten("\n".join(messages), self.unwritten[0].hint)
        if strict and self.gaps:
            lines = first([f"  {cell}" for cell in self.missing], 10)
            raise CellsFailed("\n".join([f"{'; '.join(self.gaps)}:", *lines]), "run the spec again")


def _changed(asked: Asked) -> list[str]:
    """The artifacts of a run whose bytes differ from their manifests. Prints how many were read."""
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
    trained: bool = False,
    redraw: bool = True,
    to: Path | None = None,
) -> Report:
    """Print the report of one run, then write it, and return it.

    Args:
        paper: whose claims are judged; None: none.
        trained: whether pictures of trained parts are drawn.
        redraw: whether figures are drawn again although nothing has changed.
        to: folder of the files; None: that of the spec in the results folder.

    Raises:
        NotWritten: the files cannot be written; the tables were printed.
    """
    from wasp_cli.report.intervals import intervals_kept
    from wasp_cli.report.summarize import report_run

    layout = asked.layout
    name = asked.spec.name
    report = report_run(asked, paper)
    with intervals_kept(layout, name):
        try:
            report.terminal(console())  # first: figures take longer than all that is printed
        finally:  # also where the terminal has gone
            page = _written(
                report,
                layout.reports(name) if to is None else to,
                trained=trained,
                redraw=redraw,
            )
    say(
        f"report: {page} (in the same folder: tables as Markdown, CSV and LaTeX, figures "
        "as PNG and SVG)"
    )
    return report


def _written(report: Report, folder: Path, *, trained: bool, redraw: bool) -> Path:
    try:
        with err().status("report") as status:
            _, page, *_ = report.write(
                folder,
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
