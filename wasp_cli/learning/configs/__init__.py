"""The configuration sections of all stages; light, because `wasp plan` reads them. Their defaults
are the `cpu` preset (`spec.presets`).

A stage imports its section from the file of the section, so that its key covers no other section.
For the same reason this file defines no name itself: every key would cover it.
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
    """Return a section or constant by its name, from the file that defines it."""
    if not name.startswith("__"):
        for file in ("shared", "recorded", "world", "latent", "baselines", "judged"):
            found = vars(import_module(f"{__name__}.{file}"))
            if name in found:
                return found[name]
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
