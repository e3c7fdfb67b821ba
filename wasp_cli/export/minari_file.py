"""A dataset of Minari (https://minari.farama.org), written by Minari itself: HDF5, images as they
are, without the loss of JPEG.

`infos` have T + 1 entries, as Minari's own collector writes them: entry 0 is that of the reset, and
entry t + 1 is what decision t led to. Their names are those of `AssistedEnv`.
"""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

import wasp_cli
from wasp_cli.errors import UsageError
from wasp_cli.export.episode import PIXELS, Episode
from wasp_cli.export.folders import new_folder, require_place
from wasp_cli.export.written import Source, Written, nothing_written
from wasp_cli.report.explain.episode import GATES
from wasp_cli.tasks.info import TaskInfo
from wasp_cli.tasks.registry import TASKS

EXTRA = "minari"
MARK = "data/metadata.json"
NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_-]*-v\d+")
ROOT = "MINARI_DATASETS_PATH"
"""The variable that says where Minari looks for datasets."""
BATCH = 10  # episodes that are in memory together
NOTHING_SEEN = "number of the decision, since what was seen was left out"


def require_minari_place(target: Path, *, force: bool) -> None:
    """See that a dataset of Minari can be written to a folder. Raises UsageError."""
    if NAME.fullmatch(target.name) is None:
        raise UsageError(
            f"'{target.name}' is no name of a dataset of Minari",
            f"the folder is called as the dataset, with a version at the end: "
            f"{target.with_name(_plain(target.name) + '-v0')}",
        )
    require_place(target, MARK, force=force)


def write_minari(source: Source, target: Path) -> Written:
    """Write the episodes of a source as a dataset.

    Args:
        source: of one task.
        target: the folder of the dataset, which is called as the dataset is.

    Returns:
        What was written. `minari.load_dataset(target.name)` loads it where MINARI_DATASETS_PATH is
        the folder around it.

    Raises:
        UsageError, ArtifactError, StoreError: as reading the source does.
    """
    import minari

    episodes = 0
    decisions = 0
    dataset: Any = None
    with new_folder(target) as staged, _datasets_in(staged), warnings.catch_warnings():
        # Minari asks for an author and for a second environment, which nobody has to name.
        warnings.filterwarnings("ignore", message=".*set to None.*", category=UserWarning)
        warnings.filterwarnings("ignore", message="env_spec is None", category=UserWarning)
        for batch in _batches(source.episodes()):
            buffers = [buffer_of(episode) for episode in batch]
            if dataset is None:
                dataset = minari.create_dataset_from_buffers(
                    target.name, buffers, jpeg_encoding=False, **_about(source, batch[0])
                )
                dataset.storage.update_metadata({"gates": {str(k): v for k, v in GATES.items()}})
            else:
                dataset.update_dataset_from_buffer(buffers)
            facts = [_known(episode.facts()) for episode in batch]
            numbers = range(episodes, episodes + len(batch))
            dataset.storage.update_episode_metadata(facts, numbers)
            episodes += len(batch)
            decisions += sum(episode.decisions for episode in batch)
        if dataset is None:
            raise nothing_written(source)
        # Minari writes to a folder of the dataset's name within the one that it was given.
        inner = staged / target.name
        for path in inner.iterdir():
            os.replace(path, staged / path.name)
        inner.rmdir()
    load = f"{ROOT}={target.absolute().parent}  minari.load_dataset('{target.name}')"
    return Written(target, episodes, decisions, load)


def buffer_of(episode: Episode) -> Any:
    """Return an episode as Minari's `EpisodeBuffer`."""
    from minari.data_collector import EpisodeBuffer

    ends = np.zeros(episode.decisions, np.bool_)
    ends[-1] = True
    never = np.zeros(episode.decisions, np.bool_)
    return EpisodeBuffer(
        seed=episode.world_seed,
        observations=_observations(episode),
        actions=episode.action,
        rewards=episode.reward,
        terminations=ends if episode.terminated else never,
        truncations=never if episode.terminated else ends,
        infos=infos_of(episode),
    )


