"""The whole page: verdict first, then tables and figures, a page for each task, what was trained, what was assumed."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from importlib.resources import files
from pathlib import Path

from wasp_cli.report.figures.style import CAPTIONS
from wasp_cli.report.page.film_page import film_page
from wasp_cli.report.page.films import TaskFilms
from wasp_cli.report.page.markup import Markup, data_uri, element, joined, list_of, rows_table
from wasp_cli.report.provenance import Assumption
from wasp_cli.report.render.html import html
from wasp_cli.report.stats.frame import Missing
from wasp_cli.report.tables.table import Table
from wasp_cli.report.tables.titles import task_title
from wasp_cli.report.trained_table import Trained, duration, numbers_text

FOR_TRAINING = frozenset({"training", "world_model"})
"""Tables that stand on the page of what was trained."""
SHOWN = 2
"""Facts in the header."""
TRAINING_FIGURES = ("learning", "reliability")


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
) -> str:
    """One HTML document.

    Args:
        name: of the spec.
        facts: one-line statements about the grid.
        verdict: what became of the paper's claims.
        tables: the main ones, which stand before the figures.
        further: the others, which stand behind them.
        figures: written files; the SVG ones are shown.
        gaps: how much is missing, in words.
        missing: what is.
        trained: what was trained.
        assumptions: values in force that are not the paper's.
        films: of the tasks that have any.
    """
    svgs = {path.stem: path for path in figures if path.suffix == ".svg"}
    overview = [
        _missing(gaps, missing),
        *([verdict] if verdict is not None else []),
        *(_table(table) for table in tables if table.name not in FOR_TRAINING),
        *(_figure(svgs[figure]) for figure in CAPTIONS if figure in svgs and figure not in TRAINING_FIGURES),
        *(_table(table) for table in further),
    ]
    pages = [("results", "Results", joined(overview))]
    pages += [(f"task-{films.task}", task_title(films.task), film_page(films)) for films in films]
    learned = [
        *(_table(table) for table in tables if table.name in FOR_TRAINING),
        *(_figure(svgs[figure]) for figure in TRAINING_FIGURES if figure in svgs),
        *([_trained(trained)] if trained else []),
    ]
    if learned:
        pages.append(("trained", "Trained parts", joined(learned)))
    pages.append(("assumptions", "Assumptions", _assumptions(assumptions)))
    return _document(name, facts, pages)


def _document(name: str, facts: Sequence[str], pages: Sequence[tuple[str, str, Markup]]) -> str:
    links = [element("a", title, href=f"#{anchor}") for anchor, title, _ in pages]
    sections = [element("section", element("h2", title), content, id=anchor, class_="page") for anchor, title, content in pages]
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        # Says to the browser that nothing is to be fetched: what is shown is in this file.
        element(
            "meta",
            http_equiv="Content-Security-Policy",
            content="default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'",
        ),
        element("title", f"wasp: {name}"),
        element("style", Markup(_part("style.css"))),
    )
    header = _header(name, facts)
    body = element(
        "body", header, element("nav", *links, class_="pages"), element("main", *sections), element("script", Markup(_part("script.js")))
    )
    return f"<!doctype html>\n{element('html', head, body, lang='en')}\n"


def _header(name: str, facts: Sequence[str]) -> Markup:
    """The first facts at once, the others on demand."""
    told = [element("p", fact.replace("`", ""), class_="soft") for fact in facts[:SHOWN]]
    more = facts[SHOWN:]
    rest = [element("details", element("summary", f"{len(more)} more"), list_of(more), class_="soft")] if more else []
    return element("header", element("h1", f"Report: {name}"), *told, *rest)


def _part(name: str) -> str:
    return (files("wasp_cli.report.page") / name).read_text(encoding="utf-8")


def _missing(gaps: str | None, missing: Sequence[Missing]) -> Markup:
    if gaps is None:
        return Markup("")
    cells = list_of(f"{cell.label}: {cell.reason}" for cell in missing)
    told = element("p", element("strong", f"{gaps}."), " Their rows are marked, and nothing stands in for them.")
    return element("div", told, element("details", element("summary", "Which, and why"), cells), class_="warning")


def _table(table: Table) -> Markup:
    return Markup(html(table))


def _figure(path: Path) -> Markup:
    """As an image of its own: the names inside one drawing must not meet those of another."""
    image = element("img", src=data_uri(path.read_bytes(), "image/svg+xml"), alt=CAPTIONS[path.stem])
    return element("figure", image, element("figcaption", CAPTIONS[path.stem]), class_="chart", id=f"figure-{path.stem}")


def _trained(trained: Iterable[Trained]) -> Markup:
    rows = [
        (task_title(each.task), each.seed, each.stage, duration(each.seconds), numbers_text(each.summary), element("code", each.key[:8]))
        for each in trained
    ]
    table = rows_table(("Task", "Seed", "Stage", "Time", "Numbers", "Key"), rows, "trained")
    return joined((element("h3", "Artifacts"), table))


def _assumptions(assumptions: Sequence[Assumption]) -> Markup:
    told = element("p", "Values that the paper leaves open or that differ from it. A spec can change each.")
    rows = [
        (element("code", name), element("code", json.dumps(value, default=str, ensure_ascii=False)), why)
        for name, value, why in assumptions
    ]
    return joined((told, rows_table(("Field", "Value", "Why"), rows, "assumptions")))
