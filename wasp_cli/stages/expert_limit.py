"""The cost limit of a stored expert, from which limits of later stages may follow (`auto`)."""

from __future__ import annotations

import json
from pathlib import Path

from wasp_cli.errors import ArtifactError

LIMIT_FILE = "limit.json"
LIMIT_SHARE = 0.1  # of the cost of random commands per 1000 env steps
LEAST_LIMIT = 1.0
MOST_LIMIT = 25.0
"""Of a limit that follows from the task: a multiplier follows the excess in units of its limit, so
that one near 0 would throw it about; 25 is the benchmark's convention.
"""
ALLOWED_SHARE = 0.1  # of the expert's limit


def chosen_limit(random_rate: float) -> float:
    """Return the cost per 1000 env steps that an expert may have where its limit is `auto`: a tenth
    of `random_rate`, the cost rate of random commands, within bounds.
    """
    return min(MOST_LIMIT, max(LEAST_LIMIT, LIMIT_SHARE * random_rate))


def chosen_allowance(cost_limit: float) -> float:
    """Return the cost per 1000 env steps above that of its teacher which a latent policy is always
    allowed where that is `auto`: a tenth of the teacher's limit.
    """
    return ALLOWED_SHARE * cost_limit


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
