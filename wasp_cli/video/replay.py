"""`wasp replay`: a stored episode as a video; with `--step` the two counterfactual branches of a
decision, judged by Eq. 19-21.

The code that plays a cell again needs torch and MuJoCo. It is imported only after the cell and the
step were checked, so that a wrong one is refused at once.
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
PLAYED = 0.3  # share of the time that playing the cell takes, for the progress
FRAMES = 125  # most frames of a video unless `every` is given: some megabytes
MODELS = ("world_model", "policies")  # kinds of the artifacts that a cell is played again with
EXPERT = "expert"  # read by cells of tasks whose operators know more than assistants perceive
# what the manifest of a cell must say, and the types
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
    """Write the video of an episode.

    Args:
        layout: of the results folder.
        cell: that has the episode.
        episode: its number.
        out: the file; None: a name in the working directory.
        every: decisions for each frame; None: as many as give at most FRAMES frames.
        progress: gets the share that is done, and words.

    Returns:
        The file, and what was written.

    Raises:
        ArtifactError: a model is missing or damaged, or the cell comes out differently when it is
            played again.
        UsageError: the episode or its steps are not there, or the file cannot be a video.
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
    """Yield the frames of an episode's video, uint8 [height, width, 3] each. Arguments and errors
    are those of `replay`.
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
    """Return the name of a video that the user has not named: from task, method, operator, seed and
    episode.
    """
    row = stored.row
    value = "" if row["value"] is None else f"-{row['value']:g}"
    variant = "" if row["variant"] == "full" else f"-{row['variant']}"
    who = f"{row['task']}_{row['method']}{variant}_{row['operator']}{value}"
    return Path(slug(f"{who}_s{row['seed']}_e{row['episode']}") + ending)


def source_of(layout: Layout, stored: Episode) -> Source:
    """Return what an episode is played again with: the rows and models of its cell.

    Raises:
        UsageError: the manifest does not say with which models and settings it was evaluated.
        ArtifactError: a model is missing or damaged.
    """
    from wasp_cli.learning.rerun import Recorded
    from wasp_cli.video.trace import Source

    cell = stored.cell
    episode = int(stored.row["episode"])
    axes = cell.setting("axes")
    upstream = dict(upstream_of(cell.manifest).values())

    # The settings of its evaluation. A severity that was chosen is in the rows.
    known: dict[str, Any] = {"action_repeat": cell.setting("settings", "action_repeat")}
    known |= {"task": cell.setting("task"), "seed": cell.setting("seed")}
    if isinstance(axes, dict):
        known["operator"] = axes.get("operator")
        known["value"] = axes.get("value")
        if is_auto(cell.manifest):
            known["value"] = stored.row["value"]
    is_complete = all(isinstance(known.get(name), kind) for name, kind in SAID.items())
    if not is_complete or not all(kind in upstream for kind in MODELS):
        hint = "name the cell by its key or its label, and its results folder with --results"
        raise UsageError(
            f"{cell.path} does not say how it was evaluated, and with which models", hint
        )
    declare_from(str(known["task"]), cell.setting("settings"))

    # Its models.
    alone = without_steps(cell.manifest)
    world_model = _model(layout, "world_model", upstream["world_model"], alone=alone)
    policies = _model(layout, "policies", upstream["policies"], alone=alone)
    expert = None
    if EXPERT in upstream:
        expert = _model(layout, EXPERT, upstream[EXPERT], alone=alone)

    # Its batch of episodes. If the cell is published in part, the episode is played alone.
    if alone:
        a_h = np.asarray(stored.a_h, np.float32)
        a = np.asarray(stored.a, np.float32)
        reward = np.asarray(stored.numbers["reward"], np.float32)
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
    """The folder of a model; for a cell that is published in part also of a published one."""
    published = None
    if alone and not exists(layout, kind, key):
        published = published_folder()
    place = layout if published is None else Layout(published)
    damage = corruption(place, kind, key)
    if damage is None:
        return place.artifact(kind, key)
    hint = (
        "run the spec of the cell again on this results folder: what is missing or damaged is "
        "computed again"
    )
    if alone:
        hint = "models of one training are published; wasp run SPEC --reuse none computes them all"
    raise ArtifactError(f"the {kind.replace('_', ' ')} of this cell cannot be used: {damage}", hint)


def correction(stored: Episode) -> Correction:
    """Return the stored plans as corrections. For a method without plans, each changed action is a
    correction of one step.
    """
    from wasp_cli.video.frame import Correction

    planned = any(plan is not None for plan in stored.plan)
    actions = stored.a.shape[1]
    residuals: list[NDArray[np.float64] | None] = []
    for t, plan in enumerate(stored.plan):
        if planned:
            # A plan of zeros is a search that chose no correction.
            chosen = None
            if plan is not None and any(plan):
                chosen = np.array(plan).reshape(-1, actions)
            residuals.append(chosen)
        elif stored.numbers["deviation"][t] > INTERVENED:
            residuals.append((stored.a[t] - stored.a_h[t])[None])
        else:
            residuals.append(None)
    if planned:
        name = "with the plan"
    elif imagines_expert(stored.cell):
        name = "executed action, then the expert"
    else:
        name = "executed action, then commands"
    # `composition` was a setting of earlier versions.
    hold = (
        stored.row["method"] == "printed"
        or stored.cell.setting("axes", "method_config", "composition") == "hold"
    )
    return Correction(residuals, name, hold)


WINDOW = 15  # W if no artifact has another one: the paper's


@dataclass(frozen=True)
class Criterion:
    """What Eq. 19-21 need: the window W and the threshold tau_R, and where they come from."""

    window: int  # W
    tau_R: float | None  # None: nothing in the results folder says it
    source: str  # who says it


@dataclass(frozen=True)
class Verdict:
    """One decision as judged by Eq. 19-21, with the traces of both branches."""

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
        """Return the verdict as one or two lines of text."""
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
        elif self.delta_c > 0:
            words = "does not count as unnecessary: it avoided cost"
        else:
            words = "does not count as unnecessary: it gained more than τ_R"
        return [f"{numbers}   {tau}", f"{words} (Eq. 21)"]


def replay_step(
    layout: Layout, cell: FoundCell, episode: int, step: int, out: Path | None, progress: Progress
) -> tuple[Path, Verdict]:
    """Play both branches of a decision, write them as a video or a still picture, and judge them.
    Returns the file and the verdict; errors are those of `replay`.
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
            f"{stored.label} is published without all of its steps, so its branches cannot be "
            "played again",
            hint,
        )
    if not plays_on(cell):
        raise UsageError(
            "a person drove this cell, and what they would command in another branch is not known",
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
    """Return whether the operator of a cell can go on from a decision in two ways. A person cannot:
    there is only what was driven.
    """
    return bool(cell.setting("axes", "operator") != PERSON)


def judge(
    stored: Episode, step: int, criterion: Criterion, traces: dict[str, dict[str, list[Any]]]
) -> Verdict:
    """Judge one decision by Eq. 19-21. `traces` has for each branch its cost, cost_env and reward,
    lists of at most W values (`learning.counterfactual.Branch`).
    """

    def row(branch: str, name: str) -> np.ndarray[Any, np.dtype[np.float64]]:
        # As rows of branches store it: in float32, and 0 after the end of an episode.
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
    # An intervention that avoids cost is not unnecessary, whatever tau_R is.
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
    """Return W and tau_R of a cell: from its counterfactual branches, else from its calibration,
    else the paper's W without a tau_R.
    """
    # The branches of the cell.
    keys = sorted(stored_keys(layout, COUNTERFACTUAL)) if cell.key else []
    for key in keys:
        with suppress(WaspError):
            upstream = mapping(read_manifest(layout, COUNTERFACTUAL, key).get("upstream"))
            if cell.key in upstream.values():
                path = layout.within(layout.artifact(COUNTERFACTUAL, key) / BRANCHES_FILE)
                with odd_tables_refused(path):
                    mine = read_branches(path).cell
                return Criterion(mine.window, mine.tau_R, "the counterfactual branches of the cell")

    # Its calibration.
    calibration = dict(upstream_of(cell.manifest).values()).get("calibration")
    if calibration is not None:
        with suppress(WaspError):
            folder = layout.artifact("calibration", calibration)
            record = read_record(layout.within(folder / "calibration.json")) or {}
            tau_R = record.get("tau_R")
            config = mapping(read_manifest(layout, "calibration", calibration).get("config"))
            window = config.get("window")
            is_finite = isinstance(tau_R, float) and number(tau_R) is not None
            if is_finite and type(window) is int and window > 0:
                return Criterion(window, tau_R, "the calibration of the method")
    return Criterion(WINDOW, None, "nothing in the results folder says what τ_R is")
