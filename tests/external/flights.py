"""Episodes of a pilot in an external world, alone or assisted, by the closed loop of the
package.
"""

from collections.abc import Sequence

from tests.external.lander import SEEN, Kind
from tests.external.pilots import build
from tests.external.task import LanderTask
from wasp_cli.learning.closed_loop import Loop, run_episodes
from wasp_cli.methods.base import Assistant
from wasp_cli.methods.human import HumanOnly
from wasp_cli.models.state import StateWorld
from wasp_cli.operators.base import Policy
from wasp_cli.seeds import derive

WORLD = StateWorld(SEEN, LanderTask.action_size)


def fly(
    kind: Kind,
    pilot: str,
    expert: Policy,
    assistant: Assistant,
    worlds: Sequence[int],
    *,
    keep: bool = False,
) -> Loop:
    """Return an episode of a pilot in each of the worlds (seeds [B]); `keep` the states too."""
    operator = build(
        kind, pilot, expert, [derive("external-pilot", kind, world) for world in worlds]
    )
    methods = [derive("external-assistant", kind, world) for world in worlds]
    task = LanderTask(kind, len(worlds))
    return run_episodes(task, WORLD, operator, assistant, list(worlds), methods, keep_latents=keep)


def alone(
    kind: Kind, pilot: str, expert: Policy, worlds: Sequence[int], *, keep: bool = False
) -> Loop:
    return fly(kind, pilot, expert, HumanOnly(), worlds, keep=keep)
