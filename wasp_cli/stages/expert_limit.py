"""The cost limit of a stored expert, from which limits of later stages may follow (`auto`)."""

from __future__ import annotations

import json
from pathlib import Path

from wasp_cli.errors import ArtifactError

LIMIT_FILE = "limit.json"


def expert_limit(expert: Path) -> float:
    """Return the cost per 1000 env steps that an expert was trained to keep.

    Args:
        expert: folder of its artifact.

    Raises:
        ArtifactError: it does not say.
    """
    try:
        return float(json.loads((expert / LIMIT_FILE).read_text())["cost_limit"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ArtifactError(
            f"'{expert}' does not say which cost limit its expert has",
            "an older version has made it: write `policies: {cost_allowance: 2.5}` and "
            "`residual: {cost_limit: 25}` by hand, or train the expert again",
        ) from error
