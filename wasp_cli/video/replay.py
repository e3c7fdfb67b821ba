"""`wasp replay`: a stored episode as a video; with `--step` the two counterfactual branches of a
decision, judged by Eq. 19-21.

What the rows say goes in plain values to code that plays the cell again. That code needs torch and
MuJoCo and is imported when it is called: a wrong cell or step is refused before.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wasp_cli.cells.read import odd_tables_refused
from wasp_cli.errors import ArtifactError, UsageError, WaspError
from wasp_cli.metrics.episode import INTERVENED
from wasp_cli.metrics.necessity import ALONE, ASSISTED, necessity
from wasp_cli.operators.registry import PERSON
from wasp_cli.plan.grid import COUNTERFACTUAL, OPERATOR_CLONE
from wasp_cli.report.explain.episode import Episode, imagines_expert, number, read_episode
from wasp_cli.report.node import mapping, upstream_of
from wasp_cli.run.cores import threads_here
from wasp_cli.spec.shipped import published_folder
from wasp_cli.store.artifact import corruption, exists, read_manifest, stored_keys
from wasp_cli.store.branches import BRANCHES_FILE, read_branches
from wasp_cli.store.find import FoundCell
from wasp_cli.store.layout import Layout, slug
from wasp_cli.store.recorded import read_recorded
from wasp_cli.store.records import read_record
from wasp_cli.store.severities import is_auto
from wasp_cli.store.slim import without_steps
from wasp_cli.tasks.declared import declare_from

if TYPE_CHECKING:
    from wasp_cli.video.frame import Correction, Painter, WrittenVideo
    from wasp_cli.video.trace import Progress, Source

HORIZON = 15  # imagined steps of a method that has no horizon of its own: the paper's H
PLAYED = 0.3  # share of the time that playing the cell takes
FRAMES = 125  # of a video for which nothing else is said: some megabytes
MODELS = ("world_model", "policies")  # kinds of the artifacts that a cell is played again with
EXPERT = "expert"  # is read by cells of tasks whose operators know more than assistants perceive
# by a cell's manifest
SAID = {
    "task": str,
    "action_repeat": int,
    "seed": int,
    "operator": str,
    "value": float | int | None,
}


def replay(
    layout: Layout,
    cell: FoundCell,
    episode: int,
    out: Path | None,
    every: int | None,
    progress: Progress,
) -> tuple[Path, WrittenVideo]:
    """Write the video of an episode, a frame for every `every` decisions (None: FRAMES at most);
    returns the file, and what was written.

    An ArtifactError where a model is missing or damaged, or where the cell that is played again is
    not the recorded one.
    """
    from wasp_cli.video.film import checked

    stored = read_episode(cell, episode)
    path = checked(default_name(stored, ".gif") if out is None else out)
    painter = _painter(layout, stored, every, lambda share, text: progress(PLAYED * share, text))
    return path, painter.film(
        path, lambda share, text: progress(PLAYED + (1 - PLAYED) * share, text)
    )


def replay_frames(
    layout: Layout, cell: FoundCell, episode: int, every: int | None
) -> Iterator[NDArray[np.uint8]]:
    """Draw the frames of an episode's video, uint8 [height, width, 3] each; arguments and
    errors are those of `replay`.
    """
    yield from _painter(
        layout, read_episode(cell, episode), every, lambda share, text: None
    ).frames()


def _painter(layout: Layout, stored: Episode, every: int | None, progress: Progress) -> Painter:
    from wasp_cli.video.frame import Painter

    horizon = stored.constants.horizon or HORIZON
    every = every or -(-stored.decisions // FRAMES)
    return Painter(source_of(layout, stored), stored, correction(stored), horizon, every, progress)


def default_name(stored: Episode, ending: str) -> Path:
    row = stored.row
    value = "" if row["value"] is None else f"-{row['value']:g}"
    variant = "" if row["variant"] == "full" else f"-{row['variant']}"
    who = f"{row['task']}_{row['method']}{variant}_{row['operator']}{value}"
    return Path(slug(f"{who}_s{row['seed']}_e{row['episode']}") + ending)


def source_of(layout: Layout, stored: Episode) -> Source:
    """Find what an episode is played again with: rows and models of its cell; a UsageError
    where its manifest does not name them.
    """
    from wasp_cli.learning.rerun import Recorded
    from wasp_cli.video.trace import Source

    cell = stored.cell
    episode = int(stored.row["episode"])
    axes = cell.setting("axes")
    upstream = dict(upstream_of(cell.manifest).values())
    known: dict[str, Any] = {"action_repeat": cell.setting("settings", "action_repeat")}
    known |= {"task": cell.setting("task"), "seed": cell.setting("seed")}
    if isinstance(axes, dict):
        known["operator"] = axes.get("operator")
        # a severity that was chosen stands in the rows
        known["value"] = stored.row["value"] if is_auto(cell.manifest) else axes.get("value")
    said = all(isinstance(known.get(name), kind) for name, kind in SAID.items())
    if not said or not all(kind in upstream for kind in MODELS):
        hint = "name the cell by its key or its label, and its results folder with --results"
        raise UsageError(
            f"{cell.path} does not say how it was evaluated, and with which models", hint
        )
    declare_from(str(known["task"]), cell.setting("settings"))
    # Of a cell that is published in part, the episode is played alone.
    alone = without_steps(cell.manifest)
    world_model, policies = (_model(layout, kind, upstream[kind], alone=alone) for kind in MODELS)
    expert = _model(layout, EXPERT, upstream[EXPERT], alone=alone) if EXPERT in upstream else None
    if alone:
        a_h, a, reward = (
            np.asarray(values, np.float32)
            for values in (stored.a_h, stored.a, stored.numbers["reward"])
        )
        recorded = Recorded([int(stored.row["episode_seed"])], [a_h], [a], [reward], episode)
    else:
        whole = Recorded(**read_recorded(cell.path))
        size = cell.setting("settings", "side_by_side")
        size = size if isinstance(size, int) and size > 0 else len(whole.a)
        recorded = whole.of(range(episode // size * size, (episode // size + 1) * size))
    clone = cell.setting("upstream", OPERATOR_CLONE)
    return Source(
        **known,
        recorded=recorded,
        alone=alone,
        world_model=world_model,
        policies=policies,
        expert=expert,
        expert_goes_on=imagines_expert(cell),
        clone=layout.artifact("clone", clone) if isinstance(clone, str) else None,
        threads=threads_here(),
    )


def _model(layout: Layout, kind: str, key: str, *, alone: bool) -> Path:
    published = published_folder() if alone and not exists(layout, kind, key) else None
    place = layout if published is None else Layout(published)
    if (wrong := corruption(place, kind, key)) is None:
        return place.artifact(kind, key)
    hint = (
        "run the spec of the cell again on this results folder: what is missing or damaged is "
        "computed again"
    )
    if alone:
        hint = "models of one training are published; wasp run SPEC --reuse none computes them all"
    raise ArtifactError(f"the {kind.replace('_', ' ')} of this cell cannot be used: {wrong}", hint)


def correction(stored: Episode) -> Correction:
    """Return the stored plans, or of a method without plans each changed action as a correction
    of one step.
    """
    from wasp_cli.video.frame import Correction

    planned = any(plan is not None for plan in stored.plan)
    actions = stored.a.shape[1]
    residuals: list[NDArray[np.float64] | None] = []
    for t, plan in enumerate(stored.plan):
        if planned:
            chosen = None if plan is None else np.array(plan).reshape(-1, actions)
            # Where the command stood after a second look, the plan is zero.
            residuals.append(chosen if chosen is not None and np.abs(chosen).max() > 0.0 else None)
        else:
            changed = stored.numbers["deviation"][t] > INTERVENED
            residuals.append((stored.a[t] - stored.a_h[t])[None] if changed else None)
    name = (
        "with the plan"
        if planned
        else f"executed action, then {'the expert' if imagines_expert(stored.cell) else 'commands'}"
    )
    # an earlier setting
    hold = (
        stored.row["method"] == "printed"
        or stored.cell.setting("axes", "method_config", "composition") == "hold"
    )
    return Correction(residuals, name, hold)


WINDOW = 15  # W where no artifact says another one


@dataclass(frozen=True)
class Criterion:
    window: int  # W
    tau_R: float | None  # None: nothing in the results folder says it
    source: str  # who says it


@dataclass(frozen=True)
class Verdict:
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
    # Eq. 21; None where nothing was intervened, or tau_R is not known and decides
    unnecessary: bool | None
    # cost, cost_env and reward of every decision of the branch as executed
    assisted: dict[str, list[Any]]
    alone: dict[str, list[Any]]  # the same under the command alone

    def lines(self) -> list[str]:
        numbers = (
            f"ρ {self.rho:.3f}   ΔC {self.delta_c:+g}   ΔR {self.delta_r:+.3f}   W {self.window}"
        )
        tau = "τ_R unknown" if self.tau_R is None else f"τ_R {self.tau_R:.3g}"
        if not self.intervened:
            return [numbers, "the command was executed as it was: both branches are the same"]
        if self.unnecessary is None:
            words = (
                f"no cost was avoided, and {self.tau_R_from}: whether the gain was worth it is "
                "undefined"
            )
        elif self.unnecessary:
            words = "counts as unnecessary: it avoided no cost and gained no more than τ_R"
        else:
            words = (
                "does not count as unnecessary: "
                f"{'it avoided cost' if self.delta_c > 0 else 'it gained more than τ_R'}"
            )
        return [f"{numbers}   {tau}", f"{words} (Eq. 21)"]


def replay_step(
    layout: Layout, cell: FoundCell, episode: int, step: int, out: Path | None, progress: Progress
) -> tuple[Path, Verdict]:
    """Play both branches of a decision, write them as a video or a still picture, and judge
    them; errors are those of `replay`.
    """
    from wasp_cli.video.branches import BranchPair
    from wasp_cli.video.film import STILL, checked

    stored = read_episode(cell, episode)
    if without_steps(cell.manifest):
        hint = (
            "without --step its first episodes can; wasp run SPEC --reuse none computes "
            "another cell: it trains anew"
        )
        raise UsageError(
            f"{stored.label} is published in part, so that its branches cannot be played again",
            hint,
        )
    if not plays_on(cell):
        raise UsageError(
            "what a person commands in another branch is not on record",
            "without --step the episode can be replayed",
        )
    stored.require(step)
    path = checked(default_name(stored, f"_t{step}.gif") if out is None else out, STILL)
    criterion = criterion_of(layout, cell)
    source = source_of(layout, stored)
    pair = BranchPair(source, episode - source.recorded.first, step, criterion.window, progress)
    parts = ("cost", "cost_env", "reward")
    traces = {
        name: {part: getattr(branch, part).tolist() for part in parts}
        for name, branch in pair.branches.items()
    }
    verdict = judge(stored, step, criterion, traces)
    pair.film(f"{stored.title}, decision {step}", verdict.lines(), path)
    return path, verdict


def plays_on(cell: FoundCell) -> bool:
    """Return whether the operator of a cell can go on from a decision in two ways; of a person
    there is only what was driven.
    """
    return bool(cell.setting("axes", "operator") != PERSON)


def judge(
    stored: Episode, step: int, criterion: Criterion, traces: dict[str, dict[str, list[Any]]]
) -> Verdict:
    """Judge one decision by Eq. 19-21; `traces` are by branch lists of at most W values by
    name, as in `learning.counterfactual.Branch`.
    """

    def row(branch: str, name: str) -> np.ndarray[Any, np.dtype[np.float64]]:
        # As rows of branches store it: float32; what comes after the end of an episode counts as 0.
        values = np.zeros((1, criterion.window))
        values[0, : len(traces[branch][name])] = np.array(traces[branch][name], np.float32)
        return values

    tau_R = np.inf if criterion.tau_R is None else criterion.tau_R
    worth = necessity(
        row(ALONE, "cost"),
        row(ASSISTED, "cost"),
        row(ALONE, "reward"),
        row(ASSISTED, "reward"),
        tau_R,
    )
    deviation = float(stored.numbers["deviation"][step])
    # What avoids cost is not unnecessary, whatever tau_R is.
    decided = deviation > INTERVENED and (
        criterion.tau_R is not None or float(worth.delta_c[0]) > 0
    )
    return Verdict(
        episode=int(stored.row["episode"]),
        step=step,
        intervened=deviation > INTERVENED,
        deviation=deviation,
        window=criterion.window,
        rho=float(worth.rho[0]),
        delta_c=float(worth.delta_c[0]),
        delta_r=float(worth.delta_r[0]),
        tau_R=criterion.tau_R,
        tau_R_from=criterion.source,
        unnecessary=bool(worth.unnecessary[0]) if decided else None,
        assisted=traces[ASSISTED],
        alone=traces[ALONE],
    )


def criterion_of(layout: Layout, cell: FoundCell) -> Criterion:
    """Take W and tau_R of a cell's own branches; else of its calibration; else the paper's W
    and no tau_R.
    """
    for key in sorted(stored_keys(layout, COUNTERFACTUAL)) if cell.key else ():
        with suppress(WaspError):
            if (
                cell.key
                in mapping(read_manifest(layout, COUNTERFACTUAL, key).get("upstream")).values()
            ):
                path = layout.within(layout.artifact(COUNTERFACTUAL, key) / BRANCHES_FILE)
                with odd_tables_refused(path):
                    mine = read_branches(path).cell
                return Criterion(mine.window, mine.tau_R, "the counterfactual branches of the cell")
    calibration = dict(upstream_of(cell.manifest).values()).get("calibration")
    if calibration is not None:
        with suppress(WaspError):
            record = (
                read_record(
                    layout.within(layout.artifact("calibration", calibration) / "calibration.json")
                )
                or {}
            )
            window = mapping(read_manifest(layout, "calibration", calibration).get("config")).get(
                "window"
            )
            tau_R = record.get("tau_R")
            if (
                isinstance(tau_R, float)
                and number(tau_R) is not None
                and type(window) is int
                and window > 0
            ):
                return Criterion(window, tau_R, "the calibration of the method")
    return Criterion(WINDOW, None, "nothing in the results folder says what τ_R is")
