"""The configuration section of every stage; light, since `wasp plan` reads it. Defaults are the
`cpu` preset (`spec.presets`).

What is in a key imports a section from its own file, so that the key covers no other. No name
stands here: it would change every key.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from wasp_cli.learning.configs.baselines import *  # noqa: F403
    from wasp_cli.learning.configs.judged import *  # noqa: F403
    from wasp_cli.learning.configs.latent import *  # noqa: F403
    from wasp_cli.learning.configs.recorded import *  # noqa: F403
    from wasp_cli.learning.configs.shared import *  # noqa: F403
    from wasp_cli.learning.configs.world import *  # noqa: F403


def __getattr__(name: str) -> Any:
    """Return a section or constant by its name, from the file that has it."""
    if not name.startswith("__"):
        for file in ("shared", "recorded", "world", "latent", "baselines", "judged"):
            found = vars(import_module(f"{__name__}.{file}"))
            if name in found:
                return found[name]
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
