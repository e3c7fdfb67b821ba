"""The words that a shell offers for an option.

Every command loads this module, so registries are imported only when words are asked for; they need
neither torch nor MuJoCo. If a plugin cannot be loaded, nothing is offered.
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
    """A function that imports a registry, or a function of names, and returns its names; none if a
    plugin cannot be loaded.
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
