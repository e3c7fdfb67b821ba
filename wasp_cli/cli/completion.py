"""Shell completion: candidates for arguments and options; Typer keeps those that begin as typed.

Imports are inside the functions: every command loads this module. Names in registries need neither torch nor MuJoCo. A plugin that does
not load offers nothing, instead of a traceback.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from wasp_cli.errors import WaspError
from wasp_cli.registry import load_target
from wasp_cli.spec.shipped import shipped_names

SPECS = "specs/"


def specs(incomplete: str) -> list[str]:
    """List the YAML files of the typed folder, and without one also those of `specs/` and the names that come with the package."""
    typed = incomplete[: incomplete.rfind("/") + 1]
    folders = [typed] if typed else ["", SPECS]
    files = [f"{folder}{name}" for folder in folders for name in _yaml_files(Path(folder))]
    return files if typed else [*files, *shipped_names()]


def _yaml_files(folder: Path) -> list[str]:
    try:
        return sorted(path.name for path in folder.glob("*.yaml"))
    except OSError:  # no such folder, or none that may be read
        return []


def _offered(target: str, ending: str = "") -> Callable[[], list[str]]:
    """What offers the names in something that is imported when it is asked; none where a plugin does not load."""

    def offered() -> list[str]:
        try:
            names = load_target(target)
            return [f"{name}{ending}" for name in (names() if callable(names) else names)]
        except WaspError:
            return []

    return offered


tasks = _offered("wasp_cli.tasks.registry:TASKS")
methods = _offered("wasp_cli.methods.registry:METHODS")
variants = _offered("wasp_cli.spec.names:assistant_variants")
presets = _offered("wasp_cli.spec.presets:PRESETS")
settings = _offered("wasp_cli.spec.hints:settings", "=")  # the keys of `--set` and `--vary`
