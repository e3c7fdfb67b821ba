"""What a shell offers for an option.

It is imported when it is asked for: every command loads this module. Names in registries need
neither torch nor MuJoCo. A plugin that does not load offers nothing, instead of a traceback.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from glob import escape, glob

from wasp_cli.errors import WaspError
from wasp_cli.registry import load_target
from wasp_cli.spec.shipped import shipped_names

Completion = Callable[..., list[str]] | None


def spec_names(incomplete: str) -> list[str]:
    """List the YAML files of the typed folder, and without one also those of `specs/` and the
    names that come with the package.
    """
    typed = incomplete[: incomplete.rfind("/") + 1]
    folders = [typed] if typed else ["", "specs/"]
    files = [name for folder in folders for name in sorted(glob(f"{escape(folder)}*.yaml"))]
    return files if typed else [*files, *shipped_names()]


def _offered(target: str, ending: str = "") -> Callable[[], list[str]]:
    """What offers the names in something that is imported when it is asked; none where a plugin
    does not load.
    """

    def offered() -> list[str]:
        with suppress(WaspError):
            names = load_target(target)
            return [f"{name}{ending}" for name in (names() if callable(names) else names)]
        return []

    return offered


task_names = _offered("wasp_cli.tasks.registry:TASKS")
method_names = _offered("wasp_cli.methods.registry:METHODS")
variant_names = _offered("wasp_cli.spec.names:assistant_variants")
preset_names = _offered("wasp_cli.spec.presets:PRESETS")
setting_names = _offered("wasp_cli.spec.hints:settings", "=")  # the keys of `--set` and `--vary`
