"""What the assistant imagines, as lines on the map: where the command alone leads, and where its correction does."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import torch
from torch import Tensor

from wasp_cli import seeds
from wasp_cli.learning.closed_loop import Filter
from wasp_cli.methods.base import Assistant, Decision, Parts
from wasp_cli.methods.configs import PrintedConfig, WASPConfig
from wasp_cli.metrics.episode import INTERVENED
from wasp_cli.models.base import Latent
from wasp_cli.operators.base import Operator
from wasp_cli.tasks.base import Floats, VectorTask
from wasp_cli.tasks.camera.appearance import HasScene
from wasp_cli.tasks.make import make_task
from wasp_cli.video.imagined import Readout, displacements, fit, following, imagine, integrated, rollout_start
from wasp_cli.video.replay import HORIZON
from wasp_cli.video.trace import poses_of

WORLDS, DECISIONS = 6, 50
"""Of the expert's drive from which displacements are read out of latents."""
ROLE = "drive-readout"


class Futures:
    """See the module. It is never waited for: where there is no time left before the next decision, nothing is drawn."""

    def __init__(self, task: str, parts: Parts, assistant: Assistant, world: VectorTask) -> None:
        self._model = parts.world_model
        self._readout = _readout(task, parts, world)
        config: Any = getattr(assistant, "config", None)
        self._horizon = int(getattr(config, "horizon", HORIZON))
        self._hold = isinstance(config, PrintedConfig)
        self._expert: Operator | None = None
        if isinstance(config, WASPConfig):
            self._expert = following(parts.skills.expert, world.action_size, 1)
        self._seconds = 0.0

    def lines(
        self, t: int, latent: Latent, a_h: Tensor, operator: Operator, decision: Decision, robot: list[float] | None, seconds: float
    ) -> dict[str, Any] | None:
        """Imagine a decision, and return lines of [x, y] in m by name: `alone`, and `corrected` where there was a correction.

        `a_h` is [1, A]; `robot` is [x, y, direction]; None is returned where `seconds` was not enough before.
        """
        if self._readout is None or robot is None or seconds < self._seconds:
            # What takes long once, while other work disturbs it, is tried again later.
            self._seconds *= 0.95
            return None
        begun = time.monotonic()
        with torch.inference_mode():
            residuals = _correction(a_h, decision)
            start = rollout_start(t, latent, 0, a_h[0].cpu().numpy(), self._expert or operator, residuals, self._horizon)
            found = imagine(self._model, start, self._horizon, (), hold=self._hold)
        ways = [integrated(np.array(robot), self._readout(features[0])) for features in found.features]
        self._seconds = max(time.monotonic() - begun, 0.5 * self._seconds)
        return dict(zip(("alone", "corrected"), [np.round(way, 3).tolist() for way in ways], strict=False))


def _correction(a_h: Tensor, decision: Decision) -> Any:
    """[L, A] residuals of the plan, of a method without plans of the one action; None where the command stood."""
    if decision.planned is not None:
        chosen = decision.planned.residuals[0].cpu().numpy()
        return chosen if np.isfinite(chosen).all() and np.abs(chosen).max() > 0 else None
    residual = (decision.action - a_h).cpu().numpy()
    return residual if np.abs(residual).max() > INTERVENED else None


def _readout(task: str, parts: Parts, world: VectorTask) -> Readout | None:
    """Fit displacements of the robot to latents on a short drive of the expert; None of a task without a map."""
    if not isinstance(world, HasScene):
        return None
    worlds = make_task(task, WORLDS, action_repeat=world.action_repeat, observe=("pixels",))
    assert isinstance(worlds, HasScene)
    filter_ = Filter(parts.world_model, WORLDS)
    seen = worlds.reset([seeds.derive(ROLE, task, row) for row in range(WORLDS)])
    first, everyone = torch.ones(WORLDS), np.arange(WORLDS)
    features: list[Any] = []
    poses: list[Floats] = []
    with torch.inference_mode():
        for _ in range(DECISIONS):
            latent = filter_.see(seen, first)
            features.append(latent.features.cpu().numpy().copy())
            poses.append(poses_of(worlds.appearance(), worlds.scene(everyone)))
            action = parts.skills.expert(latent.features).clamp(-1, 1)
            filter_.executed(action)
            step = worlds.step(action.cpu().numpy())
            seen, first = step.observation, torch.zeros(WORLDS)
            if step.ended.any():
                break
    arrived, places = np.stack(features)[1:], np.stack(poses)
    return fit([arrived[:, row] for row in range(WORLDS)], [displacements(places[:, row]) for row in range(WORLDS)])
