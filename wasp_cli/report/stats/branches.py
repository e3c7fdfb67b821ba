"""Counterfactual branches beside the other numbers of a cell: what its interventions were worth.

    frame = with_branches(read_frame(wanted), wanted)

Letters: E episodes of a cell, N branched decisions of it, W decision steps of a branch.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from wasp_cli.errors import StoreError
from wasp_cli.metrics.necessity import ALONE, ASSISTED, Necessity, necessity
from wasp_cli.plan.grid import COUNTERFACTUAL
from wasp_cli.report.stats.frame import WEIGHT_OF, CellNumbers, Floats, Frame, Judged, Missing, Wanted, absence, odd_tables_refused
from wasp_cli.store.branches import Branches, read_branches
from wasp_cli.store.tables import CellIdentity


def with_branches(frame: Frame, wanted: Iterable[Wanted]) -> Frame:
    """Return the frame with `frame.JUDGED` and their weights as columns of the cells that have branches.

    An episode's number is the mean over its branched interventions, undefined where there are none; so is that of a cell. The cells that
    have rows, and not the branches that they should have, are named in `unbranched`.
    """
    asked = {cell.identity: cell.branches for cell in wanted if cell.branches is not None}
    judged: dict[CellIdentity, Judged] = {}
    gaps: dict[CellIdentity, Missing] = {}
    for cell in frame.cells:
        if cell.identity in asked:
            found = _judged(asked[cell.identity], cell)
            if isinstance(found, Missing):
                gaps[cell.identity] = found
            else:
                judged[cell.identity] = found
    cells = tuple(_with_columns(cell, judged[cell.identity]) if cell.identity in judged else cell for cell in frame.cells)
    return replace(frame, cells=cells, judged=judged, unbranched=tuple(gaps.values()))


def _judged(wanted: Wanted, cell: CellNumbers) -> Judged | Missing:
    key = wanted.path.parent.name
    if wanted.refused is not None:
        return Missing(wanted.identity, wanted.label, wanted.refused, kind=COUNTERFACTUAL)
    if not wanted.path.exists():
        return Missing(wanted.identity, wanted.label, absence(wanted), key, kind=COUNTERFACTUAL)
    try:
        with odd_tables_refused(wanted.path):
            stored = read_branches(wanted.path)
            _require_cell(stored, cell)
            return worth_of(stored)
    except StoreError as error:
        reason = error.message + (f" ({error.hint})" if error.hint else "")
        return Missing(wanted.identity, wanted.label, reason, key, damaged=True, kind=COUNTERFACTUAL)


def _require_cell(stored: Branches, cell: CellNumbers) -> None:
    if stored.cell.identity != cell.identity:
        raise ValueError(f"it holds the branches of another cell: {stored.cell.identity}")
    if stored.cell.episodes != cell.count or (stored.episode < 0).any() or (stored.episode >= cell.count).any():
        raise ValueError(f"it is about {stored.cell.episodes} episodes, and the cell has {cell.count}")


def worth_of(stored: Branches) -> Judged:
    """Compute Eq. 19-21 from the branches of a cell."""
    cost, reward = stored.cost, stored.reward
    worth = necessity(cost[ALONE], cost[ASSISTED], reward[ALONE], reward[ASSISTED], stored.cell.tau_R)
    return Judged(worth, stored.episode, stored.cell.window, stored.cell.tau_R)


def _with_columns(cell: CellNumbers, judged: Judged) -> CellNumbers:
    columns: dict[str, Floats] = {}
    pooled: dict[str, float] = {}
    for name, every in numbers_of(judged.worth).items():
        defined = ~np.isnan(every)
        episode, values = judged.episode[defined], every[defined]
        count = np.bincount(episode, minlength=cell.count).astype(np.float64)
        total = np.bincount(episode, values, cell.count)
        columns |= {name: np.divide(total, count, out=np.full(cell.count, np.nan), where=count > 0), str(WEIGHT_OF[name]): count}
        pooled[name] = float(values.mean()) if len(values) else float("nan")
    return replace(cell, episodes={**cell.episodes, **columns}, pooled={**cell.pooled, **pooled})


def numbers_of(worth: Necessity) -> dict[str, Floats]:
    """Return [N] per column: one number for each branched intervention, NaN where it does not count."""
    unnecessary = worth.unnecessary.astype(np.float64)
    return {
        "uir": unnecessary,
        "uir_swapped": worth.swapped.astype(np.float64),
        "uir_eff": np.where(worth.effective, unnecessary, np.nan),
        "rho": worth.rho,
        "at_risk": (worth.rho > 0.0).astype(np.float64),
        "delta_c": worth.delta_c,
        "delta_r": worth.delta_r,
    }
