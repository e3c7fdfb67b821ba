"""From the cells of a run to ladders: Human-only at every severity beside the Expert, episode by episode."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import pyarrow as pa

from wasp_cli.operators.registry import UNIMPAIRED
from wasp_cli.report.frame import Frame, Wanted, read_frame
from wasp_cli.report.ladder import Ladder, Rung
from wasp_cli.spec.model import Spec
from wasp_cli.store.tables import CellIdentity, read_episodes

COLUMNS = ("task", "method", "variant", "value", "seed", "episode", "return")
Place = tuple[str, str, str, float | None]
"""Task, method, operator variant and severity value: what the cells of a rung have in common."""


def read_ladders(spec: Spec, wanted: Sequence[Wanted]) -> tuple[list[Ladder], Frame]:
    """The ladders of a spec, by task and then by operator variant, and the frame that they are made from.

    Args:
        spec: for tasks, operators and seeds, in its own order.
        wanted: its cells of Human-only and of the Expert; of other methods nothing is taken.

    Raises:
        StoreError: a cell that could be read cannot be read any more.
    """
    frame = read_frame(wanted)
    readable = {cell.identity for cell in frame.cells}
    returns = _returns([cell for cell in wanted if cell.identity in readable])
    numbers = {cell.identity: cell for cell in frame.cells}

    def rung(task: str, method: str, variant: str, severity: str | None, value: float | None) -> Rung:
        identities = [CellIdentity(task, method, "full", variant, value, seed) for seed in spec.seeds]
        cells = tuple(numbers[identity] for identity in identities if identity in numbers)
        return Rung(severity, value, returns.get((task, method, variant, value), {}), cells, len(identities) - len(cells))

    ladders = []
    for task in spec.tasks:
        expert = rung(task, "expert", UNIMPAIRED, None, None)
        for variant, severities in spec.operators.items():
            rungs = (rung(task, "human", variant, name, value) for name, value in severities.items())
            ladders.append(Ladder(task, variant, expert, tuple(rungs)))
    return ladders, frame


def _returns(cells: Iterable[Wanted]) -> dict[Place, dict[tuple[int, int], float]]:
    rows: pa.Table = read_episodes([cell.path for cell in cells]).select(COLUMNS)
    found: dict[Place, dict[tuple[int, int], float]] = {}
    for *place, seed, episode, value in zip(*(rows[name].to_pylist() for name in COLUMNS), strict=True):
        task, method, variant, severity = place
        found.setdefault((task, method, variant, severity), {})[seed, episode] = value
    return found
