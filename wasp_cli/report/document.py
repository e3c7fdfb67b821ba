"""The report of a run as one value: printed, or written as Markdown, HTML and single files."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from rich.console import Console
from rich.text import Text

from wasp_cli.report.claims import VerdictReport
from wasp_cli.report.claims.text import verdict_html, verdict_markdown, verdict_terminal
from wasp_cli.report.figures import CAPTIONS, ENDINGS, figure_files
from wasp_cli.report.figures.by_axis import severity_figure
from wasp_cli.report.figures.methods import cost_return_figure, latency_figure, necessity_figure, profile_figure
from wasp_cli.report.films import Draw, TaskFilms, film_page, films_of
from wasp_cli.report.notes import Note, lines_of
from wasp_cli.report.provenance import Assumption, assumptions_markdown, cell_sources
from wasp_cli.report.render import RENDERERS, cell_address, make_own, markdown, markdown_text, rendered, terminal, trusted, write_pages
from wasp_cli.report.stats import Frame, Missing
from wasp_cli.report.tables import Table, task_title
from wasp_cli.report.trained import Trained, duration, numbers_text, trained_markdown
from wasp_cli.report.trained.figures import draw_learning, draw_reliability
from wasp_cli.store.layout import Layout
from wasp_cli.store.tables import CellIdentity

NAMED = 12  # missing cells that the terminal names; the report names all
TABLES = (
    "table1", "table2", "figure3", "paper", "training", "world_model", "statistics", "statistics_best", "operators", "severity",
    "severity_check", "autonomy", "details", "latency", "thresholds", "people", "questionnaires", "order", "timing",
)  # fmt: skip
PAGES = ("report.md", "report.html")
KNOWN = frozenset(  # every file that a report can write
    {*PAGES, *(f"{name}.{ending}" for names, endings in ((TABLES, RENDERERS), (CAPTIONS, ENDINGS)) for name in names for ending in endings)}
)
TRAINING = frozenset({"training", "world_model", "learning", "reliability"})
"""Tables and figures that stand on the page of what was trained."""


@dataclass(frozen=True)
class Report:
    """What a run amounts to."""

    name: str
    layout: Layout
    facts: tuple[str, ...]  # one-line statements about the grid
    tables: tuple[Table, ...]  # the first ones are for the terminal
    shown: int  # how many of them
    frame: Frame
    trained: tuple[Trained, ...]
    assumptions: tuple[Assumption, ...]
    damaged: tuple[str, ...] = ()  # records that do not read; `facts` has them too
    published: tuple[str, ...] = ()  # what was published and not computed here; `facts` has it too
    remarks: tuple[str, ...] = ()  # what else a reader of the tables has to know; `facts` has it too
    keys: Mapping[CellIdentity, str] = field(default_factory=dict)  # of the evaluations
    notes: tuple[Note, ...] = ()  # what somebody noted about the cells; `facts` says what is left out for it
    verdict: VerdictReport | None = None  # what becomes of the paper's claims; None where nothing was evaluated

    @property
    def missing(self) -> tuple[Missing, ...]:
        """Cells without readable rows, and branches of other cells that are not there, each with the reason."""
        return (*self.frame.missing, *self.frame.unbranched)

    def terminal(self, console: Console) -> None:
        """Print the front tables, and name what is missing. The main results come last: they are what stays on a small screen."""
        for table in self.tables[self.shown - 1 : 0 : -1]:
            console.print(terminal(table, console.width))
        for fact in (*self.published, *self.remarks):
            console.print(Text(fact), soft_wrap=True)
        for table in self.tables[: min(self.shown, 1)]:
            console.print(terminal(table, console.width))
        for line in lines_of(self.notes)[-NAMED:]:
            console.print(Text(f"note on {line}"), soft_wrap=True)
        if self.verdict is not None:
            console.print(verdict_terminal(self.verdict))
        if self.missing:
            console.print(Text(f"\n{missing_words(self.frame)}:", style="bold red"))
            name_missing(console, self.missing)

    def write(
        self, folder: Path, draw: Draw | None = None, tell: Callable[[str], None] = lambda text: None, *, evidence: bool = False
    ) -> list[Path]:
        """Write every table in every format, the figures, `report.md` and `report.html`; returns the files, the pages first.

        `draw` draws the film of an episode (None: no films), and `tell` is told of it; with `evidence` trained parts are drawn too.
        """
        make_own(folder)
        figures = draw_figures(self.layout, self.frame, self.trained, folder)
        films = () if draw is None else tuple(films_of(self.layout, self.frame, dict(self.keys), draw, tell))
        texts = {"report.md": self.markdown([path.name for path in figures]), "report.html": self.html(figures, films)}
        pages = write_pages(folder, texts, self.tables)
        # What an earlier report had and this one has not would pass for a part of it.
        for name in KNOWN - {path.name for path in (*pages, *figures)}:
            (folder / name).unlink(missing_ok=True)
        if not evidence:
            return [*pages, *figures]
        from wasp_cli.report.trained.evidence import write_evidence  # needs Pillow

        return [*pages, *figures, *write_evidence(self.layout, self.trained, folder, lambda part: tell(f"pictures of {part}"))]

    def markdown(self, figures: Sequence[str] = ()) -> str:
        """Render the whole report as one Markdown page."""
        parts = [f"# Report: {self.name}\n", "".join(f"- {markdown_text(fact)}\n" for fact in self.facts)]
        if self.missing:
            lines = "".join(f"- {markdown_text(f'{cell.label}: {cell.reason}')}\n" for cell in self.missing)
            parts.append(
                f"## Missing cells\n\n{missing_words(self.frame)}. Their rows are marked, and nothing stands in for them.\n\n{lines}"
            )
        if self.verdict is not None:
            parts.append(verdict_markdown(self.verdict))
        parts += [markdown(table) for table in self.tables[: self.shown]]
        parts += [f"![{CAPTIONS[Path(name).stem]}]({name})\n" for name in figures if name.endswith(".png")]
        parts += [markdown(table) for table in self.tables[self.shown :]]
        if self.notes:
            lines = "".join(f"- {markdown_text(line)}\n" for line in lines_of(self.notes))
            parts.append(f"## Notes\n\n{lines}")
        if self.trained:
            parts.append(trained_markdown(self.trained))
        parts.append(assumptions_markdown(self.assumptions))
        return "\n".join(parts)

    def html(self, figures: Sequence[Path] = (), films: Sequence[TaskFilms] = ()) -> str:
        """Render the whole report as one HTML page (`page/templates/page.html`) that needs no other file and no network."""
        svgs = {path.stem: path for path in figures if path.suffix == ".svg"}
        shown = [{"name": stem, "data": svgs[stem].read_bytes(), "caption": caption} for stem, caption in CAPTIONS.items() if stem in svgs]
        page = rendered(
            "page.html",
            report=self,
            verdict=None if self.verdict is None else verdict_html(self.verdict),
            gaps=missing_words(self.frame) if self.missing else None,
            tables=[table for table in self.tables[: self.shown] if table.name not in TRAINING],
            further=self.tables[self.shown :],
            figures=[figure for figure in shown if figure["name"] not in TRAINING],
            films=[{"task": each.task, "title": task_title(each.task), "content": film_page(each)} for each in films],
            training_tables=[table for table in self.tables[: self.shown] if table.name in TRAINING],
            training_figures=[figure for figure in shown if figure["name"] in TRAINING],
            cells=cell_sources(self.layout, self.frame.cells, self.keys),
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
    """Say how much is missing: `2 of 32 cells and 1 of 24 sets of counterfactual branches are missing`."""
    parts = []
    if frame.missing:
        parts.append(f"{len(frame.missing)} of {len(frame.cells) + len(frame.missing)} cells")
    if frame.unbranched:
        parts.append(f"{len(frame.unbranched)} of {len(frame.judged) + len(frame.unbranched)} sets of counterfactual branches")
    return f"{' and '.join(parts)} {'is' if len(frame.missing) + len(frame.unbranched) == 1 else 'are'} missing"


def name_missing(console: Console, missing: Sequence[Missing]) -> None:
    """Print the first missing cells, each with its reason, and how many more there are."""
    for cell in missing[:NAMED]:
        console.print(Text(f"  {cell.label}: {cell.reason}"), soft_wrap=True)
    if len(missing) > NAMED:
        console.print(Text(f"  and {len(missing) - NAMED} more; report.md names all"))


def draw_figures(layout: Layout, frame: Frame, trained: Sequence[Trained], folder: Path) -> list[Path]:
    """Write every figure that has something to show, as PNG and SVG; returns the files."""
    of_cells = (cost_return_figure, necessity_figure, severity_figure, profile_figure, latency_figure)
    files = [path for draw in of_cells for path in draw(frame, folder)]
    for name, figure in (("learning", draw_learning(layout, trained)), ("reliability", draw_reliability(layout, trained))):
        files += [] if figure is None else figure_files(figure, folder, name)
    return files
