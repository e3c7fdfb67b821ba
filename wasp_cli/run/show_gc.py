"""What can go, as people read it."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from wasp_cli.console import size
from wasp_cli.store.gc import FAILURES, LOCKS, RUNS, TMP, WORK, Rubbish

LAST = (WORK, FAILURES, RUNS, TMP, LOCKS)


def show_rubbish(found: Sequence[Rubbish], console: Console) -> None:
    """Print how much of each kind can go."""
    if not found:
        console.print("there is nothing to remove")
        return
    table = Table(box=None, padding=(0, 2), header_style="bold")
    table.add_column("what can go")
    table.add_column("count", justify="right")
    table.add_column("size", justify="right")
    kinds = sorted({each.what for each in found} - set(LAST)) + [what for what in LAST if any(each.what == what for each in found)]
    for kind in kinds:
        sizes = [each.size for each in found if each.what == kind]
        table.add_row(Text(kind), str(len(sizes)), size(sum(sizes)))
    table.add_section()
    table.add_row("total", str(len(found)), size(sum(each.size for each in found)), style="bold")
    console.print(table)


def removed_line(count: int, freed: int) -> str:
    """What a removal came to."""
    return f"{count} removed, {size(freed)} freed"
