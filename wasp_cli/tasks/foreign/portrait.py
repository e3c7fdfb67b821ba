"""What a foreign environment draws of itself for people, where assistants see no image."""

from __future__ import annotations

import gymnasium
import numpy as np
from numpy.typing import NDArray

from wasp_cli.errors import WaspError
from wasp_cli.tasks.foreign.calls import of_environment, reset
from wasp_cli.tasks.foreign.closing import close
from wasp_cli.tasks.foreign.images import form_of
from wasp_cli.tasks.foreign.make import make_env
from wasp_cli.tasks.foreign.surroundings import printing_aside
from wasp_cli.tasks.foreign.views import rendered


def portrait(name: str, seed: int) -> NDArray[np.uint8] | None:
    """Return the beginning of an episode as [3, 64, 64], drawn by the environment's `render()`.

    None where it cannot draw itself.
    """
    try:
        with printing_aside(), of_environment(name):
            env = make_env(name, draws=True)
            try:
                reset(env, seed)
                image = rendered(env)
            finally:
                close(name, env)
            if not isinstance(image, np.ndarray):
                return None
            form = form_of(image.shape, image.dtype)
            return None if form is None else form.scaled(image, "what render() returns")[:3]
    except (WaspError, gymnasium.error.Error):
        return None
