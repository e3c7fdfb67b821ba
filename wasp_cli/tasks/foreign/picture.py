"""What a foreign environment draws of itself, in the size in which it draws."""

from __future__ import annotations

import numpy as np

from wasp_cli.errors import TaskError
from wasp_cli.tasks.base import Pixels
from wasp_cli.tasks.foreign.calls import GymEnv
from wasp_cli.tasks.foreign.images import form_of
from wasp_cli.tasks.foreign.views import rendered


def drawn(env: GymEnv) -> Pixels | None:
    """Return what the `render()` of an environment draws now, uint8 [H, W, 3]; None where it fails,
    or returns no image.
    """
    try:
        image = rendered(env)
        if not isinstance(image, np.ndarray):
            return None
        form = form_of(image.shape, image.dtype)
        return None if form is None else form.coloured(image, "what render() returns")[..., :3]
    except TaskError:
        return None
