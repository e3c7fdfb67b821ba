"""Modules of one's own, as specs name them (`module:Name`): how people write them, which file of
the current folder is meant, and what is said where another module has its name.
"""

from __future__ import annotations

import os
import re
import sys
from importlib.util import find_spec
from pathlib import Path

from wasp_cli.errors import did_you_mean

NO_LETTER = re.compile(r"[^A-Za-z0-9_]+")


def misspelt(name: str) -> str | None:
    """Return how `module:Name` is written where the part before the colon is a path, or has what
    no name of a module has; None where there is nothing to say.
    """
    written, colon, rest = name.rpartition(":")
    plain = not written.endswith(".py") and all(map(_is_name, written.split(".")))
    if not colon or plain:
        return None
    path = Path(written.replace("\\", "/").removesuffix(".py"))
    if all(map(_is_name, path.parts)):
        return f"write '{'.'.join(path.parts)}:{rest}'"
    module = _name_of(path.name)
    renamed = "" if module == path.name else f"rename '{path.name}.py' to '{module}.py', "
    return f"{renamed}write '{module}:{rest}', and run in the folder that holds '{module}.py'"


def _is_name(text: str) -> bool:
    return text.isidentifier() and text.isascii()


def _name_of(text: str) -> str:
    name = NO_LETTER.sub("_", text).strip("_")
    return name if _is_name(name) else f"my_{name}"


def of_python(module: str) -> tuple[str, str] | None:
    """Return what is said of a module that is Python's own, message and remedy; None of others."""
    top = module.partition(".")[0]
    if not _is_pythons(top):
        return None
    there = _beside(top)
    message = f"'{top}' is a module of Python itself"
    if there is None:
        return message, f"name a module of your own: a file such as {_renamed(top, top)}.py"
    return f"{message}, and hides '{there}'", _renaming(module, there)


def _is_pythons(top: str) -> bool:
    if top != "test":
        return top in sys.stdlib_module_names
    # that list leaves Python's own tests out, and some systems do not install them
    spec = find_spec(top)
    origin = spec.origin if spec is not None else None
    return origin is not None and Path(origin).is_relative_to(Path(os.__file__).parent / top)


def hidden(module: str) -> str | None:
    """Return what to do where an installed module was imported in the place of a file of the
    current folder; None where no file is hidden.
    """
    top = module.partition(".")[0]
    there = _beside(top)
    origin = getattr(sys.modules.get(top), "__file__", None)
    if there is None or origin is None:
        return None
    if Path(origin).resolve().is_relative_to(Path(there).resolve()):
        return None
    return f"'{origin}' is installed and hides '{there}': {_renaming(module, there)}"


def nearby(module: str) -> str:
    """Return what to do about a module that is not there: which one of the current folder may be
    meant, or where to run.
    """
    top, _, rest = module.partition(".")
    files = {path.stem for path in Path().glob("*.py") if _is_name(path.stem)}
    folders = {path.parent.name for path in Path().glob("*/*.py") if _is_name(path.parent.name)}
    otherwise = f"run in the folder that holds '{top}', or install it: pip install -e ."
    if rest and _beside(top) is not None:
        return f"there is no '{module.replace('.', '/')}.py' in '{os.getcwd()}'"
    hint = did_you_mean(top, files | folders, otherwise)
    return hint.replace("did you mean", "did you mean the module")


def _beside(top: str) -> str | None:
    """The file or the folder of the current folder that a module's name means."""
    if Path(f"{top}.py").is_file():
        return f"{top}.py"
    return top if next(Path().glob(f"{top}/*.py"), None) is not None else None


def _renamed(module: str, top: str) -> str:
    return f"my_{top.strip('_')}{module.removeprefix(top)}"


def _renaming(module: str, there: str) -> str:
    top = module.partition(".")[0]
    new = _renamed(module, top)
    return f"rename '{there}' to '{_renamed(there, top)}', and write '{new}' before the colon"
