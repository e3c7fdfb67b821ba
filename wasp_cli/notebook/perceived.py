"""From what somebody's loop shows to what a world model reads: images in the form of the cameras of
our tasks, or vectors.

B = episodes side by side, S = numbers of a vector.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from wasp_cli.errors import TaskError
from wasp_cli.tasks.base import CAMERA_SIZE, Observation, Pixels
from wasp_cli.tasks.declared import RENDER, Declaration
from wasp_cli.tasks.foreign.images import WANTED, form_of
from wasp_cli.tasks.foreign.views import Views, views_of

CAMERAS = (6, CAMERA_SIZE, CAMERA_SIZE)  # shape of what the front and the rear camera see: RGB each
IMAGE, VECTOR, PRIVILEGED = Observation._fields  # names of what is shown
_SHOWN = "the observation"
ALONE = "pass the observation alone: reset and step return it first, with more behind it"


def perceived(
    shown: Any, reads: str, batch: int | None, own: bool, declaration: Declaration | None
) -> Observation:
    """Return the observation of B episodes in the form of our tasks.

    Args:
        shown: what a task of ours or somebody else's environment shows: an array or a dictionary of
            arrays, each [B, ...] with a batch; or an `Observation`, which stays as it is.
        reads: what the world model reads: `pixels` or `state`.
        batch: B; None: one episode, without a dimension for it.
        own: of a task of ours, whose two cameras are never anything but uint8 [6, 64, 64].
        declaration: what a spec says of somebody else's environment.

    Raises:
        TaskError: it is no such observation.
    """
    if isinstance(shown, Observation):
        return _as_it_is(shown, reads, batch or 1)
    rows = [shown] if batch is None else _rows(shown, batch)
    privileged = None
    if own and all(isinstance(row, Mapping) and PRIVILEGED in row for row in rows):
        privileged = np.stack([np.asarray(row[PRIVILEGED], np.float32) for row in rows])
    if reads == IMAGE:
        pixels = np.stack([_pixels(row, own, declaration) for row in rows])
        return Observation(pixels, None, privileged)
    return Observation(None, np.stack([_vector(row, declaration) for row in rows]), privileged)


def seen_through(views: Views, observation: Any, env: Any, reads: str) -> Observation:
    """Return what is seen of somebody else's environment, of one episode.

    Args:
        views: of the environment.
        observation: what `env` has just returned.
        env: it draws its image now, where that is what assistants see.
        reads: what the world model reads.

    Raises:
        TaskError: the environment shows no such thing.
    """
    require_sight(views, reads)
    if reads == IMAGE:
        return Observation(views.pixels(observation, env)[None], None, None)
    assert views.state is not None
    return Observation(None, views.state.of(observation)[None], None)


def require_sight(views: Views, reads: str) -> None:
    """Refuse views without what the world model reads. Raises TaskError."""
    if reads == IMAGE and not views.cameras:
        raise TaskError("the observation shows no camera image", WANTED)
    if reads == VECTOR and views.state is None:
        raise TaskError("the observation shows no vector, which the assistant was trained on")


def require_size(size: int, trained: int, label: str) -> None:
    """Refuse a vector of another number of components than a model was trained on. Raises
    TaskError.
    """
    if size != trained:
        raise TaskError(
            f"the observation has {size} numbers, and '{label}' was trained on {trained}",
            "show it what the environment that it was trained on shows, without wrappers that add "
            "to the observation or take from it",
        )


def _as_it_is(shown: Observation, reads: str, rows: int) -> Observation:
    value = shown.pixels if reads == IMAGE else shown.state
    if value is None:
        raise TaskError(f"the observation has no '{reads}', which the assistant sees")
    whole = reads == VECTOR or (value.dtype == np.uint8 and value.shape[1:] == CAMERAS)
    if len(value) != rows or not whole:
        raise TaskError(
            f"the observation's '{reads}' is {value.dtype} {list(value.shape)} for {rows} episodes"
        )
    return shown


def _rows(shown: Any, batch: int) -> list[Any]:
    """The observations of B episodes that lie in arrays [B, ...]."""
    if isinstance(shown, Mapping):
        parts = {name: _rows(value, batch) for name, value in shown.items()}
        return [{name: rows[row] for name, rows in parts.items()} for row in range(batch)]
    array = _array(shown)
    if not array.ndim or len(array) != batch:
        raise TaskError(
            f"the observation has rows {list(array.shape[:1])} for {batch} episodes",
            f"with batch={batch} every array begins with {batch} rows",
        )
    return list(array)


def _array(value: Any) -> NDArray[Any]:
    try:
        array = np.asarray(value)
    except ValueError as error:
        raise TaskError(f"the observation is no array, but a {type(value).__name__}", ALONE) from (
            error
        )
    if array.dtype.kind not in "biuf":
        raise TaskError(f"the observation is no array of numbers: {type(value).__name__}", ALONE)
    return array


def _pixels(row: Any, own: bool, declaration: Declaration | None) -> Pixels:
    """uint8 [6, 64, 64] of one episode."""
    whole = _array(row.get(IMAGE, 0) if isinstance(row, Mapping) else row)
    if whole.dtype == np.uint8 and whole.shape == CAMERAS:
        return whole
    if own:
        shown = row if isinstance(row, Mapping) else {IMAGE: row}
        arrays = {name: _array(value) for name, value in shown.items()}
        described = [f"'{name}' of {a.dtype} {list(a.shape)}" for name, a in arrays.items()]
        raise TaskError(
            f"the observation is {', '.join(described)}",
            "the assistant sees `pixels`, uint8 [6, 64, 64]: make the environment with "
            "observation='pixels' or 'all'",
        )
    if not isinstance(row, Mapping):
        form = form_of(whole.shape, whole.dtype)
        if form is None:
            raise TaskError(f"the observation is {whole.dtype} of shape {whole.shape}", WANTED)
        out: Pixels = np.zeros(CAMERAS, np.uint8)
        image = form.scaled(whole, _SHOWN)
        out[: len(image)] = image
        return out
    if declaration is not None and declaration.image == RENDER:
        declaration = declaration.model_copy(update={"image": None})  # it is drawn already
    if declaration is not None and declaration.measured is not None:
        declaration = declaration.model_copy(update={"state": None})  # assistants do not see it
    views = views_of(_space(row), declaration)
    require_sight(views, IMAGE)
    nobody: Any = None  # nothing is drawn here
    return views.pixels(row, nobody)


def _vector(row: Any, declaration: Declaration | None) -> NDArray[np.float64]:
    """float64 [S] of one episode."""
    if isinstance(row, Mapping):
        views = views_of(_space(row), declaration)
        require_sight(views, VECTOR)
        assert views.state is not None
        return views.state.of(row)
    values = _array(row).astype(np.float64)
    if values.ndim != 1:
        raise TaskError(
            f"the observation has the shape {list(values.shape)}, and the assistant sees a vector",
            "pass what the environment that it was trained on shows, of one moment",
        )
    if not np.isfinite(values).all():
        bad = np.flatnonzero(~np.isfinite(values))[0]
        raise TaskError(f"the observation is not finite: its number {bad} is {values[bad]}")
    return values


def _space(row: Any) -> gymnasium.Space[Any]:
    """The space that an observation is of, as far as its form decides."""
    if isinstance(row, Mapping):
        return gymnasium.spaces.Dict({str(name): _space(value) for name, value in row.items()})
    array = _array(row)
    if array.dtype == np.uint8:
        return gymnasium.spaces.Box(0, 255, array.shape, np.uint8)
    kind: Any = array.dtype.type if array.dtype.kind == "f" else np.float64
    if array.ndim > 1 and array.min() >= 0.0 and array.max() <= 1.0:  # an image may be so
        return gymnasium.spaces.Box(0.0, 1.0, array.shape, kind)
    return gymnasium.spaces.Box(-np.inf, np.inf, array.shape, kind)
