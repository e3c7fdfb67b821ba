"""`wasp replay --step`: was this intervention necessary? Its two counterfactual branches, played and judged (Eq. 19-21)."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from wasp_cli.errors import UsageError, WaspError
from wasp_cli.metrics.episode import INTERVENED
from wasp_cli.metrics.necessity import ALONE, ASSISTED, necessity
from wasp_cli.plan.grid import COUNTERFACTUAL
from wasp_cli.report.explain.stored import Episode, number, read_episode
from wasp_cli.report.node import mapping
from wasp_cli.report.stats.frame import odd_tables_refused
from wasp_cli.store.artifact import read_manifest, read_record, stored_keys
from wasp_cli.store.branches import BRANCHES_FILE, read_branches
from wasp_cli.store.find import FoundCell
from wasp_cli.store.layout import Layout, is_key
from wasp_cli.store.plain import printable
from wasp_cli.store.slim import without_steps
from wasp_cli.video.replay import default_name, source_of, upstream_of

Progress = Callable[[float, str], None]

WINDOW = 15  # W where no artifact says another one


@dataclass(frozen=True)
class Criterion:
    """When an intervention counts as necessary: the window of its branches, and the reward that it has to gain."""

    window: int  # W
    tau_R: float | None  # None: nothing in the results folder says it
    source: str  # who says it


@dataclass(frozen=True)
class Verdict:
    """What an intervention was worth; sums over W decisions."""

    episode: int
    step: int
    intervened: bool
    deviation: float
    window: int
    rho: float  # mean cost of the branch of the command alone (Eq. 19)
    delta_c: float  # costly decisions avoided (Eq. 20)
    delta_r: float  # reward gained (Eq. 20)
    tau_R: float | None
    tau_R_from: str
    unnecessary: bool | None  # Eq. 21; None where nothing was intervened, or tau_R is not known and decides
    assisted: dict[str, list[Any]]  # cost, cost_env and reward of every decision of the branch as executed
    alone: dict[str, list[Any]]  # the same under the command alone

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON values."""
        return asdict(self)

    def lines(self) -> list[str]:
        """Write the decision as lines for people, with the paper's symbols."""
        numbers = f"ρ {self.rho:.3f}   ΔC {self.delta_c:+g}   ΔR {self.delta_r:+.3f}   W {self.window}"
        tau = "τ_R unknown" if self.tau_R is None else f"τ_R {self.tau_R:.3g}"
        if not self.intervened:
            return [numbers, "the command was executed as it was: both branches are the same"]
        if self.unnecessary is None:
            return [
                f"{numbers}   {tau}",
                f"no cost was avoided, and {self.tau_R_from}: whether the gain was worth it is undefined (Eq. 21)",
            ]
        if self.unnecessary:
            return [f"{numbers}   {tau}", "counts as unnecessary: it avoided no cost and gained no more than τ_R (Eq. 21)"]
        why = "it avoided cost" if self.delta_c > 0 else "it gained more than τ_R"
        return [f"{numbers}   {tau}", f"does not count as unnecessary: {why} (Eq. 21)"]


def replay_step(layout: Layout, cell: FoundCell, episode: int, step: int, out: Path | None, progress: Progress) -> tuple[Path, Verdict]:
    """Play both branches of a decision, write them as a video or a still picture, and judge them.

    Args:
        layout: the results folder, which has the models of the cell.
        cell: the cell.
        episode: which of its episodes.
        step: which decision.
        out: the file; None: `<task>_<method>_<operator>_e<episode>_s<step>.gif` in the current folder.
        progress: told the share that is done.

    Raises:
        UsageError: no such episode or decision, or the file cannot be one.
        ArtifactError: a model is missing or damaged, or played again, the cell is not the recorded one.
        StoreError: the rows cannot be read.
        TaskError: the task cannot be imported, or has no snapshots.
    """
    from wasp_cli.video.branches import BranchPair
    from wasp_cli.video.encode import STILL, checked

    if without_steps(cell.manifest):
        raise UsageError(
            f"{printable(cell.label or str(cell.path))} is published in part, so that its branches cannot be played again",
            "without --step its first episodes can; wasp run SPEC --reuse none computes it whole",
        )
    stored = read_episode(cell, episode)
    stored.require(step)
    default = default_name(stored, f"_s{step}.gif")
    path = checked(default if out is None else out, STILL)
    criterion = criterion_of(layout, cell)
    source = source_of(layout, cell, episode)
    pair = BranchPair(source, episode - source.first, step, criterion.window, progress)
    verdict = judge(stored, step, criterion, {name: trace._asdict() for name, trace in pair.traces.items()})
    pair.film(f"{stored.title}, decision {step}", verdict.lines(), path)
    return path, verdict


def judge(stored: Episode, step: int, criterion: Criterion, traces: dict[str, dict[str, list[Any]]]) -> Verdict:
    """Judge one decision by Eq. 19-21; `traces` are by branch lists of at most W values by name, as `branches.BranchTrace`."""

    def row(branch: str, name: str) -> np.ndarray[Any, np.dtype[np.float64]]:
        # As rows of branches store it: float32; what comes after the end of an episode counts as 0.
        values = np.zeros((1, criterion.window))
        values[0, : len(traces[branch][name])] = np.array(traces[branch][name], np.float32)
        return values

    known = criterion.tau_R is not None
    tau_R = np.inf if criterion.tau_R is None else criterion.tau_R
    worth = necessity(row(ALONE, "cost"), row(ASSISTED, "cost"), row(ALONE, "reward"), row(ASSISTED, "reward"), tau_R)
    deviation = float(stored.numbers["deviation"][step])
    # What avoids cost is not unnecessary, whatever tau_R is.
    decided = deviation > INTERVENED and (known or float(worth.delta_c[0]) > 0)
    return Verdict(
        episode=int(stored.row["episode"]), step=step, intervened=deviation > INTERVENED, deviation=deviation, window=criterion.window,
        rho=float(worth.rho[0]), delta_c=float(worth.delta_c[0]), delta_r=float(worth.delta_r[0]),
        tau_R=criterion.tau_R, tau_R_from=criterion.source, unnecessary=bool(worth.unnecessary[0]) if decided else None,
        assisted=traces[ASSISTED], alone=traces[ALONE],
    )  # fmt: skip


def criterion_of(layout: Layout, cell: FoundCell) -> Criterion:
    """Take W and tau_R of a cell's own branches; else of its calibration; else the paper's W and no tau_R."""
    for key in sorted(filter(is_key, stored_keys(layout, COUNTERFACTUAL))) if cell.key else ():
        with suppress(WaspError):
            if cell.key in mapping(read_manifest(layout, COUNTERFACTUAL, key).get("upstream")).values():
                path = layout.within(layout.artifact(COUNTERFACTUAL, key) / BRANCHES_FILE)
                with odd_tables_refused(path):
                    mine = read_branches(path).cell
                return Criterion(mine.window, mine.tau_R, "the counterfactual branches of the cell")
    calibration = upstream_of(cell).get("calibration")
    if calibration is not None:
        with suppress(WaspError):
            found = read_record(layout.within(layout.artifact("calibration", calibration) / "calibration.json")) or {}
            window = mapping(read_manifest(layout, "calibration", calibration).get("config")).get("window")
            tau_R = found.get("tau_R")
            if isinstance(tau_R, float) and number(tau_R) is not None and type(window) is int and window > 0:
                return Criterion(window, tau_R, "the calibration of the method")
    return Criterion(WINDOW, None, "nothing in the results folder says what τ_R is")
