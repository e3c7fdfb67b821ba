"""Clone: a policy fitted to what a person commanded. `wasp clone` makes it (see `drive.clone`
for its files); a run only reads it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wasp_cli.errors import UsageError
from wasp_cli.learning.configs.latent import CloneConfig
from wasp_cli.stages.base import Job


class CloneStage:
    """See the module. One for every participant."""

    kind = "clone"
    config = CloneConfig
    settings = ("action_repeat",)
    needs: tuple[str, ...] = ("world_model", "policies")

    def run(self, job: Job) -> Mapping[str, Any]:
        """Raise UsageError: a command makes this artifact, and it is not there."""
        number = f"{job.axes['value']:g}"
        raise UsageError(
            f"nobody has cloned participant {number}", f"wasp clone RESULTS --participant {number}"
        )
