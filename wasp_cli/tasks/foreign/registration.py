"""How an environment is registered, as a text for keys: it differs where the registration does.

Arguments of a registration decide results as much as source code does. Two arguments have the same
text only if they are equal. An argument of which that cannot be said is an error, since a result
could otherwise be taken for that of another environment.
"""

from __future__ import annotations

import functools
import hashlib
import json
import math
import types
from collections.abc import Container, Iterable, Mapping, Set
from typing import Any

import numpy as np
from gymnasium.envs.registration import EnvSpec

from wasp_cli.errors import TaskError

PLAIN = bool | int | str | bytes | None
DEEPEST = 40
"""Levels of objects within objects; more are taken for an object that holds itself."""


def registration_text(spec: EnvSpec, without: Container[str] = ()) -> str:
    """Return what an environment is made with, as text: its arguments, and its wrappers with
    theirs.

    Args:
        spec: its registration.
        without: modules whose wrappers are left out.

    Raises:
        TaskError: an argument cannot be told apart from others of its type.
    """
    arguments = []
    for name in sorted(spec.kwargs):
        arguments.append(f"({name!r}, {argument_text(name, spec.kwargs[name])})")
    wrappers = []
    for wrapper in spec.additional_wrappers:
        if wrapper.entry_point.partition(":")[0] in without:
            continue
        values = wrapper.kwargs or {}
        texts = [f"{name!r}: {argument_text(name, value)}" for name, value in values.items()]
        shown = "None" if wrapper.kwargs is None else "{" + ", ".join(texts) + "}"
        wrappers.append(f"({wrapper.entry_point!r}, {shown})")
    text = f"[{', '.join(arguments)}] [{', '.join(wrappers)}]"
    if not _is_named(spec.entry_point):
        text += f" {argument_text('entry_point', spec.entry_point)}"
    return text


def argument_text(name: str, value: object) -> str:
    """Return an argument as text: small plain values as Python writes them, others by a digest.

    Args:
        name: what it is called, for messages.
        value: the argument.
    """
    try:
        described = _described(value, 0)
    except (TypeError, ValueError, AttributeError, RecursionError) as error:
        raise TaskError(
            f"its registration has an argument '{name}' of type {type(value).__name__}, which "
            f"cannot be told apart from another one: {error}",
            "pass numbers, texts, lists, dictionaries or arrays, or the name of a file that the "
            "environment lists in `assets`",
        ) from error
    if _is_small(value):
        return repr(value)
    digest = hashlib.sha256(json.dumps(described).encode()).hexdigest()[:20]
    return f"<{type(value).__name__} {digest}>"


def _is_named(entry_point: object) -> bool:
    """Whether an entry point is all in the source, which keys cover: an import string, a class, a
    function.
    """
    if isinstance(entry_point, str | type | None):
        return True
    return isinstance(entry_point, types.FunctionType) and entry_point.__closure__ is None


def _is_small(value: object) -> bool:
    """Whether Python's own text of a value says all of it."""
    if isinstance(value, PLAIN | float):
        return True
    if isinstance(value, list | tuple) and type(value) in (list, tuple):
        return all(map(_is_small, value))
    if type(value) is dict:
        return all(_is_small(key) and _is_small(item) for key, item in value.items())
    return False


def _described(value: Any, depth: int) -> Any:
    """Return JSON values that are equal for equal arguments alone.

    Raises:
        TypeError: an object does not say what it consists of.
    """
    if depth > DEEPEST:
        raise TypeError("it holds itself, or too much")
    if isinstance(value, PLAIN):
        return [type(value).__name__, repr(value)]
    if isinstance(value, float):
        return ["float", value.hex() if math.isfinite(value) else repr(value)]
    if isinstance(value, np.ndarray | np.generic):
        return _array(np.asarray(value), depth)
    if isinstance(value, Mapping):
        pairs = [
            [_described(key, depth + 1), _described(item, depth + 1)] for key, item in value.items()
        ]
        return [_named(type(value)), sorted(pairs, key=json.dumps)]
    if isinstance(value, Set):
        items = [_described(item, depth + 1) for item in value]
        return [_named(type(value)), sorted(items, key=json.dumps)]
    if isinstance(value, list | tuple):
        return [_named(type(value)), [_described(item, depth + 1) for item in value]]
    if isinstance(value, type | types.BuiltinFunctionType | types.ModuleType):
        return ["named", _named(value)]
    if isinstance(value, types.FunctionType):
        return _function(value, depth)
    if isinstance(value, types.MethodType):
        return ["method", value.__name__, _described(value.__self__, depth + 1)]
    if isinstance(value, functools.partial):
        parts = (value.func, value.args, value.keywords)
        return ["partial", *(_described(part, depth + 1) for part in parts)]
    return _object(value, depth)


def _array(array: np.ndarray[Any, Any], depth: int) -> Any:
    if array.dtype.hasobject:
        return ["array", list(array.shape), _described(array.tolist(), depth + 1)]
    content = hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()
    return ["array", str(array.dtype), list(array.shape), content]


def _function(function: types.FunctionType, depth: int) -> Any:
    """A function is named: its source is in the key. What it was made with is not."""
    cells = [cell.cell_contents for cell in function.__closure__ or ()]
    made_with = (cells, function.__defaults__, function.__kwdefaults__)
    return ["function", _named(function), *(_described(part, depth + 1) for part in made_with)]


def _object(value: Any, depth: int) -> Any:
    """An object by what pickle would take to make it again."""
    reduced = value.__reduce_ex__(4)
    if isinstance(reduced, str):
        return ["global", _named(type(value)), reduced]
    made, arguments, *rest = reduced
    state = [list(part) if _is_iterator(part) else part for part in rest]
    parts = (made, arguments, state)
    return [_named(type(value)), *(_described(part, depth + 1) for part in parts)]


def _is_iterator(part: object) -> bool:
    return isinstance(part, Iterable) and hasattr(part, "__next__")


def _named(value: Any) -> str:
    module = getattr(value, "__module__", None) or ""
    return f"{module}:{getattr(value, '__qualname__', None) or value.__name__}"
