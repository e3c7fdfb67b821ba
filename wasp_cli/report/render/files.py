"""The files of a report: each table in every format, by file ending, in a folder that is no link."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from wasp_cli.errors import StoreError
from wasp_cli.report.render.html import html
from wasp_cli.report.render.latex import latex
from wasp_cli.report.render.text import csv_text, markdown
from wasp_cli.report.tables.table import Table

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
        (folder / name).write_text(text, encoding="utf-8")
    return [folder / name for name in texts]
