"""What tests of assistants in somebody's own loop share: evaluations of the real stage to compare
with, and a store with an assistant of somebody else's environment.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from tests.commands import ROOT
from wasp_cli import seeds
from wasp_cli.learning.configs import EvaluateConfig, ReturnsConfig
from wasp_cli.notebook.assistant import LoadedAssistant
from wasp_cli.report.explain.episode import GATES
from wasp_cli.stages.base import Job
from wasp_cli.stages.evaluate import EvaluateStage
from wasp_cli.store.artifact import commit, staging_folder
from wasp_cli.store.layout import Layout
from wasp_cli.store.recorded import read_recorded
from wasp_cli.store.tables import read_steps
from wasp_cli.tasks.goal.task import Goal
from wasp_cli.tasks.race.task import Race

PUBLISHED = ROOT / "results" / "published"
PUDDLE = "puddle:Puddle-v0"
"""The example of docs/own_task.md, which stands for somebody else's environment."""
REPEAT = 4


@contextmanager
def short_episodes(decisions: int) -> Iterator[None]:
    """Episodes of our tasks end after so many decisions, for whoever makes them."""
    with pytest.MonkeyPatch.context() as patch:
        for task in (Goal, Race):
            patch.setattr(task, "num_steps", REPEAT * decisions)
        yield


class Episodes(NamedTuple):
    """What B episodes were, each of its own length."""

    a_h: list[Any]  # [T, A] float32 commands within the bounds
    a: list[Any]  # [T, A] float32 executed actions
    reward: list[Any]  # [T] float32
    gate: list[list[str]]
    predicted: list[Any]  # [T] float32 cost; NaN where it is undefined

    def require_same(self, other: "Episodes") -> None:
        """The same to the bit."""
        assert len(self.a) == len(other.a)
        for e in range(len(self.a)):
            assert self.gate[e] == other.gate[e]
            for mine, theirs in ((self.a_h, other.a_h), (self.a, other.a)):
                assert np.array_equal(mine[e], theirs[e])
            assert np.array_equal(self.reward[e], other.reward[e])
            assert np.array_equal(self.predicted[e], other.predicted[e], equal_nan=True)


def evaluated(
    assistant: LoadedAssistant, operator: str, value: float, folder: Path, episodes: int = 1
) -> Episodes:
    """What the stage `evaluate` of `wasp run` records of an assistant, side by side."""
    axes = {
        "method": assistant.method,
        "method_config": dict(assistant.settings),
        "operator": operator,
        "value": value,
    }
    settings = {"action_repeat": REPEAT, "returns": ReturnsConfig(), "side_by_side": episodes}
    config = EvaluateConfig(episodes=episodes)
    inputs = assistant.parts.inputs
    EvaluateStage().run(
        Job("evaluate", assistant.task, 1, config, settings, axes, inputs, folder, folder)
    )
    path = folder / "episodes.parquet"
    recorded, steps = read_recorded(path), read_steps(path)
    ends = np.cumsum([len(actions) for actions in recorded["a"]])[:-1]
    gates = [GATES[code] for code in steps["gate"].to_pylist()]
    predicted = np.split(np.asarray(steps["g_cost"], np.float32), ends)
    bounds = [0, *ends.tolist(), len(gates)]
    return Episodes(
        list(recorded["a_h"]),
        list(recorded["a"]),
        list(recorded["reward"]),
        [gates[begin:end] for begin, end in pairwise(bounds)],
        predicted,
    )


def seeds_of(assistant: LoadedAssistant, operator: str, episode: int) -> tuple[int, int, int]:
    """Of the world, of the operator's mistakes and of the assistant, as in evaluations."""
    return (
        seeds.layout_seed(assistant.task, 1, episode),
        seeds.operator_seed(assistant.task, operator, 1, episode),
        seeds.method_seed(assistant.task, operator, 1, episode, assistant.method),
    )


def puddle_assistant(
    artifacts: Mapping[str, Path],
    results: Path,
    method: str = "ida",
    needs: tuple[str, ...] = ("world_model", "policies", "ida_q", "calibration"),
    config: Mapping[str, Any] | None = None,
    seed: int = 0,
    cell: bool = True,
    task: str = PUDDLE,
    environment: Mapping[str, Any] | None = None,
) -> Mapping[str, str]:
    """Store an assistant of Puddle, or of a declared environment, of tiny untrained models; returns
    keys by kind.
    """
    layout = Layout(results)
    layout.prepare()
    keys = {kind: f"{i}{seed}".ljust(20, "a") for i, kind in enumerate(needs)}
    settings: dict[str, Any] = {
        "action_repeat": REPEAT,
        "returns": ReturnsConfig().model_dump(mode="json"),
    }
    if environment is not None:
        settings["environment"] = dict(environment)
    axes = {"method": method, "method_config": dict(config or {})}
    shared = {"task": task, "seed": seed, "settings": settings, "provenance": {}}

    def store(kind: str, key: str, source: Path | None, upstream: list[str], **facts: Any) -> None:
        staging = staging_folder(layout, key)
        for path in source.iterdir() if source is not None else ():
            (staging / path.name).write_bytes(path.read_bytes())
        commit(
            layout,
            kind,
            key,
            staging,
            {
                **shared,
                "kind": kind,
                "key": key,
                "label": f"{task} s{seed} {kind}",
                "upstream": {name: keys[name] for name in upstream},
                "upstream_kinds": {name: name for name in upstream},
                **facts,
            },
        )

    models = [kind for kind in needs if kind != "calibration"]
    for kind in needs:
        own = {"axes": axes} if kind == "calibration" else {}
        store(kind, keys[kind], artifacts[kind], models if own else [], **own)
    if cell:
        driven = {**axes, "operator": "noisy", "value": 0.4}
        label = f"{task} s{seed} {method} noisy=0.4"
        store("evaluate", f"e{seed}".ljust(20, "a"), None, list(needs), axes=driven, label=label)
    return keys
