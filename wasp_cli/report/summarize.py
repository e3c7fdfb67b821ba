"""The report of a run as one value: made from a results folder, printed, or written as
Markdown, HTML and single files.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

from rich.console import Console
from rich.text import Text

from wasp_cli.cells.asked import Asked
from wasp_cli.cells.read import Missing
from wasp_cli.cells.runs import last_plan
from wasp_cli.errors import ArtifactError
from wasp_cli.operators.registry import PERSON
from wasp_cli.plan.grid import COUNTERFACTUAL
from wasp_cli.plan.node import Part
from wasp_cli.report import provenance
from wasp_cli.report.canvas import ENDINGS, figure_files
from wasp_cli.report.claims import VerdictReport, judge
from wasp_cli.report.claims_text import (
    numbers_table,
    verdict_html,
    verdict_markdown,
    verdict_terminal,
)
from wasp_cli.report.figures import (
    CAPTIONS,
    cost_return_figure,
    necessity_figure,
    profile_figure,
    severity_figure,
)
from wasp_cli.report.gains import Foresight, foresight_of
from wasp_cli.report.gains_figure import gains_figure
from wasp_cli.report.interventions_figure import cost_interventions_figure
from wasp_cli.report.notes import Note, invalid, lines_of, notes_of, without_invalid
from wasp_cli.report.operating import (
    Operating,
    operating_figure,
    operating_table,
    read_operating,
    silences,
)
from wasp_cli.report.render import (
    RENDERERS,
    cell_address,
    make_own,
    markdown,
    markdown_text,
    rendered,
    terminal,
    trusted,
    write_pages,
)
from wasp_cli.report.shortfalls import chosen_sentences, gate_sentences, stage_sentences
from wasp_cli.report.stats import Frame, read_frame, with_branches
from wasp_cli.report.tables import Table, task_title
from wasp_cli.report.tables.comparison import comparison_table, necessity_table
from wasp_cli.report.tables.gains import gains_table
from wasp_cli.report.tables.main import FURTHER, ablation_table, in_words, main_table
from wasp_cli.report.tables.people import late_facts, people_fact, people_tables, read_people
from wasp_cli.report.trained.artifacts import (
    Trained,
    duration,
    numbers_text,
    trained_artifacts,
    trained_markdown,
)
from wasp_cli.report.trained.datasets import with_warnings
from wasp_cli.report.trained.figures import draw_learning, draw_reliability
from wasp_cli.report.trained.tables import training_tables
from wasp_cli.spec.model import Spec
from wasp_cli.spec.paper import Paper
from wasp_cli.store.find import KIND
from wasp_cli.store.layout import Layout
from wasp_cli.store.records import read_record

NAMED = 12  # missing cells that the terminal names; the report names all
TABLES = (
    "table1",
    "table2",
    "figure3",
    "paper",
    "training",
    "world_model",
    "statistics",
    "gains",
    "operators",
    "severity",
    "autonomy",
    "details",
    "latency",
    "thresholds",
    "operating_points",
    "people",
    "questionnaires",
    "order",
    "timing",
)
PAGES = ("report.md", "report.html")
KNOWN = frozenset(  # every file that a report can write
    {
        *PAGES,
        *(
            f"{name}.{ending}"
            for names, endings in ((TABLES, RENDERERS), (CAPTIONS, ENDINGS))
            for name in names
            for ending in endings
        ),
    }
)
TRAINING = frozenset({"training", "world_model", "learning", "reliability"})
"""Tables and figures that stand on the page of what was trained."""


@dataclass(frozen=True)
class Report:
    """The report of a run. Verdicts and tables that need intervals are computed when they are first
    read.
    """

    name: str
    layout: Layout
    facts: tuple[str, ...]  # one-line statements about the grid
    shown: tuple[Table, ...]  # on the terminal too
    frame: Frame
    trained: tuple[Trained, ...]
    assumptions: tuple[provenance.Assumption, ...]
    # The next three are sentences that `facts` has too.
    damaged: tuple[str, ...] = ()  # records that cannot be read
    published: tuple[str, ...] = ()  # what was published and not computed here
    remarks: tuple[str, ...] = ()  # what else a reader of the tables has to know
    # notes on the cells; `facts` says which cells are left out because of them
    notes: tuple[Note, ...] = ()
    # which settings of assistants were chosen on held-out worlds
    operating: tuple[Operating, ...] = ()
    # judges the paper's claims; None if the paper is not about this run
    judging: Callable[[], VerdictReport] | None = None

    @cached_property
    def verdict(self) -> VerdictReport | None:
        """The paper's claims as judged by these rows; None if the paper is not about this run."""
        if self.judging is None:
            return None
        return self.judging()

    @cached_property
    def foresight(self) -> Foresight:
        """What the predictions of costs and of gains were worth."""
        return foresight_of(self.layout, self.frame)

    @cached_property
    def further(self) -> tuple[Table, ...]:
        """The tables behind the front page: the paper's numbers, comparison, gains, operating
        points and those of `tables.main.FURTHER`; without empty ones.
        """
        tables = [
            comparison_table(self.frame),
            gains_table(self.frame, self.foresight),
            operating_table(self.operating),
            *(table_of(self.frame) for table_of in FURTHER),
        ]
        if self.verdict is not None:
            tables.insert(0, numbers_table(self.verdict))
        return tuple(
            table for table in tables if table is not None and table.rows and table.columns
        )

    @property
    def tables(self) -> tuple[Table, ...]:
        """All tables, those of the front page first."""
        return (*self.shown, *self.further)

    @property
    def missing(self) -> tuple[Missing, ...]:
        """The cells that are missing, then those whose interventions should have been branched."""
        return (*self.frame.missing, *self.frame.unbranched)

    def terminal(self, console: Console) -> None:
        """Print the front tables, and name what is missing. The main table comes last, so that it
        is still visible on a small screen.
        """
        for table in self.shown[:0:-1]:
            console.print(terminal(table, console.width))
        for fact in (*self.published, *self.remarks):
            console.print(Text(fact), soft_wrap=True)
        for table in self.shown[:1]:
            console.print(terminal(table, console.width))
        for line in in_words(self.frame):
            console.print(Text(line), soft_wrap=True)
        for line in lines_of(self.notes)[-NAMED:]:
            console.print(Text(f"note on {line}"), soft_wrap=True)
        if self.verdict is not None:
            console.print(verdict_terminal(self.verdict))
        if self.missing:
            console.print(Text(f"\n{missing_words(self.frame)}:", style="bold red"))
            name_missing(console, self.missing)

    def write(
        self,
        folder: Path,
        tell: Callable[[str], None] = lambda text: None,
        *,
        evidence: bool = False,
        redraw: bool = True,
    ) -> list[Path]:
        """Write every table in every format, the figures, `report.md` and `report.html`. Files of
        an earlier report that this one does not have are removed.

        Args:
            folder: where to; it is made if it is not there.
            tell: gets the name of each trained part whose pictures are drawn.
            evidence: whether pictures of trained parts are drawn too.
            redraw: whether figures are drawn again even if an earlier report with the same text has
                them; drawing takes most of the time.

        Returns:
            The files, the pages first.
        """
        make_own(folder, (*KNOWN, "trained"))
        # Without a page of ours, files that are there already may be somebody's own.
        page = folder / PAGES[0]
        ours = page.is_file() and page.read_bytes().startswith(b"# Report: ")

        # The figures, then the pages that show them.
        figures = [] if redraw else self._kept(folder)
        figures = figures or self._drawn(folder)
        texts = {
            "report.md": self.markdown([path.name for path in figures]),
            "report.html": self.html(figures),
        }
        pages = write_pages(folder, texts, self.tables)
        # Files that only an earlier report had would be taken for a part of this one.
        if ours:
            for name in KNOWN - {path.name for path in (*pages, *figures)}:
                (folder / name).unlink(missing_ok=True)
        if not evidence:
            return [*pages, *figures]
        from wasp_cli.report.trained.evidence import write_evidence  # needs Pillow

        def tell_part(part: str) -> None:
            tell(f"pictures of {part}")

        pictures = write_evidence(self.layout, self.trained, folder, tell_part, anew=ours)
        return [*pages, *figures, *pictures]

    def _drawn(self, folder: Path) -> list[Path]:
        return [
            *draw_figures(self.layout, self.frame, self.trained, folder, self.foresight),
            *operating_figure(self.operating, folder),
        ]

    def _kept(self, folder: Path) -> list[Path]:
        """The figures of an earlier report with the same text; none if its text differs."""
        paths = [folder / f"{stem}.{ending}" for stem in CAPTIONS for ending in ENDINGS]
        figures = [path for path in paths if path.is_file()]
        page = folder / "report.md"
        if not page.is_file():
            return []
        text = self.markdown([path.name for path in figures])
        if page.read_bytes() != text.encode():
            return []
        return figures

    def markdown(self, figures: Sequence[str] = ()) -> str:
        """Return the page as Markdown; `figures` are the names of the image files that it shows."""
        parts = [
            f"# Report: {self.name}\n",
            "".join(f"- {markdown_text(fact)}\n" for fact in self.facts),
        ]
        if self.missing:
            lines = "".join(
                f"- {markdown_text(f'{cell.label}: {cell.reason}')}\n" for cell in self.missing
            )
            parts.append(
                f"## Missing cells\n\n{missing_words(self.frame)}. Their rows are marked, "
                f"and nothing stands in for them.\n\n{lines}"
            )
        if self.verdict is not None:
            parts.append(verdict_markdown(self.verdict))
        parts += [markdown(table) for table in self.shown]
        parts += [
            f"![{CAPTIONS[Path(name).stem]}]({name})\n" for name in figures if name.endswith(".png")
        ]
        parts += [markdown(table) for table in self.further]
        if self.notes:
            parts.append(
                "## Notes\n\n"
                + "".join(f"- {markdown_text(line)}\n" for line in lines_of(self.notes))
            )
        if self.trained:
            parts.append(trained_markdown(self.trained))
        parts.append(provenance.assumptions_markdown(self.assumptions))
        return "\n".join(parts)

    def html(self, figures: Sequence[Path] = ()) -> str:
        """Return the page as HTML, with the SVG files among `figures` embedded."""
        svgs = {path.stem: path for path in figures if path.suffix == ".svg"}
        shown = [
            {"name": stem, "data": svgs[stem].read_bytes(), "caption": caption}
            for stem, caption in CAPTIONS.items()
            if stem in svgs
        ]
        page = rendered(
            "page.html",
            report=self,
            verdict=None if self.verdict is None else verdict_html(self.verdict),
            gaps=missing_words(self.frame) if self.missing else None,
            tables=[table for table in self.shown if table.name not in TRAINING],
            further=self.further,
            figures=[figure for figure in shown if figure["name"] not in TRAINING],
            training_tables=[table for table in self.shown if table.name in TRAINING],
            training_figures=[figure for figure in shown if figure["name"] in TRAINING],
            cells=provenance.cell_sources(self.layout, self.frame.cells),
            notes=lines_of(self.notes),
            style=trusted("style.css"),
            script=trusted("sort.js") + trusted("script.js"),
            task_title=task_title,
            cell_address=cell_address,
            duration=duration,
            numbers_text=numbers_text,
            as_json=lambda value: json.dumps(value, default=str, ensure_ascii=False),
        )
        return str(page)


