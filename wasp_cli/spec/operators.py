"""The spec of `wasp operators`: another spec, narrowed to its operators alone and the unimpaired one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from wasp_cli.spec.load import Loaded, load
from wasp_cli.spec.names import LONGEST


def operators_alone(path: Path, settings: Sequence[str] = ()) -> Loaded:
    """The spec at `path` with the methods Human-only and Expert; its cells are those of the whole spec, with the same keys.

    Raises:
        InvalidSpec: the spec at `path` is not valid, or lists no operators.
        UsageError: a setting is not of the form `a.b=value`.
    """
    whole = load(path, settings)
    if not whole.spec.operators:
        hint = "for example operators: {laggy: {mild: 0.5, moderate: 0.7, severe: 0.85}}"
        raise whole.problem(("operators",), "no operators are listed, so that there is none to measure", hint)
    name = f"operators-{whole.spec.name}"[:LONGEST]
    # Behind the settings, which must not bring back what is left out here.
    return load(path, [*settings, f"name={name}", "methods=[human, expert]", "variants=[full]", "stages=[]"])
