"""With which severity the operator of a cell drove, where its spec leaves that open (`auto`).

The axes of such a cell say `auto`, as its key does. The number is chosen by the stage `severity`,
whose artifact the cell reads, and stands in the summary of the cell.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from wasp_cli.errors import ArtifactError
from wasp_cli.metrics.severity import AUTO, FILE

SEVERITY = "severity"
"""The stage, the name under which a node reads its artifact, and a name in the summary of both."""


def with_severity(axes: Mapping[str, Any], inputs: Mapping[str, Path]) -> Mapping[str, Any]:
    """Return the axes of a node as its stage reads them: with the severity that was chosen in the
    place of `auto`.

    Args:
        inputs: the folders of what the node reads, by name.

    Raises:
        ArtifactError: the artifact among the inputs does not say which severity was chosen.
    """
    if axes.get("value") != AUTO:
        return axes
    path = inputs[SEVERITY] / FILE
    try:
        severity = float(json.loads(path.read_text(encoding="utf-8"))["severity"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ArtifactError(f"'{path}' does not say which severity was chosen") from error
    return {**axes, "value": severity}


def is_auto(manifest: Mapping[str, Any]) -> bool:
    """Tell whether the severity of a stored cell, or of its branches, was chosen."""
    axes = manifest.get("axes")
    return isinstance(axes, Mapping) and axes.get("value") == AUTO


def severity_of(manifest: Mapping[str, Any]) -> float | None:
    """Return the number with which the operator of a stored cell, or of its branches, drove; None
    of the unimpaired one.

    Raises:
        KeyError, TypeError, ValueError: the manifest has another form.
    """
    value = manifest["summary"][SEVERITY] if is_auto(manifest) else manifest["axes"]["value"]
    if value is None:
        return None
    number = float(value)
    if not math.isfinite(number):
        raise ValueError("a severity is no number")
    return number


def as_driven(label: str, manifest: Mapping[str, Any]) -> str:
    """Return the label of a node with the severity that was chosen, as reports name its cell."""
    try:
        severity = severity_of(manifest) if is_auto(manifest) else None
    except (KeyError, TypeError, ValueError):
        return label
    return label if severity is None else label.replace(f"={AUTO}", f"={severity:g}")
