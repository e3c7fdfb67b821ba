"""From what somebody's loop shows to what a world model reads: images in the form of the cameras of
our tasks, or vectors.

B = episodes side by side, H, W = size of an image.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from wasp_cli.errors import TaskError
from wasp_cli.tasks.base import CAMERA_SIZE, Observation
from wasp_cli.tasks.foreign.views import views_of

CAMERAS = (6, CAMERA_SIZE, CAMERA_SIZE)  # shape of what the front and the rear camera see: RGB each
IMAGE, VECTOR, PRIVILEGED = Observation._fields  # names of what is shown


def perceived(shown: Any, reads: str, batch: int | None, *, own: bool = False) -> Observation:
    """Return the observation of B episodes in the form of our tasks.

    Args:
        shown: what a task of ours or somebody else's environment shows: an array, a dictionary of
            arrays, or an `Observation`. Images are uint8 [6, 64, 64], or in one of the forms of
            `tasks.foreign.views`, and are scaled as there. With a batch, and in an `Observation`,
            every array is [B, ...].
        reads: what the world model reads: `pixels` or `state`.
        batch: B; None: one episode, without a dimension for it.
        own: of a task of ours, whose two cameras are never anything but uint8 [6, 64, 64].

    Raises:
        TaskError: it is no such observation.
    """
    entries = _entries(shown, reads)
    if batch is None and not isinstance(shown, Observation):
        entries = {name: value[None] for name, value in entries.items()}
    for name, value in entries.items():
        if len(value) != (batch or 1):
            raise TaskError(
                f"the observation has {len(value)} rows of '{name}' for {batch} episodes",
                f"with batch={batch} every array begins with {batch} rows",
            )
    pixels = _pixels(entries, own) if reads == IMAGE else None
    state = _state(entries) if reads == VECTOR else None
    privileged = entries.get(PRIVILEGED)
    return Observation(
        pixels, state, None if privileged is None else np.asarray(privileged, np.float32)
    )


def _entries(shown: Any, reads: str) -> dict[str, NDArray[Any]]:
    """The arrays of an observation by name; one that is no dictionary is what the model reads."""
    if isinstance(shown, Observation):
        shown = {name: value for name, value in shown._asdict().items() if value is not None}
    named = shown if isinstance(shown, Mapping) else {reads: shown}
    entries = {}
    for name, value in named.items():
        try:
            array = np.asarray(value)
        except ValueError as error:
            raise TaskError(f"the observation '{name}' is no array: {error}") from error
        if array.ndim:
            entries[str(name)] = array
    if not entries:
        raise TaskError(
            f"the observation is {type(shown).__name__}, and no array or dictionary of arrays"
        )
    return entries


def _pixels(entries: Mapping[str, NDArray[Any]], own: bool) -> NDArray[np.uint8]:
    """uint8 [B, 6, 64, 64]."""
    whole = entries.get(IMAGE)
    if whole is not None and whole.dtype == np.uint8 and whole.shape[1:] == CAMERAS:
        return np.ascontiguousarray(whole)
    if own:
        described = ", ".join(
            f"'{name}' of {value.dtype} {list(value.shape[1:])}" for name, value in entries.items()
        )
        raise TaskError(
            f"the observation is {described}",
            "the assistant sees `pixels`, uint8 [6, 64, 64]: make the environment with "
            "observation='pixels' or 'all'",
        )
    views = views_of(_space(entries))
    if not views.cameras:
        raise TaskError(f"the observation shows no camera image: {', '.join(entries)}")
    rows = range(len(next(iter(entries.values()))))
    return np.stack(
        [views.pixels({name: value[row] for name, value in entries.items()}) for row in rows]
    )


def _space(entries: Mapping[str, NDArray[Any]]) -> gymnasium.spaces.Dict:
    """The space that arrays [B, ...] of an observation are of, as far as its form decides."""
    spaces: dict[str, gymnasium.Space[Any]] = {}
    for name, value in entries.items():
        if value.dtype == np.uint8:
            spaces[name] = gymnasium.spaces.Box(0, 255, value.shape[1:], np.uint8)
        elif value.dtype.kind == "f":
            spaces[name] = gymnasium.spaces.Box(-np.inf, np.inf, value.shape[1:], value.dtype.type)
    return gymnasium.spaces.Dict(spaces)


def _state(entries: Mapping[str, NDArray[Any]]) -> NDArray[np.float64]:
    """float64 [B, S]."""
    vector = entries.get(VECTOR)
    if vector is None:
        raise TaskError(f"the observation has no entry 'state', but: {', '.join(entries)}")
    try:
        values = vector.astype(np.float64).reshape(len(vector), -1)
    except (TypeError, ValueError) as error:
        raise TaskError(f"the observation is no vector of numbers: {vector.dtype}") from error
    if not np.isfinite(values).all():
        raise TaskError(f"the observation is not finite: {values.tolist()}")
    return values
