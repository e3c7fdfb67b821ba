"""wasp: an experiment orchestrator for safety-aware shared autonomy with world-model constrained planning.

import wasp_cli

results = wasp_cli.results("results")              # tables of a results folder; needs no torch
model = wasp_cli.load_world_model("results")       # filters, imagines, decodes
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from wasp_cli.notebook.results import open_results as results
    from wasp_cli.notebook.world_model import load_world_model

__version__ = "0.1.0"
__all__ = ["__version__", "load_world_model", "results"]

_LAZY = {
    "results": ("wasp_cli.notebook.results", "open_results"),
    "load_world_model": ("wasp_cli.notebook.world_model", "load_world_model"),
}
"""Public names with the module that has each: importing the package must take no time, and the command line needs neither."""


def __getattr__(name: str) -> Any:
    from importlib import import_module

    if name not in _LAZY:
        raise AttributeError(f"module 'wasp_cli' has no attribute '{name}'")
    module, attribute = _LAZY[name]
    return getattr(import_module(module), attribute)


def __dir__() -> list[str]:
    return sorted(__all__)