def missing_words(frame: Frame) -> str:
    """Return how much is missing, such as `2 of 30 cells are missing`."""
    parts = []
    if frame.missing:
        parts.append(f"{len(frame.missing)} of {len(frame.cells) + len(frame.missing)} cells")
    if frame.unbranched:
        parts.append(
            f"{len(frame.unbranched)} of {len(frame.judged) + len(frame.unbranched)} sets "
            "of counterfactual branches"
        )
    verb = "is" if len(frame.missing) + len(frame.unbranched) == 1 else "are"
    return f"{' and '.join(parts)} {verb} missing"


def name_missing(console: Console, missing: Sequence[Missing]) -> None:
    """Print the first NAMED missing cells with the reason of each, and how many more there are."""
    for cell in missing[:NAMED]:
        console.print(Text(f"  {cell.label}: {cell.reason}"), soft_wrap=True)
    if len(missing) > NAMED:
        console.print(Text(f"  and {len(missing) - NAMED} more; report.md names all"))


def draw_figures(
    layout: Layout,
    frame: Frame,
    trained: Sequence[Trained],
    folder: Path,
    foresight: Foresight | None = None,
) -> list[Path]:
    """Write all figures except those of operating points, as PNG and SVG. Returns the files;
    figures without data write none. Without `foresight` the one of gains is left out.
    """
    of_cells = (
        cost_return_figure,
        cost_interventions_figure,
        necessity_figure,
        severity_figure,
        profile_figure,
    )
    files = [path for draw in of_cells for path in draw(frame, folder)]
    if foresight is not None:
        files += gains_figure(frame, foresight, folder)
    for name, figure in (
        ("learning", draw_learning(layout, trained)),
        ("reliability", draw_reliability(layout, trained)),
    ):
        files += [] if figure is None else figure_files(figure, folder, name)
    return files


