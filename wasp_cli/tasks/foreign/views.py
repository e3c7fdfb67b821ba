"""From the observations of a foreign environment to those of a task: two camera images, and vectors
for the expert.

The image is the whole observation, an entry of it, or what the environment's own `render()` draws.
Where there is none, the vectors are what assistants see.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from wasp_cli.errors import TaskError
from wasp_cli.tasks.base import CAMERA_SIZE, Floats, Pixels
from wasp_cli.tasks.declared import NO_IMAGE, OBSERVATION, RENDER, Declaration, DeclarationError
from wasp_cli.tasks.foreign.calls import GymEnv, calling
from wasp_cli.tasks.foreign.images import (
    WANTED,
    Form,
    form_of,
    image_form,
    looks_like_images,
    remedy,
)
from wasp_cli.tasks.foreign.vectors import (
    Path,
    Space,
    Vector,
    entry_of,
    entry_space,
    known,
    leaves,
    said,
    vector_entry,
)

FRONT = ("pixels", "image", "vision")
"""Entries of a Dict that hold an image."""
REAR = ("pixels2", "image2", "vision_back")
"""Entries that hold the image of a second camera, where that of `FRONT` has one camera."""
PRIVILEGED = "privileged"
STATE = "state"
COARSE = 8  # side of the coarse image that stands in for a privileged vector
_RENDERED = "what render() returns"
_NOTHING = (
    "let the environment draw itself, with `image: render` in its entry of `tasks`; or return "
    "vectors, or an image: " + WANTED
)


@dataclass(frozen=True)
class Camera:
    """Where an image is: at an entry of the observation (of no name: all of it), or drawn."""

    form: Form
    path: Path = ()
    rendered: bool = False

    def scaled(self, observation: Any, env: GymEnv) -> Pixels:
        """Return uint8 [3 or 6, 64, 64]."""
        if self.rendered:
            return self.form.scaled(rendered(env), _RENDERED)
        return self.form.scaled(entry_of(observation, self.path), said(self.path))

    def check(self, observation: Any) -> None:
        """Check the form of the image in an observation. Raises TaskError."""
        if not self.rendered:
            self.form.checked(entry_of(observation, self.path), said(self.path))


@dataclass(frozen=True)
class Views:
    """What is seen of an environment."""

    front: Camera | None  # None: nothing is drawn, and assistants see the vector `state`
    rear: Camera | None
    # None: a coarse image and its change stand in for vectors
    privileged: Vector | None
    state: Vector | None

    @property
    def cameras(self) -> int:
        """0, 1 or 2."""
        if self.front is None:
            return 0
        return 2 if self.rear is not None else self.front.form.cameras

    @property
    def renders(self) -> bool:
        """Whether the image is what the environment draws."""
        return self.front is not None and self.front.rendered

    @property
    def privileged_size(self) -> int:
        """Numbers that the expert reads."""
        return self._coarse_size if self.privileged is None else self.privileged.size

    @property
    def state_size(self) -> int:
        """Numbers of the state vector."""
        return self._coarse_size if self.state is None else self.state.size

    @property
    def _coarse_size(self) -> int:
        return 2 * 3 * self.cameras * COARSE * COARSE

    def pixels(self, observation: Any, env: GymEnv) -> Pixels:
        """Return uint8 [6, 64, 64]: front, then rear, which is black where there is one camera.

        Args:
            observation: what `env` has just returned.
            env: it draws its image now, where it is drawn.
        """
        out = np.zeros((6, CAMERA_SIZE, CAMERA_SIZE), np.uint8)
        if self.front is None:
            return out
        front = self.front.scaled(observation, env)
        out[: len(front)] = front
        if self.rear is not None:
            out[3:] = self.rear.scaled(observation, env)
        return out

    def check(self, observation: Any) -> None:
        """Check that an observation is as its space says. Raises TaskError."""
        for camera in (self.front, self.rear):
            if camera is not None:
                camera.check(observation)
        for vector in (self.privileged, self.state):
            if vector is not None:
                vector.of(observation)

    def coarse(self, pixels: Pixels) -> NDArray[np.float32]:
        """Average pixels [6, 64, 64] to float32 [C]: 8 x 8 colours of each camera, in [0, 1]."""
        side = CAMERA_SIZE // COARSE
        blocks = pixels[: 3 * self.cameras].reshape(-1, COARSE, side, COARSE, side)
        # Sums of integers are exact, so that every machine gets the same bits.
        means = blocks.sum((2, 4), dtype=np.int64) / (255.0 * side * side)
        coarse: NDArray[np.float32] = means.astype(np.float32).ravel()
        return coarse

    def vector(self, observation: Any, which: Vector) -> Floats:
        """Return `privileged` or `state` of an observation as float64 [N]. Raises TaskError."""
        return which.of(observation)


def rendered(env: GymEnv) -> Any:
    """Return what an environment draws. Raises TaskError where it fails."""
    with calling("render"):
        return env.render()


def views_of(space: Space, declaration: Declaration | None = None, drawn: Any = None) -> Views:
    """Return what is seen of an environment.

    Args:
        space: of its observations.
        declaration: what a spec says of it.
        drawn: an image of its `render()`, where the declaration says that assistants see these.

    Raises:
        TaskError: it shows neither an image nor a vector; a DeclarationError where the declaration
            names something that is not there.
    """
    # Images.
    image = None if declaration is None else declaration.image
    front, rear = _cameras(space, image, drawn)

    # Vectors.
    named = None if declaration is None else declaration.vectors
    privileged, state = _found(space, front, rear)
    if named is not None:
        vector = _named(space, named, (front, rear))
        privileged = vector
        state = vector
    if front is None and privileged is None:
        message = "it shows neither a camera image nor a vector"
        raise TaskError(f"{message}: its observation is a {described(space)}", _nothing(space))
    return Views(front, rear, privileged, state)


def _nothing(space: Space) -> str:
    """What to do where nothing is seen of an environment."""
    images = [".".join(path) for path, leaf in leaves(space) if path and looks_like_images(leaf)]
    if images:
        return f"write `image: {images[0]}` into its entry of `tasks`, if that is its image"
    return _NOTHING


# -- images ----------------------------------------------------------------------------------------


def _cameras(space: Space, image: str | None, drawn: Any) -> tuple[Camera | None, Camera | None]:
    """The front camera and the rear one, as they are declared or found."""
    if image is None:
        return _found_cameras(space)
    if image == NO_IMAGE:
        return None, None
    if image == RENDER:
        return _drawn_camera(drawn), None
    path = () if image == OBSERVATION else tuple(image.split("."))
    if path == () and isinstance(space, gymnasium.spaces.Dict) and FRONT[1] in space.spaces:
        path = (FRONT[1],)  # it stands beside what is measured
    entry = entry_space(space, path)
    if entry is None:
        raise DeclarationError(
            "image",
            f"its observation has no entry '{image}'",
            f"{known(space)}; or write `render`, `observation` or `none`",
        )
    form = image_form(entry)
    if form is None:
        raise DeclarationError(
            "image", f"{said(path)} is no image: {described(entry)}", remedy(entry)
        )
    return Camera(form, path), None


def _drawn_camera(drawn: Any) -> Camera:
    """The camera whose images are drawn by `render()`, of which `drawn` is one."""
    form = None
    if isinstance(drawn, np.ndarray):
        form = form_of(drawn.shape, drawn.dtype)
    if form is None:
        is_now = type(drawn).__name__
        if isinstance(drawn, np.ndarray):
            is_now = f"{drawn.dtype} of shape {drawn.shape}"
        raise DeclarationError("image", f"its render() returns no image, but {is_now}", WANTED)
    return Camera(form, rendered=True)


def _found_cameras(space: Space) -> tuple[Camera | None, Camera | None]:
    """The front camera and the rear one, where nothing is declared."""
    if not isinstance(space, gymnasium.spaces.Dict):
        form = image_form(space)
        # Floats without channels may be any matrix; who means an image says so.
        is_matrix = form is not None and form.flat and form.dtype != "uint8"
        if form is None and looks_like_images(space):
            raise TaskError(f"its observation is no image: {described(space)}", remedy(space))
        return (None if form is None or is_matrix else Camera(form)), None
    front = _entry_camera(space, FRONT)
    if front is None or front.form.cameras == 2:
        return front, None
    rear = _entry_camera(space, REAR)
    if rear is not None and rear.form.cameras == 2:
        raise TaskError(f"its second image '{rear.path[0]}' has {rear.form.channels} channels")
    return front, rear


def _entry_camera(space: gymnasium.spaces.Dict, names: tuple[str, ...]) -> Camera | None:
    """The camera of the first of some entries that is there."""
    name = next((name for name in names if name in space.spaces), None)
    if name is None:
        return None
    entry = space.spaces[name]
    form = image_form(entry)
    if form is None and looks_like_images(entry):
        raise TaskError(f"{said((name,))} is no image: {described(entry)}", remedy(entry))
    return None if form is None else Camera(form, (name,))


# -- vectors ---------------------------------------------------------------------------------------


def _named(
    space: Space, names: tuple[str, ...], cameras: tuple[Camera | None, Camera | None]
) -> Vector:
    """The entries that a declaration names, each with all that is below it; none: every vector."""
    if not names:
        whole = _whole(space, cameras)
        if whole is None:
            raise DeclarationError(
                "state",
                f"its observation has no vector: it is a {described(space)}",
                "leave `state` out: the expert then learns from coarse colours of the image",
            )
        return whole
    paths: dict[Path, Space] = {}
    for name in names:
        path = tuple(name.split("."))
        entry = entry_space(space, path)
        if entry is None:
            raise DeclarationError("state", f"its observation has no entry '{name}'", known(space))
        paths |= dict(leaves(entry, path))
    entries = []
    for path, entry in paths.items():
        vector = vector_entry(path, entry)
        if vector is None:
            raise DeclarationError(
                "state", f"{said(path)} has no numbers: {described(entry)}", known(space)
            )
        entries.append(vector)
    return Vector(tuple(entries))


def _found(
    space: Space, front: Camera | None, rear: Camera | None
) -> tuple[Vector | None, Vector | None]:
    """What the expert reads and the state, where nothing is declared."""
    # The two entries by name; one stands for both where the other is not there.
    parts = space.spaces if isinstance(space, gymnasium.spaces.Dict) else {}
    privileged = vector_entry((PRIVILEGED,), parts[PRIVILEGED]) if PRIVILEGED in parts else None
    state = vector_entry((STATE,), parts[STATE]) if STATE in parts else None
    expert_reads = privileged or state
    if expert_reads is not None:
        return Vector((expert_reads,)), Vector((state or expert_reads,))
    # Else all vectors there are, unless the observation has an image to learn from.
    if front is not None and not front.rendered:
        return None, None
    whole = _whole(space, (front, rear))
    return whole, whole


def _whole(space: Space, cameras: tuple[Camera | None, Camera | None]) -> Vector | None:
    """Every vector of an observation; None where there is none."""
    shown = [camera.path for camera in cameras if camera is not None and not camera.rendered]
    entries = []
    for path, leaf in _without_images(space, shown):
        entry = vector_entry(path, leaf)
        if entry is not None:
            entries.append(entry)
    return Vector(tuple(entries)) if entries else None


def _without_images(space: Space, shown: list[Path]) -> Iterator[tuple[Path, Space]]:
    """The entries of an observation that are no images, and not `shown` as one."""
    for path, leaf in leaves(space):
        is_named_so = path[-1:] != () and path[-1] in (*FRONT, *REAR)
        is_image = looks_like_images(leaf) or (is_named_so and image_form(leaf) is not None)
        if path not in shown and not is_image:
            yield path, leaf


def described(space: Space) -> str:
    """Return a space as a short text, for messages."""
    if isinstance(space, gymnasium.spaces.Dict):
        parts = [f"{name}: {described(part)}" for name, part in space.spaces.items()]
        return f"Dict({', '.join(parts)})"
    return f"{type(space).__name__} of shape {space.shape} and type {space.dtype}"
