"""A frame without what somebody marked as invalid: single episodes leave their cell, a whole cell counts as missing."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np

from wasp_cli.metrics.necessity import Necessity
from wasp_cli.report.notes import Note
from wasp_cli.report.stats.frame import TIMES, WEIGHT_OF, CellNumbers, Frame, Judged, Missing
from wasp_cli.store.tables import CellIdentity


def without_invalid(
    frame: Frame, keys: Mapping[CellIdentity, str], marked: Mapping[tuple[str, int | None], Note]
) -> tuple[Frame, tuple[str, ...]]:
    """Leave out what is marked, and say so, a sentence each.

    Args:
        frame: the cells of a report.
        keys: of their evaluations.
        marked: what `report.notes.invalid` returns.

    Returns:
        The frame, in which a cell that is left out counts as missing, and what was left out.
    """
    if not marked:
        return frame, ()
    kept: list[CellNumbers] = []
    missing: list[Missing] = []
    judged = dict(frame.judged)
    said: list[str] = []
    for cell in frame.cells:
        key = keys.get(cell.identity, "")
        out = {episode for other, episode in marked if other == key and episode is not None and episode < cell.count}
        whole = marked.get((key, None))
        rest = None if whole is not None else without_episodes(cell, out)
        if rest is None:
            first = whole or next(note for (other, _), note in marked.items() if other == key)
            missing.append(Missing(cell.identity, first.label, f"marked as invalid by {first.author}: {first.text}", key))
            judged.pop(cell.identity, None)
            said.append(f"The cell {first.label} is left out: {_why(first)}.")
            continue
        if out:
            said += [
                f"Episode {episode} of {marked[key, episode].label} is left out: {_why(marked[key, episode])}." for episode in sorted(out)
            ]
            if cell.identity in judged:
                judged[cell.identity] = _without(judged[cell.identity], out)
        kept.append(rest)
    if said:
        cells, episodes = len(missing), len(said) - len(missing)
        counts = [f"{count} {name}{'' if count == 1 else 's'}" for count, name in ((episodes, "episode"), (cells, "cell")) if count]
        said.insert(0, f"{' and '.join(counts)} marked as invalid {'is' if len(said) == 1 else 'are'} in no number here.")
    return replace(frame, cells=tuple(kept), missing=(*frame.missing, *missing), judged=judged), tuple(said)


def without_episodes(cell: CellNumbers, out: Collection[int]) -> CellNumbers | None:
    """Return a cell pooled over its other episodes; None where none is left."""
    if not out:
        return cell
    rest = np.array([episode not in out for episode in range(cell.count)])
    if not rest.any():
        return None
    numbers = {"episode": np.arange(float(cell.count))}  # which ones these are, where they are not all
    found = replace(cell, episodes={name: values[rest] for name, values in {**numbers, **cell.episodes}.items()})
    pooled = {}
    for name in cell.pooled:
        if name in TIMES:
            defined = found.episodes[name][~np.isnan(found.episodes[name])]
            pooled[name] = float(np.median(defined)) if len(defined) else float("nan")
        elif name in WEIGHT_OF:
            mass, weight = found.weighted(name)
            pooled[name] = float(mass.sum() / weight.sum()) if weight.sum() else float("nan")
    return replace(found, pooled=pooled)


def _without(judged: Judged, out: Collection[int]) -> Judged:
    rest = ~np.isin(judged.episode, list(out))
    # Episodes are numbered anew, as the rows of the cell are.
    order = {old: new for new, old in enumerate(sorted(set(range(int(judged.episode.max(initial=-1)) + 1)) - set(out)))}
    episode = np.array([order[int(each)] for each in judged.episode[rest]], np.int64)
    old = judged.worth
    of_branches = (old.rho[rest], old.delta_c[rest], old.delta_r[rest])
    worth = Necessity(*of_branches, old.unnecessary[rest], old.swapped[rest], old.effective[rest])
    return replace(judged, worth=worth, episode=episode)


def _why(note: Note) -> str:
    return f"marked as invalid by {note.author} on {note.at[:10]}" + (f", {note.text.rstrip('.')}" if note.text else "")