def report_run(asked: Asked, paper: Paper | None = None) -> Report:
    """Report what a run was asked for: its cells and its trained parts.

    Args:
        asked: the cells, parts and spec of the run.
        paper: whose numbers and claims the report compares with; None: with none.

    Raises:
        StoreError: the file of notes cannot be read.
    """
    layout = asked.layout
    spec = asked.spec
    parts = asked.parts

    # The rows of the cells, without what somebody marked as invalid.
    reasons = absence_of(asked)
    damaged = list(reasons.damaged)
    read = with_branches(layout, read_frame(layout, asked.cells, reasons.by_key), reasons.by_key)
    stored = replace(read, absent=asked.absent)
    keys = {cell.key for cell in asked.cells}
    notes = [note for note in notes_of(layout) if note.key in keys]
    frame, left_out = without_invalid(stored, invalid(notes))

    # What was trained for them, and where all of it comes from.
    failures: dict[str, str] = {}
    for _, key in parts:
        text = _failure(layout, key, damaged)
        if text is not None:
            failures[key] = f"failed: {text}"
    origins = provenance.Origins()
    trained, unreadable = trained_artifacts(layout, asked.artifacts, origins)
    trained = with_warnings(layout, trained)
    published = list(origins.facts())
    # Where published results stand in place of what reads them, unused parts are expected to be
    # absent; in any other run an absent part was removed.
    gone: list[Part] = []
    if published and not stored.missing:
        gone = provenance.absent_parts(layout, parts, spec.stages)
    if gone:
        kinds = ", ".join(dict.fromkeys(part.kind for part in gone))
        published.append(
            f"{len(gone)} trained parts were not computed, since published results were used in "
            f"place of what reads them: {kinds}."
        )
        # A stage that is there for other seeds keeps its missing seed in the tables.
        present = {(part.task, part.kind) for part, _ in parts if part not in gone}
        parts = tuple((part, key) for part, key in parts if (part.task, part.kind) in present)

    # What restricts the numbers: late answers, silent assistants, stages that fell short.
    sittings, unread = read_people(layout, frame)
    damaged = list(dict.fromkeys([*damaged, *unread, *unreadable]))
    operating = _operating(asked)
    silent = silences(operating)
    short = [
        *stage_sentences(layout, trained),
        *gate_sentences(frame, operating),
        *chosen_sentences(trained),
    ]
    remarks = (*left_out, *origins.remarks(), *asked.absent)

    # The tables of the first page.
    front: list[Table] = []
    if asked.cells:
        main = main_table(frame)
        notes_of_main = (*main.notes, *late_facts(sittings), *silent, *short)
        front.append(replace(main, notes=notes_of_main))
    else:
        remarks = (*remarks, *short)
    front += people_tables(sittings)
    for table in (ablation_table(frame), necessity_table(frame)):
        if table is not None:
            front.append(table)
    front += training_tables(parts, trained, failures)

    facts: list[str] = []
    if sittings:
        facts.append(people_fact(sittings))
    facts += [*_facts(spec, frame), *silent, *published, *remarks, *asked.unknown, *damaged]
    return Report(
        name=spec.name,
        layout=layout,
        facts=tuple(facts),
        shown=tuple(front),
        frame=frame,
        trained=trained,
        assumptions=tuple(provenance.assumptions_in_force(spec)),
        damaged=tuple(damaged),
        published=tuple(published),
        remarks=remarks,
        judging=_judging(frame, paper, spec),
        notes=tuple(notes),
        operating=tuple(operating),
    )


