"""From the cells of a run to ladders: Human-only at every severity beside the Expert, episode by episode."""

from __future__ import annotations

from collections.abc import Sequence

from wasp_cli.operators.registry import UNIMPAIRED
from wasp_cli.report.frame import CellNumbers, Frame, Wanted, read_frame
from wasp_cli.report.ladder import Ladder, Rung
from wasp_cli.spec.model import Spec
from wasp_cli.store.tables import CellIdentity


def read_ladders(spec: Spec, wanted: Sequence[Wanted]) -> tuple[list[Ladder], Frame]:
    """The ladders of a spec, by task and then by operator variant, and the frame that they are made from.

    Args:
        spec: for tasks, operators and seeds, in its own order.
        wanted: its cells of Human-only and of the Expert; of other methods nothing is taken.
    """
    frame = read_frame(wanted)
    return ladders_of(spec, frame), frame


def ladders_of(spec: Spec, frame: Frame) -> list[Ladder]:
    """The ladders in a frame, by task and then by operator variant, in the order of the spec."""
    numbers = {cell.identity: cell for cell in frame.cells}

    def rung(task: str, method: str, variant: str, severity: str | None, value: float | None) -> Rung:
        identities = [CellIdentity(task, method, "full", variant, value, seed) for seed in spec.seeds]
        cells = tuple(numbers[identity] for identity in identities if identity in numbers)
        returns = {place: value for cell in cells for place, value in _returns(cell).items()}
        return Rung(severity, value, returns, cells, len(identities) - len(cells))

    ladders = []
    for task in spec.tasks:
        expert = rung(task, "expert", UNIMPAIRED, None, None)
        for variant, severities in spec.operators.items():
            rungs = (rung(task, "human", variant, name, value) for name, value in severities.items())
            ladders.append(Ladder(task, variant, expert, tuple(rungs)))
    return ladders


def _returns(cell: CellNumbers) -> dict[tuple[int, int], float]:
    """Return of each episode by the seed of the cell and its index."""
    return {(cell.identity.seed, index): value for index, value in enumerate(cell.episodes["return"].tolist())}
