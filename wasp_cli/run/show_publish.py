"""What is published, as people read it."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table
from rich.text import Text

from wasp_cli.console import size
from wasp_cli.run.publish import Publication


def show_publication(found: Publication, largest: float, console: Console) -> None:
    """Print how much of each kind is published, how much was published before, and what is left out."""
    table = Table(box=None, padding=(0, 2), header_style="bold")
    table.add_column("kind")
    for heading in ("new", "size", "there already"):
        table.add_column(heading, justify="right")
    for kind in dict.fromkeys(item.node.kind for item in (*found.new, *found.there)):
        sizes = [item.size for item in found.new if item.node.kind == kind]
        there = sum(item.node.kind == kind for item in found.there)
        table.add_row(Text(kind), str(len(sizes)), size(sum(sizes)), str(there or "-"))
    reports = [path.stat().st_size for path in found.reports]
    table.add_row("report", str(len(reports)), size(sum(reports)), "-")
    table.add_section()
    total = sum(item.size for item in found.new) + sum(reports)
    table.add_row("total", str(len(found.new) + len(reports)), size(total), str(len(found.there)), style="bold")
    console.print(table)
    for item in found.large:
        text = f"left out: {item.node.label} has {size(item.size)}, more than {size(round(largest))} (--largest)"
        console.print(text, markup=False, soft_wrap=True)
    if found.absent:
        kinds = ", ".join(dict.fromkeys(node.kind for node in found.absent))
        console.print(f"left out: {len(found.absent)} nodes that were not computed, since nothing needs them: {kinds}", markup=False)
