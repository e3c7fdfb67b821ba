"""Cells of tiny untrained models, evaluated by the real stage."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from wasp_cli import seeds
from wasp_cli.learning.configs import EvaluateConfig, ReturnsConfig
from wasp_cli.learning.rerun import Recorded, Rerun
from wasp_cli.models.policy import load_skills
from wasp_cli.models.world_model import load_world_model
from wasp_cli.operators.base import EpisodeNoise, Operator, OperatorContext, build_operator
from wasp_cli.stages.base import Job
from wasp_cli.stages.evaluate import EvaluateStage
from wasp_cli.store.recorded import read_recorded
from wasp_cli.tasks.base import VectorTask
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.race.task import Race

REPEAT, DECISIONS = 20, 10
"""Env steps per decision, and decisions of an episode of race1 that was made short."""
SETTINGS = {"action_repeat": REPEAT, "returns": ReturnsConfig(), "side_by_side": 10}


@contextmanager
def short_episodes() -> Iterator[None]:
    """Episodes of Race end after 200 instead of 500 env steps: physics takes most of the time
    of a cell.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Race, "num_steps", REPEAT * DECISIONS)
        yield


class Evaluated(NamedTuple):
    """A cell, and who drove in it."""

    path: Path
    """its table"""
    task: str
    variant: str
    value: float
    episodes: int
    seed: int
    inputs: Mapping[str, Path]
    summary: Mapping[str, Any]

    def world(self) -> VectorTask:
        """The task as the cell was evaluated in."""
        return make_task(self.task, self.episodes, action_repeat=REPEAT, observe=("pixels",))

    def operator(self, world: VectorTask) -> Operator:
        mistakes = [
            seeds.operator_seed(self.task, self.variant, self.seed, e) for e in range(self.episodes)
        ]
        context = OperatorContext(
            load_skills(self.inputs["policies"]).at, world.action_size, world.decision_seconds
        )
        return build_operator(
            self.variant, self.value, context, EpisodeNoise(mistakes), self.episodes
        )

    def rerun(self, **changes: Any) -> Rerun:
        """What was recorded, carried out again."""
        world, recorded = self.world(), Recorded(**read_recorded(self.path))._replace(**changes)
        return Rerun(
            world, load_world_model(self.inputs["world_model"]), self.operator(world), recorded
        )


def evaluated(
    inputs: Mapping[str, Path],
    folder: Path,
    method: str = "human",
    config: Mapping[str, Any] | None = None,
    variant: str = "noisy",
    value: float = 0.4,
    *,
    task: str = "race1",
    episodes: int = 3,
    seed: int = 0,
    side_by_side: int = 10,
    earlier: Path | None = None,
) -> Evaluated:
    """The cell of a method on `inputs`, see `tests.artifacts`; its table lies in `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    axes = {
        "method": method,
        "method_config": dict(config or {}),
        "operator": variant,
        "value": value,
    }
    settings = {**SETTINGS, "side_by_side": side_by_side}
    own = EvaluateConfig(episodes=episodes)
    summary = EvaluateStage().run(
        Job("evaluate", task, seed, own, settings, axes, inputs, folder, folder, earlier=earlier)
    )
    return Evaluated(
        folder / "episodes.parquet", task, variant, value, episodes, seed, inputs, summary
    )