def _judging(frame: Frame, paper: Paper | None, spec: Spec) -> Callable[[], VerdictReport] | None:
    """A function that judges the claims of a paper; None if the paper has none of the tasks of a
    spec, or if people drove in all cells.
    """
    if paper is None or not paper.tasks & {*spec.tasks}:
        return None
    if all(cell.operator == PERSON for cell in frame.cells):
        return None
    return partial(judge, frame, paper, spec)


def _operating(asked: Asked) -> list[Operating]:
    """The operating points of the cells for which the spec asks to choose one."""
    spec = asked.spec
    chosen = [cell.key for cell in asked.cells if spec.chooses_point(cell.task, cell.method)]
    return read_operating(asked.layout, chosen)


@dataclass(frozen=True)
class Absence:
    """Why cells and branches of a run are not there, as far as that is known."""

    by_key: Mapping[str, str]
    damaged: tuple[str, ...]  # the records that cannot be read, each as a sentence


def absence_of(asked: Asked) -> Absence:
    """Return why cells and branches of a run may be missing: they failed, or something that they
    need failed.
    """
    layout = asked.layout
    damaged: list[str] = []
    # The folder is listed once: looking for a record for each cell would take longer than reading
    # the grid.
    failed = {path.stem for path in layout.failures.glob("*.json")}
    by_key = {
        key: f"blocked by {cause}"
        for key, cause in _blocked(layout, asked.spec, failed, damaged).items()
    }
    for kind, key in asked.artifacts:
        if kind in (KIND, COUNTERFACTUAL) and key in failed:
            text = _failure(layout, key, damaged)
            if text is not None:
                by_key[key] = f"failed: {text}"
    return Absence(by_key, tuple(damaged))


