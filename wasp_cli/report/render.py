"""A table as the text of a file, by its ending."""

from __future__ import annotations

from collections.abc import Callable

from wasp_cli.report.render_html import html
from wasp_cli.report.render_latex import latex
from wasp_cli.report.table import Table, csv_text, markdown

RENDERERS: dict[str, Callable[[Table], str]] = {"md": markdown, "csv": csv_text, "tex": latex, "html": html}
