"""A package of somebody else, found by its entry points in this process."""

import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from wasp_cli import registry
from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import OPERATORS
from wasp_cli.plan import grid, keys, source, syntax
from wasp_cli.spec import hints, model
from wasp_cli.stages.registry import STAGES


def forget(package: str = "") -> None:
    """What was read of sources, of a package, and of the registries that it adds to."""
    for name in [name for name in sys.modules if name.partition(".")[0] == package]:
        del sys.modules[name]
    importlib.invalidate_caches()
    for entries in (METHODS, OPERATORS, STAGES):
        entries._all = None
    for module in (keys, source, syntax, grid, hints, model, registry):
        for value in vars(module).values():
            if hasattr(value, "cache_clear"):
                value.cache_clear()


@contextmanager
def installed(site: Path, package: str) -> Iterator[None]:
    """Nothing is compiled meanwhile: of two versions within a second Python would take the
    first.
    """
    compiles, sys.dont_write_bytecode = sys.dont_write_bytecode, True
    sys.path.insert(0, str(site))
    forget(package)
    try:
        yield
    finally:
        sys.path.remove(str(site))
        sys.dont_write_bytecode = compiles
        forget(package)
