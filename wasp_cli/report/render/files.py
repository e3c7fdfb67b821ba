"""The files of a report: each table in every format, by file ending, in a folder that is no link; and HTML from templates.

All text in HTML is escaped unless it is markup already. A table is a fragment for a page that brings the style, and may bring a script that
sorts (`page/templates/table.html`):

    <figure class="table" id="table1">
      <table>  thead, and one tbody per group of rows
        <th scope="col" class="number" data-better="up">
        <th scope="row">, with class "again" where the row above has the same label of its group
        <td class="number" data-value="6.5">6.50 ± 0.28</td>    unscaled, as in data files; empty where it is undefined
      <ul class="notes">, <ul class="meanings">

The best value of a group stands in <strong>, the second best in <u>.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wasp_cli.errors import StoreError
from wasp_cli.report.render.latex import latex
from wasp_cli.report.render.text import csv_text, markdown, plain
from wasp_cli.report.tables.table import Table
from wasp_cli.store.artifact import replace_file

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup


def html(table: Table) -> str:
    """Return a `<figure>` with a table and its notes."""
    return str(rendered("table.html", table=table))


def rendered(template: str, /, **values: Any) -> Markup:
    """Fill a template of the page.

    Args:
        template: file of `page/templates`.
        values: what it names; an undefined name is an error.
    """
    from markupsafe import Markup

    return Markup(_environment().get_template(template).render(values))  # every value in it has been escaped


def trusted(name: str) -> Markup:
    """Return a file of the page that is put into it as it is."""
    from markupsafe import Markup

    return Markup((files("wasp_cli.report.page") / name).read_text(encoding="utf-8"))


@cache
def _environment() -> Environment:
    # Imported here: most commands write no HTML.
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("wasp_cli.report.page"), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
        keep_trailing_newline=True,
    )  # fmt: skip
    environment.globals |= {"plain": plain, "data_uri": data_uri}
    return environment


def data_uri(data: bytes, mime: str) -> str:
    """Return bytes as an address that needs no network."""
    return f"data:{mime};base64,{base64.b64encode(data).decode('ascii')}"


RENDERERS: dict[str, Callable[[Table], str]] = {"md": markdown, "csv": csv_text, "tex": latex, "html": html}


def make_own(folder: Path) -> None:
    """Make the folder of a report, and see that nothing which is written there is written elsewhere.

    Raises:
        StoreError: the folder is a link.
    """
    if folder.is_symlink():
        raise StoreError(f"'{folder}' is a link; reports are written to folders of the results")
    folder.mkdir(parents=True, exist_ok=True)
    for path in folder.iterdir():
        if path.is_symlink():
            path.unlink()


def write_pages(folder: Path, pages: Mapping[str, str], tables: Sequence[Table]) -> list[Path]:
    """Write pages (name: text) and every table in every format; returns the files, the pages first."""
    texts = dict(pages)
    texts |= {f"{table.name}.{ending}": render(table) for table in tables for ending, render in RENDERERS.items()}
    for name, text in texts.items():
        replace_file(folder / name, text)
    return [folder / name for name in texts]
