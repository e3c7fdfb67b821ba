"""From what a foreign environment shows to the observations of a task: two camera images, and
vectors for the expert.

H, W = size of the environment's own image. An image is a uint8 Box H x W x 3 or 3 x H x W (one
camera), or with 6 channels (front, then rear). It is the whole observation, or an entry of a Dict.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from wasp_cli.errors import TaskError
from wasp_cli.tasks.base import CAMERA_SIZE, Floats, Pixels

FRONT, REAR = ("pixels", "image", "vision"), ("pixels2", "image2", "vision_back")
"""Entries of a Dict that hold an image; the second is looked for where the first has one camera."""
PRIVILEGED, STATE = "privileged", "state"
COARSE = 8  # side of the coarse image that stands in for a privileged vector
_AS_SAID = "what reset and step return has to be as observation_space says"
_WANTED = (
    "a uint8 Box of shape [H, W, 3], [3, H, W], [H, W, 6] or [6, H, W], or a Dict with one named "
    + ", ".join(FRONT)
)


@dataclass(frozen=True)
class _Camera:
    entry: str | None  # of the Dict; None where the image is the whole observation
    channels_last: bool
    channels: int  # 3, or 6 for two cameras
    shape: tuple[int, ...]  # of the image as the observation holds it

    def image(self, observation: Any) -> Pixels:
        image = np.asarray(observation if self.entry is None else _entry(observation, self.entry))
        if image.shape != self.shape or image.dtype != np.uint8:
            which = "its observation" if self.entry is None else f"its observation '{self.entry}'"
            is_now = "None" if observation is None else f"{image.dtype} of shape {image.shape}"
            raise TaskError(f"{which} is {is_now}, not uint8 of shape {self.shape}", _AS_SAID)
        return image

    def images(self, observation: Any) -> Pixels:
        """Scale to uint8 [channels, 64, 64]: every pixel the mean of the area that it covers."""
        image = self.image(observation)
        last = image if self.channels_last else np.moveaxis(image, 0, -1)
        return np.concatenate(
            [_resized(last[..., first : first + 3]) for first in range(0, self.channels, 3)]
        )


@dataclass(frozen=True)
class Views:
    front: _Camera | None  # None: nothing is drawn, and assistants see the vector `state`
    rear: _Camera | None
    # entry of the privileged vector; None: a coarse image and its change stand in for it
    privileged: str | None
    state: str | None
    privileged_size: int
    state_size: int

    @property
    def cameras(self) -> int:
        """0, 1 or 2."""
        if self.front is None:
            return 0
        return 2 if self.rear is not None or self.front.channels == 6 else 1

    def pixels(self, observation: Any) -> Pixels:
        """Return uint8 [6, 64, 64]: front, then rear, which is black where there is one camera."""
        out = np.zeros((6, CAMERA_SIZE, CAMERA_SIZE), np.uint8)
        if self.front is None:
            return out
        out[: self.front.channels] = self.front.images(observation)
        if self.rear is not None:
            out[3:] = self.rear.images(observation)
        return out

    def check(self, observation: Any) -> None:
        for camera in (self.front, self.rear):
            if camera is not None:
                camera.image(observation)
        for entry in (self.privileged, self.state):
            if entry is not None:
                self.vector(observation, entry)

    def coarse(self, pixels: Pixels) -> NDArray[np.float32]:
        """Average pixels [6, 64, 64] to float32 [C]: 8 x 8 colours of each camera, in [0, 1]."""
        side = CAMERA_SIZE // COARSE
        blocks = pixels[: 3 * self.cameras].reshape(-1, COARSE, side, COARSE, side)
        means: NDArray[np.float32] = (
            (blocks.sum((2, 4), dtype=np.int64) / (255.0 * side * side)).astype(np.float32).ravel()
        )
        return means

    def vector(self, observation: Any, entry: str) -> Floats:
        """Return an entry of an observation as float64 [N], flat."""
        size = self.privileged_size if entry == self.privileged else self.state_size
        given = _entry(observation, entry)
        try:
            values = np.asarray(given, np.float64).ravel()
        except (TypeError, ValueError) as error:
            raise TaskError(
                f"its observation '{entry}' is no array of numbers: {type(given).__name__}"
            ) from error
        if values.size != size:
            raise TaskError(
                f"its observation '{entry}' has {values.size} values, its space has {size}"
            )
        if not np.isfinite(values).all():
            raise TaskError(f"its observation '{entry}' is not finite: {values.tolist()}")
        return values


def views_of(space: gymnasium.Space[Any]) -> Views:
    spaces: Mapping[Any, gymnasium.Space[Any]] = (
        space.spaces if isinstance(space, gymnasium.spaces.Dict) else {None: space}
    )
    front, rear = _camera(spaces, (None, *FRONT)), _camera(spaces, REAR)
    if front is None and not any(_vector_size(spaces, entry) for entry in (PRIVILEGED, STATE)):
        raise TaskError(
            f"its observation shows no camera image: {_described(space)}", f"an image is {_WANTED}"
        )
    if front is None or front.channels == 6:
        rear = None
    elif rear is not None and rear.channels != 3:
        raise TaskError(f"its second image '{rear.entry}' has {rear.channels} channels, not 3")
    sizes = {entry: size for entry in (PRIVILEGED, STATE) if (size := _vector_size(spaces, entry))}
    privileged = next((entry for entry in (PRIVILEGED, STATE) if entry in sizes), None)
    state = next((entry for entry in (STATE, PRIVILEGED) if entry in sizes), None)
    views = Views(front, rear, privileged, state, 0, 0)
    coarse = 2 * 3 * views.cameras * COARSE * COARSE
    return replace(
        views,
        privileged_size=sizes.get(privileged or "", coarse),
        state_size=sizes.get(state or "", coarse),
    )


def _vector_size(spaces: Mapping[Any, gymnasium.Space[Any]], entry: str) -> int:
    """The number of values of an entry that is a vector, or any array; 0 where it is not."""
    space = spaces.get(entry)
    return int(np.prod(space.shape)) if isinstance(space, gymnasium.spaces.Box) else 0


def _entry(observation: Any, entry: str) -> Any:
    if not isinstance(observation, Mapping) or entry not in observation:
        holds = (
            f"entries {list(observation)}"
            if isinstance(observation, Mapping)
            else type(observation).__name__
        )
        raise TaskError(f"its observation has no '{entry}': {holds}", _AS_SAID)
    return observation[entry]


def _camera(
    spaces: Mapping[Any, gymnasium.Space[Any]], entries: tuple[str | None, ...]
) -> _Camera | None:
    entry = next((entry for entry in entries if entry in spaces), "")
    space = spaces.get(entry)
    if (
        not isinstance(space, gymnasium.spaces.Box)
        or space.dtype != np.uint8
        or len(space.shape) != 3
        or 0 in space.shape
    ):
        return None
    for channels_last, channels in ((True, space.shape[-1]), (False, space.shape[0])):
        if channels in (3, 6):
            return _Camera(entry, channels_last, channels, space.shape)
    return None


def _described(space: gymnasium.Space[Any]) -> str:
    if isinstance(space, gymnasium.spaces.Dict):
        return (
            "Dict("
            + ", ".join(f"{name}: {_described(part)}" for name, part in space.spaces.items())
            + ")"
        )
    return f"{type(space).__name__} of shape {space.shape} and type {space.dtype}"


def _resized(image: NDArray[np.uint8]) -> Pixels:
    """[H, W, 3] to [3, 64, 64]. Pillow's box filter works on integers, so that every machine
    gives the same bytes.
    """
    if image.shape[:2] != (CAMERA_SIZE, CAMERA_SIZE):
        resized = Image.fromarray(np.ascontiguousarray(image)).resize(
            (CAMERA_SIZE, CAMERA_SIZE), Image.Resampling.BOX
        )
        image = np.asarray(resized)
    return np.moveaxis(image, -1, 0)
