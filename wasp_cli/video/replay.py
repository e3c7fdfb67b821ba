"""`wasp replay`: a stored episode as a video. What the rows say goes in plain values to code that plays the cell again.

That code needs torch and MuJoCo and is imported when it is called: a wrong cell or step is refused before.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wasp_cli.errors import ArtifactError, UsageError
from wasp_cli.metrics.episode import INTERVENED
from wasp_cli.plan.grid import OPERATOR_CLONE
from wasp_cli.report.explain.stored import Episode, imagines_expert, read_episode
from wasp_cli.spec.shipped import published_folder
from wasp_cli.store.artifact import corruption, exists
from wasp_cli.store.bounds import require_size
from wasp_cli.store.find import FoundCell
from wasp_cli.store.layout import Layout, slug
from wasp_cli.store.recorded import read_recorded
from wasp_cli.store.slim import without_steps

if TYPE_CHECKING:
    from wasp_cli.learning.rerun import Recorded
    from wasp_cli.video.frame import Correction, WrittenVideo
    from wasp_cli.video.trace import Source

Progress = Callable[[float, str], None]

HORIZON = 15  # imagined steps of a method that has no horizon of its own: the paper's H
FRAMES = 125  # of a video for which nothing else is said: some megabytes
MODELS = ("world_model", "policies")  # kinds of the artifacts that a cell is played again with
EXPERT = "expert"  # is read by cells of tasks whose operators know more than assistants perceive
SAID: dict[str, tuple[type, ...]] = {
    "task": (str,), "action_repeat": (int,), "seed": (int,), "operator": (str,), "value": (int, float, type(None)),
}  # fmt: skip
"""What its manifest has to say, with the types."""


def replay(
    layout: Layout, cell: FoundCell, episode: int, out: Path | None, every: int | None, progress: Progress
) -> tuple[Path, WrittenVideo]:
    """Write the video of an episode.

    Args:
        layout: the results folder, which has the models of the cell.
        cell: the cell.
        episode: which of its episodes.
        out: the file; None: `<task>_<method>_<operator>_e<episode>.gif` in the current folder.
        every: decisions between two frames; None: so many that there are at most FRAMES.
        progress: told the share that is done.

    Returns:
        The written file, and what was written.

    Raises:
        UsageError: no such episode, the file cannot be one, or the cell has no manifest.
        ArtifactError: a model is missing or damaged, or played again, the cell is not the recorded one.
        StoreError: the rows cannot be read.
        TaskError: the task cannot be imported.
    """
    from wasp_cli.video.encode import checked
    from wasp_cli.video.frame import film_episode

    stored = read_episode(cell, episode)
    path = checked(default_name(stored, ".gif") if out is None else out)
    source = source_of(layout, cell, episode)
    made = film_episode(
        source,
        stored,
        episode - source.first,
        correction(stored),
        stored.constants.horizon or HORIZON,
        every or -(-stored.decisions // FRAMES),
        path,
        progress,
    )
    return path, made


def replay_frames(layout: Layout, cell: FoundCell, episode: int, every: int | None) -> Iterator[NDArray[np.uint8]]:
    """Draw the frames of an episode's video, uint8 [height, width, 3] each; arguments and errors are those of `replay`."""
    from wasp_cli.video.frame import frames_of

    stored, source = read_episode(cell, episode), source_of(layout, cell, episode)
    horizon, every = stored.constants.horizon or HORIZON, every or -(-stored.decisions // FRAMES)
    yield from frames_of(source, stored, episode - source.first, correction(stored), horizon, every)


def default_name(stored: Episode, ending: str) -> Path:
    """Name a picture of an episode in the current folder."""
    row = stored.row
    value = "" if row["value"] is None else f"-{row['value']:g}"
    variant = "" if row["variant"] == "full" else f"-{row['variant']}"
    return Path(slug(f"{row['task']}_{row['method']}{variant}_{row['operator']}{value}_e{row['episode']}") + ending)


def source_of(layout: Layout, cell: FoundCell, episode: int) -> Source:
    """Find the rows of a cell and the models that it was evaluated with; a UsageError where its manifest does not name them."""
    from wasp_cli.learning.rerun import Recorded
    from wasp_cli.video.trace import Source

    axes, upstream = cell.setting("axes"), upstream_of(cell)
    known: dict[str, Any] = {
        "task": cell.setting("task"),
        "action_repeat": cell.setting("settings", "action_repeat"),
        "seed": cell.setting("seed"),
    }
    known |= {name: axes.get(name) for name in ("operator", "value")} if isinstance(axes, dict) else {}
    said = all(isinstance(known.get(name), kind) for name, kind in SAID.items())
    if not said or not all(kind in upstream for kind in MODELS):
        raise UsageError(
            f"{cell.path} does not say how it was evaluated, and with which models",
            "name the cell by its key or its label, and its results folder with --results",
        )
    # Of a cell that is published in part, the episode is played alone.
    rounded = without_steps(cell.manifest)
    world_model, policies = (_model(layout, kind, upstream[kind], rounded=rounded) for kind in MODELS)
    expert = _model(layout, EXPERT, upstream[EXPERT], rounded=rounded) if EXPERT in upstream else None
    require_size(cell.path)
    recorded = _alone(cell, episode) if rounded else Recorded(**read_recorded(cell.path))
    # Cells of earlier versions were evaluated as one batch.
    size = cell.setting("settings", "side_by_side")
    size = size if isinstance(size, int) and size > 0 else len(recorded.a)
    first = episode if rounded else episode // size * size
    threads = cell.setting("provenance", "threads")
    clone = cell.setting("upstream", OPERATOR_CLONE)
    return Source(
        **known, recorded=recorded if rounded else recorded.of(range(first, first + size)), first=first,
        world_model=world_model,
        policies=policies,
        expert=expert,
        threads=threads if isinstance(threads, int) and threads > 0 else 1,
        clone=layout.artifact("clone", clone) if isinstance(clone, str) else None,
        rounded=rounded,
        expert_goes_on=imagines_expert(cell),
    )  # fmt: skip


def _model(layout: Layout, kind: str, key: str, *, rounded: bool) -> Path:
    """Find a model in the results folder; of a published cell also where it is published, since runs copy rows alone."""
    published = published_folder() if rounded and not exists(layout, kind, key) else None
    place = layout if published is None else Layout(published)
    if (wrong := corruption(place, kind, key)) is None:
        return place.artifact(kind, key)
    raise ArtifactError(
        f"the {kind.replace('_', ' ')} of this cell cannot be used: {wrong}",
        "models of one training are published; wasp run SPEC --reuse none computes them all" if rounded else
        "run the spec of the cell again on this results folder: what is missing or damaged is computed again",
    )  # fmt: skip


def _alone(cell: FoundCell, episode: int) -> Recorded:
    """What brings one episode back, of a cell that has the steps of few."""
    from wasp_cli.learning.rerun import Recorded

    stored = read_episode(cell, episode)
    a_h, a, reward = (np.asarray(values, np.float32) for values in (stored.a_h, stored.a, stored.numbers["reward"]))
    return Recorded([int(stored.row["episode_seed"])], [a_h], [a], [reward], episode)


def upstream_of(cell: FoundCell) -> dict[str, str]:
    """Return the keys of what a cell was computed from, by kind."""
    keys, kinds = cell.setting("upstream"), cell.setting("upstream_kinds")
    if not isinstance(keys, dict) or not isinstance(kinds, dict):
        return {}
    return {str(kinds[role]): str(key) for role, key in keys.items() if role in kinds}


def correction(stored: Episode) -> Correction:
    """Return the stored plans, or of a method without plans each changed action as a correction of one step."""
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
    name = "with the plan" if planned else "executed action, then commands"
    hold = stored.row["method"] == "printed" or stored.cell.setting("axes", "method_config", "composition") == "hold"  # an earlier setting
    return Correction(residuals, name, hold)