def _failure(layout: Layout, key: str, damaged: list[str]) -> str | None:
    try:
        record = read_record(layout.failure(key))
    except ArtifactError as error:
        damaged.append(error.message)
        return error.message
    return None if record is None else f"{record.get('message')} (log: {record.get('log')})"


def _blocked(layout: Layout, spec: Spec, failed: set[str], damaged: list[str]) -> dict[str, str]:
    """By the key of an evaluation: the failed node that it needs, in the last plan of the spec.

    The spec is not laid out again, since that imports the environments that it names, and these
    results may be untrusted.
    """
    nodes = last_plan(layout, spec.name) if failed else {}
    causes: dict[str, str] = {}
    for node in nodes.values():
        upstream = [
            needed
            for needed in node.needs
            if needed in nodes and (needed in failed or needed in causes)
        ]
        if upstream:
            first = nodes[upstream[0]]
            causes[node.key] = (
                causes.get(first.key)
                or f"{first.label}, which failed: {_failure(layout, first.key, damaged)}"
            )
    return causes


def _facts(spec: Spec, frame: Frame) -> Iterator[str]:
    total = len(frame.cells) + len(frame.missing)
    episodes = frame.cells.counts.sum()
    if total:
        yield f"{len(frame.cells)} of {total} cells, {episodes} episodes."
    else:
        yield "Training only: the spec lists no methods."
    repeats = {task: spec.repeat_of(task) for task in spec.tasks}
    if len(set(repeats.values())) == 1:
        steps = str(next(iter(repeats.values())))
    else:
        steps = ", ".join(f"{repeat} ({task_title(task)})" for task, repeat in repeats.items())
    yield f"Preset `{spec.preset}`, {steps} env steps per decision step."
    if spec.training_seed is not None:
        yield (
            f"All evaluation seeds share the models of training seed {spec.training_seed}: ± "
            "does not include the spread of training."
        )
    elif len(spec.seeds) > 1 and total:
        yield "Every seed has its own models, so ± includes the spread of training."
