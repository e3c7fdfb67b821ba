"""The images of others: which arrays are one, and how each becomes what assistants see.

H, W = size of the image. It has 1, 3, 4 or 6 channels, last or first: grey, RGB, RGB with an alpha
channel (which is dropped), or two RGB cameras. Its values are uint8, or floats in [0, 1].
"""

from __future__ import annotations

from dataclasses import dataclass

import gymnasium
import numpy as np
from numpy.typing import DTypeLike, NDArray
from PIL import Image

from wasp_cli.errors import TaskError
from wasp_cli.tasks.base import CAMERA_SIZE, Pixels

LAST = (1, 3, 4, 6)
FIRST = (1, 3, 6)
"""Numbers of channels of an image that has them last, and first. Four channels that come first are
a stack of frames: so stack wrappers of gymnasium return grey images."""
SMALLEST = 8  # side of an image in pixels; smaller arrays are vectors
AS_SAID = "what reset and step return has to be as observation_space says"
WANTED = (
    "an image has the shape [H, W], or [H, W, C] with 1, 3, 4 or 6 channels, or [C, H, W] with 1, "
    "3 or 6, of uint8, or of floats in [0, 1]"
)
STACKED = (
    "assistants see one image a decision, and the world model remembers the earlier ones: take the "
    "stack of frames off, as it is in `make` or in a wrapper"
)


@dataclass(frozen=True)
class Form:
    """How an image lies in its array."""

    shape: tuple[int, ...]
    dtype: str
    channels: int  # 1, 3, 4 or 6
    channels_last: bool
    flat: bool = False  # [H, W] without channels

    @property
    def cameras(self) -> int:
        """1 or 2."""
        return 2 if self.channels == 6 else 1

    def checked(self, image: object, name: str) -> NDArray[np.uint8]:
        """Return an image as uint8 of its own shape.

        Args:
            image: what the environment gave.
            name: what it is called in messages.

        Raises:
            TaskError: it has another form, or values beyond [0, 1].
        """
        array = np.asarray(image)
        if array.shape != self.shape or str(array.dtype) != self.dtype:
            is_now = "None" if image is None else f"{array.dtype} of shape {array.shape}"
            raise TaskError(f"{name} is {is_now}, not {self.dtype} of shape {self.shape}", AS_SAID)
        if array.dtype == np.uint8:
            return array
        low = float(array.min())
        high = float(array.max())
        if not (low >= 0.0 and high <= 1.0):  # also where one is NaN
            raise TaskError(f"{name} has values from {low:g} to {high:g}", WANTED)
        return np.rint(255.0 * array.astype(np.float64)).astype(np.uint8)

    def coloured(self, image: object, name: str) -> Pixels:
        """Return an image as uint8 [H, W, 3 or 6]: RGB of each camera. Arguments and errors as of
        `checked`.
        """
        array = self.checked(image, name)
        if self.flat:
            array = array[..., None]
        elif not self.channels_last:
            array = np.moveaxis(array, 0, -1)
        if self.channels == 1:
            array = np.repeat(array, 3, axis=-1)
        elif self.channels == 4:
            array = array[..., :3]
        return array

    def scaled(self, image: object, name: str) -> Pixels:
        """Return an image as uint8 [3 or 6, 64, 64]: every pixel the mean of the area that it
        covers. Arguments and errors as of `checked`.
        """
        array = self.coloured(image, name)
        parts = [_resized(array[..., at : at + 3]) for at in range(0, array.shape[-1], 3)]
        return np.concatenate(parts)


def form_of(shape: tuple[int, ...], dtype: DTypeLike) -> Form | None:
    """Return how an image of a shape and a type lies in its array; None where it is none."""
    kind = np.dtype(dtype)
    if kind != np.uint8 and not np.issubdtype(kind, np.floating):
        return None
    name = str(kind)
    if len(shape) == 2 and min(shape) >= SMALLEST:
        return Form(shape, name, 1, channels_last=True, flat=True)
    if len(shape) != 3:
        return None
    if shape[-1] in LAST and 0 not in shape:
        return Form(shape, name, shape[-1], channels_last=True)
    if shape[0] in FIRST and 0 not in shape:
        return Form(shape, name, shape[0], channels_last=False)
    return None


def image_form(space: gymnasium.Space[object]) -> Form | None:
    """Return the form of the images of a space; None where it has none: floats need bounds within
    [0, 1].
    """
    if not isinstance(space, gymnasium.spaces.Box):
        return None
    form = form_of(space.shape, space.dtype)
    if form is None or form.dtype == "uint8":
        return form
    within = bool((space.low >= 0.0).all() and (space.high <= 1.0).all())
    return form if within else None


def looks_like_images(space: gymnasium.Space[object]) -> bool:
    """Return whether a space has images, in whatever form, also one that assistants cannot see."""
    is_box = isinstance(space, gymnasium.spaces.Box)
    return is_box and space.dtype == np.uint8 and len(space.shape or ()) >= 3


def remedy(space: gymnasium.Space[object]) -> str:
    """Return what to do about a space that is no image in any of the forms."""
    shape = space.shape or ()
    stacked = len(shape) == 4 or (len(shape) == 3 and form_of(shape, np.uint8) is None)
    return STACKED if stacked else WANTED


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
