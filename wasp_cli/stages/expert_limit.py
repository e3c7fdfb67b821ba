"""The cost limit of a stored expert, from which limits of later stages may follow (`auto`)."""

from __future__ import annotations

import json
from pathlib import Path

from wasp_cli.errors import ArtifactError

LIMIT_FILE = "limit.json"
LIMIT_SHARE = 0.1  # of the cost of random commands per 1000 env steps
LEAST_LIMIT = 1.0
MOST_LIMIT = 25.0
"""Bounds of a limit that follows from the task. A multiplier follows the excess in units of its
limit, so a limit near 0 would make it jump; 25 is the convention of the benchmark.
"""
ALLOWED_SHARE = 0.1  # of the expert's limit


def chosen_limit(random_rate: float) -> float:
    """Return the cost per 1000 env steps that an expert may have where its limit is `auto`: a tenth
    of that of random commands, within bounds.

    Args:
        random_rate: cost of random commands per 1000 env steps.
    """
    return min(MOST_LIMIT, max(LEAST_LIMIT, LIMIT_SHARE * random_rate))


def chosen_allowance(cost_limit: float) -> float:
    """Return how much more than its teacher a latent policy may always cost, per 1000 env steps,
    where this allowance is `auto`: a tenth of the teacher's cost limit.
    """
    return ALLOWED_SHARE * cost_limit


def expert_limit(expert: Path) -> float:
    """Return the cost per 1000 env steps that an expert was trained to keep.

    Args:
        expert: folder of its artifact.

    Raises:
        ArtifactError: the artifact has no limit that can be read.
    """
    try:
        return float(json.loads((expert / LIMIT_FILE).read_text())["cost_limit"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ArtifactError(
            f"'{expert}' does not say which cost limit its expert has",
            "an older version has made it: write `policies: {cost_allowance: 2.5}` and "
            "`residual: {cost_limit: 25}` by hand, or train the expert again",
        ) from error
