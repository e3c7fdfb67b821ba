"""The report as one page (`templates/page.html`): main results, claims, further tables and figures; a page for each task, for what was
trained, and for the cells."""

from __future__ import annotations

import json
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

from wasp_cli.report.figures.style import CAPTIONS
from wasp_cli.report.page.films import TaskFilms, film_page
from wasp_cli.report.provenance import Assumption, CellSource
from wasp_cli.report.render.files import rendered
from wasp_cli.report.stats.frame import Missing
from wasp_cli.report.tables.table import Table
from wasp_cli.report.tables.titles import task_title
from wasp_cli.report.trained.artifacts import Trained, duration, numbers_text

if TYPE_CHECKING:
    from markupsafe import Markup

TRAINING_TABLES = frozenset({"training", "world_model"})
TRAINING_FIGURES = frozenset({"learning", "reliability"})
"""These stand on the page of what was trained."""


def build_page(
    *,
    name: str,
    facts: Sequence[str],
    verdict: Markup | None,
    tables: Sequence[Table],
    further: Sequence[Table],
    figures: Sequence[Path],
    gaps: str | None,
    missing: Sequence[Missing],
    trained: Sequence[Trained],
    assumptions: Sequence[Assumption],
    films: Sequence[TaskFilms],
    cells: Sequence[CellSource] = (),
    notes: Sequence[str] = (),
) -> str:
    """Return one HTML document that needs no other file and no network.

    Args:
        name: of the spec.
        facts: one-line statements about the grid.
        verdict: which claims of the paper hold.
        tables: the main ones, which stand before the figures.
        further: the others, which stand behind them.
        figures: written files; the SVG ones are shown.
        gaps: how much is missing, in words.
        missing: what is.
        trained: what was trained.
        assumptions: values in force that are not the paper's.
        films: of the tasks that have any.
        cells: where each comes from, and how to look into it.
        notes: what somebody noted about cells, a line each.
    """
    svgs = {path.stem: path for path in figures if path.suffix == ".svg"}
    shown = [{"name": stem, "data": svgs[stem].read_bytes(), "caption": caption} for stem, caption in CAPTIONS.items() if stem in svgs]
    training_tables = [table for table in tables if table.name in TRAINING_TABLES]
    training_figures = [figure for figure in shown if figure["name"] in TRAINING_FIGURES]
    page = rendered(
        "page.html", name=name, facts=facts, verdict=verdict, gaps=gaps, missing=missing, further=further, trained=trained,
        tables=[table for table in tables if table not in training_tables],
        figures=[figure for figure in shown if figure not in training_figures],
        films=[{"task": each.task, "title": task_title(each.task), "content": film_page(each)} for each in films],
        training_tables=training_tables, training_figures=training_figures, learned=bool(training_tables or training_figures or trained),
        notes=notes, assumptions=assumptions, cells=cells, style=_part("style.css"), task_title=task_title,
        script=_part("sort.js") + _part("script.js"), duration=duration, numbers_text=numbers_text,
        as_json=lambda value: json.dumps(value, default=str, ensure_ascii=False),
    )  # fmt: skip
    return str(page)


def _part(name: str) -> Markup:
    """A file of the package that is trusted as it is."""
    from markupsafe import Markup

    return Markup((files("wasp_cli.report.page") / name).read_text(encoding="utf-8"))