def infos_of(episode: Episode) -> dict[str, NDArray[Any]]:
    """Return the infos of an episode, [T + 1, ...] each."""
    columns = {
        "command": episode.command,
        "intervened": episode.intervened,
        "gate": episode.gate,
        "cost": episode.cost_env,
        "goals": episode.goals,
        "predicted_cost": episode.predicted_cost,
        "predicted_gain": episode.predicted_gain,
        "signal": episode.signal,
    }
    infos: dict[str, NDArray[Any]] = {}
    for name, values in columns.items():
        at_reset = np.zeros((1, *values.shape[1:]), values.dtype)
        if name in ("predicted_cost", "predicted_gain", "signal"):
            at_reset[:] = np.nan
        infos[name] = np.concatenate([at_reset, values])
    if episode.privileged is not None:
        infos["privileged"] = episode.privileged
    return infos


def _observations(episode: Episode) -> NDArray[Any]:
    if episode.seen is not None:
        return episode.seen
    return np.arange(episode.decisions + 1, dtype=np.float32)[:, None]


def _about(source: Source, sample: Episode) -> dict[str, Any]:
    """What Minari records of a dataset: its spaces, its environment, and who drove."""
    drivers = ", ".join(source.labels[:12])
    if len(source.labels) > 12:
        drivers += f" and {len(source.labels) - 12} more"
    about: dict[str, Any] = {
        "observation_space": _space(sample),
        "action_space": gymnasium.spaces.Box(-1.0, 1.0, sample.action.shape[1:], np.float32),
        "algorithm_name": drivers,
        "description": _description(source, sample),
        "requirements": [f"wasp-cli=={wasp_cli.__version__}"],
    }
    spec = _environment(source, sample)
    return about if spec is None else {**about, "env": spec}


def _space(sample: Episode) -> gymnasium.Space[Any]:
    if sample.seen is None:
        return gymnasium.spaces.Box(0.0, np.inf, (1,), np.float32)
    shape = sample.seen.shape[1:]
    if sample.sees == PIXELS:
        return gymnasium.spaces.Box(0, 255, shape, np.uint8)
    return gymnasium.spaces.Box(-np.inf, np.inf, shape, np.float32)


def _description(source: Source, sample: Episode) -> str:
    seen = NOTHING_SEEN
    if sample.sees == PIXELS:
        seen = "front and rear camera, RGB each, channels first"
    elif sample.sees is not None:
        seen = "the vector that assistants see"
    return (
        f"Shared autonomy on {TASKS[source.task].title}, exported by wasp "
        f"{wasp_cli.__version__}. Observation: {seen}. Action: what was executed. "
        "infos['command']: what the operator asked for; infos['intervened']: whether these differ."
    )


def _environment(source: Source, sample: Episode) -> EnvSpec | None:
    """The registration of a task of ours that shows what the dataset has; None of others' tasks,
    whose actions we map, and without observations.
    """
    info = TASKS[source.task]
    if not isinstance(info, TaskInfo) or sample.sees != PIXELS:
        return None
    name = f"wasp_cli.tasks.gym:{info.gym_id}"
    made = gymnasium.make(name, observation=PIXELS, action_repeat=source.action_repeat)
    try:
        return made.spec
    finally:
        made.close()


def _known(facts: dict[str, Any]) -> dict[str, Any]:
    """The facts of an episode that are known: an attribute of HDF5 cannot be None."""
    return {f"wasp/{name}": value for name, value in facts.items() if value is not None}


def _plain(name: str) -> str:
    """A name with nothing that a dataset of Minari cannot be called."""
    return re.sub(r"[^A-Za-z0-9_-]+", "-", re.sub(r"-v\d*$", "", name)).strip("-") or "mine"


@contextmanager
def _datasets_in(folder: Path) -> Iterator[None]:
    """Let Minari write to a folder."""
    before = os.environ.get(ROOT)
    os.environ[ROOT] = str(folder.absolute())
    try:
        yield
    finally:
        if before is None:
            del os.environ[ROOT]
        else:
            os.environ[ROOT] = before


def _batches(episodes: Iterator[Episode]) -> Iterator[list[Episode]]:
    batch: list[Episode] = []
    for episode in episodes:
        batch.append(episode)
        if len(batch) == BATCH:
            yield batch
            batch = []
    if batch:
        yield batch
