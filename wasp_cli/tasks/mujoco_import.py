"""MuJoCo asks for OpenGL when it is imported, although nothing but the view from behind needs it. Where that fails, say so."""

from __future__ import annotations

import os

from wasp_cli.errors import UsageError


def require_mujoco() -> None:
    """Import MuJoCo.

    Raises:
        UsageError: it does not import, because MUJOCO_GL names a backend that is not there.
    """
    try:
        import mujoco  # noqa: F401
    except (AttributeError, ImportError, RuntimeError) as error:
        chosen = os.environ.get("MUJOCO_GL")
        if chosen is None:
            raise
        raise UsageError(f"MuJoCo does not import with MUJOCO_GL={chosen}: {error}", "unset MUJOCO_GL, or set it to egl") from error
