"""Shell completion: candidates for arguments and options; Typer keeps those that begin as typed.

Imports are inside the functions: every command loads this module. Names in registries need neither torch nor MuJoCo. A plugin that does
not load offers nothing, instead of a traceback.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from wasp_cli.errors import WaspError
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


def tasks() -> list[str]:
    """List the registered tasks."""
    from wasp_cli.tasks.registry import TASKS

    return _names(TASKS)


def methods() -> list[str]:
    """List the methods."""
    from wasp_cli.methods.registry import METHODS

    return _names(METHODS)


def variants() -> list[str]:
    """List the ablations of all methods."""
    from wasp_cli.methods.registry import METHODS

    return list(dict.fromkeys(variant for name in _names(METHODS) for variant in METHODS[name].variants))


def presets() -> list[str]:
    """List the presets, smallest first."""
    from wasp_cli.spec.presets import PRESETS

    return list(PRESETS)


def settings() -> list[str]:
    """List the keys of `--set` and `--vary`, each with its `=`."""
    from wasp_cli.spec.hints import settings

    try:
        return [f"{name}=" for name in settings()]
    except WaspError:
        return []


def _names(registry: Iterable[str]) -> list[str]:
    """List the names in a registry; none where a plugin does not load."""
    try:
        return list(registry)
    except WaspError:
        return []
