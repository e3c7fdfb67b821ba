"""What a video of a stored episode shows, gathered while its cell is played again: scenes, images, latents, and starts of rollouts.

B = episodes side by side, T = decisions of the episode, A = action size, F = features, L = residual steps.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wasp_cli import seeds
from wasp_cli.learning.informed import informed_policies, observed
from wasp_cli.learning.playback import side_by_side
from wasp_cli.learning.rerun import Recorded, Rerun
from wasp_cli.models.policy import load_skills
from wasp_cli.models.world_model import SafetyWorldModel, load_world_model
from wasp_cli.operators.base import DrawnNoise, EpisodeNoise, NoiseSource, Operator, OperatorContext, build_operator
from wasp_cli.operators.clones import PlacedClone, placed
from wasp_cli.operators.person import PersonOperator
from wasp_cli.operators.registry import PERSON
from wasp_cli.stages.evaluate import EvaluateStage
from wasp_cli.tasks.base import Floats, Pixels, VectorTask
from wasp_cli.tasks.camera.appearance import Appearance, HasScene, Scene
from wasp_cli.tasks.make import make_task
from wasp_cli.video.imagined import Readout, RolloutStart, displacements, fit, fit_within, following, rollout_start

Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class Source:
    """The episodes of a stored cell that met side by side, and the models that they were evaluated with."""

    task: str
    action_repeat: int
    seed: int
    operator: str
    value: float | None  # severity of the operator
    recorded: Recorded
    world_model: Path
    policies: Path
    threads: int = 1  # of the simulator; they change nothing
    first: int = 0  # number of the first of the episodes within their cell
    expert: Path | None = None  # whose privileged policies operators follow who know more than assistants perceive; None: they do not
    clone: Path | None = None  # of the person in whose place an operator drove
    rounded: bool = False
    """the models are published in half precision: the operator says what was recorded, and imagines from nearly the same memory"""
    expert_goes_on: bool = False  # the assistant imagines the expert behind every command, not the operator

    def world(self) -> VectorTask:
        """Build the task as the cell was evaluated in."""
        shown = observed(self.task)
        return make_task(self.task, len(self.recorded.a), action_repeat=self.action_repeat, observe=shown, threads=self.threads)

    def operator_in(self, world: VectorTask) -> Operator:
        """Build the operator of the cell, fresh."""
        batch = len(self.recorded.a)
        if self.operator == PERSON:
            return SaidAgain(self.recorded, world.action_size)
        mistakes = [seeds.operator_seed(self.task, self.operator, self.seed, self.first + row) for row in range(batch)]
        informed = None if self.expert is None else informed_policies(self.task, {"expert": self.expert})
        context = OperatorContext(load_skills(self.policies).at, world.action_size, world.decision_seconds, informed)
        with placed(None if self.clone is None else PlacedClone(self.clone)):
            operator = build_operator(self.operator, self.value, context, EpisodeNoise(mistakes), batch)
        return AsRecorded(operator, self.recorded) if self.rounded else operator


class AsRecorded(Operator):
    """An operator whose commands are the recorded ones; its memory and its forks go on from those that it would have issued.

    It goes forward only: a snapshot would not bring the recorded commands back, and no branches are played from it.
    """

    def __init__(self, operator: Operator, recorded: Recorded) -> None:
        super().__init__(operator.policy, operator.action_size, operator.noise, operator.batch)
        self._operator = operator
        self._commands = iter(torch.from_numpy(side_by_side(recorded.a_h)))

    @property
    def draws(self) -> int:
        return self._operator.draws

    @property
    def knows_more(self) -> bool:
        return self._operator.knows_more

    def command(self, features: Tensor, privileged: Tensor | None = None) -> Tensor:
        self._operator.command(features, privileged)
        recorded: Tensor = next(self._commands)
        return recorded

    def observe(self, executed: Tensor) -> None:
        self._operator.observe(executed)

    def fork(self, rows: Tensor, copies: int, noise: NoiseSource) -> Operator:
        return self._operator.fork(rows, copies, noise)


class SaidAgain(PersonOperator):
    """A person's recorded commands, decision by decision; imagined, the command of now is held."""

    def __init__(self, recorded: Recorded, action_size: int) -> None:
        nothing = DrawnNoise(torch.zeros(0, len(recorded.a_h), 0))
        super().__init__(lambda features: features.new_zeros(len(features), action_size), action_size, nothing, len(recorded.a_h))
        self._commands = iter(torch.from_numpy(side_by_side(recorded.a_h)))

    def command(self, features: Tensor, privileged: Tensor | None = None) -> Tensor:
        if not self.imagined:
            self.say(next(self._commands))
        return super().command(features, privileged)


@contextmanager
def threads_of_evaluations() -> Iterator[None]:
    """Let matrix products use as many threads meanwhile as in evaluations: rounding may depend on them."""
    before = torch.get_num_threads()
    torch.set_num_threads(getattr(EvaluateStage, "torch_threads", 1))
    try:
        yield
    finally:
        torch.set_num_threads(before)


class PlayedDecision(NamedTuple):
    """What there is to show of one decision."""

    start: RolloutStart
    pixels: Pixels  # [6, 64, 64] what the cameras saw
    decoded: NDArray[np.float32]  # [6, 64, 64] in [0, 1]: what the filtered latent remembers of it
    scene: Scene | None  # of one row; None of a task without a map
    pose: Floats | None  # [3] x, y and yaw of the robot's front


class PlayedEpisode(NamedTuple):
    """A stored episode played again, ready to be drawn."""

    model: SafetyWorldModel
    world: VectorTask
    appearance: Appearance | None
    cameras: int
    decisions: list[PlayedDecision]  # in order; the decisions that are shown
    places: Floats  # [T, 2] of the robot before every decision; [0, 2] of a task without a map
    readout: Readout | None  # fitted to the other episodes, or to this one where it is alone; None where it is too short, or without a map
    explained: Floats  # [3] its R2 of the displacements of this episode: forward, left, turn


@threads_of_evaluations()
def play_episode(
    source: Source, episode: int, residuals: Sequence[NDArray[Any] | None], shown: Collection[int], horizon: int, progress: Progress
) -> PlayedEpisode:
    """Play a cell again and keep what is shown of one row of its episodes, with T corrections [L, A], None where the command stood."""
    world, model = source.world(), load_world_model(source.world_model)
    appearance = world.appearance() if isinstance(world, HasScene) else None
    rerun = Rerun(world, model, source.operator_in(world), source.recorded)
    everyone, length = np.arange(world.batch), int(rerun.lengths[episode])
    follower = rerun.operator
    if source.expert_goes_on:
        follower = following(load_skills(source.policies).expert, world.action_size, world.batch)
    features: list[NDArray[np.float32]] = []
    poses: list[Floats] = []
    decisions: list[PlayedDecision] = []
    for moment in rerun:
        t = moment.t
        if appearance is not None and isinstance(world, HasScene):
            poses.append(poses_of(appearance, world.scene(everyone)))
            features.append(moment.latent.features.numpy().copy())
        if t in shown and t < length:
            assert moment.seen.pixels is not None
            begun = rollout_start(t, moment.latent, episode, moment.a_h[episode].numpy().copy(), follower, residuals[t], horizon)
            with torch.inference_mode():
                decoded = model.decode(begun.latent)[0].numpy()
            scene = world.scene(np.array([episode])) if isinstance(world, HasScene) else None
            pose = poses[-1][episode] if poses else None
            decisions.append(PlayedDecision(begun, moment.seen.pixels[episode].copy(), decoded, scene, pose))
        if t % 25 == 0:
            progress((t + 1) / int(rerun.lengths.max()), f"playing decision {t + 1}")
    places = np.stack(poses)[:length, episode, :2] if poses else np.zeros((0, 2))
    readout, explained = _read_out(features, poses, rerun.lengths, episode)
    return PlayedEpisode(model, world, appearance, getattr(world, "cameras", 2), decisions, places, readout, explained)


def poses_of(appearance: Appearance, scene: Scene) -> Floats:
    """Return x, y and yaw of the robots' fronts, [B, 3]."""
    front = scene.rotation[:, :2, :2] @ np.array(appearance.forward)
    return np.concatenate([scene.position[:, :2], np.arctan2(front[:, 1], front[:, 0])[:, None]], 1)


def _read_out(
    features: list[NDArray[np.float32]], poses: list[Floats], lengths: NDArray[np.int64], episode: int
) -> tuple[Readout | None, Floats]:
    """A readout from the other episodes and its R2 on this one; of an episode that is alone, from its parts."""
    if not poses:
        return None, np.full(3, np.nan)
    seen, places = np.stack(features), np.stack(poses)  # [T, B, .]
    # The latent that has arrived at t, and the way from t - 1 to t.
    arrived = [seen[1:length, e] for e, length in enumerate(lengths)]
    moved = [displacements(places[:length, e]) for e, length in enumerate(lengths)]
    others = [e for e in range(len(lengths)) if e != episode and len(moved[e])]
    if not others:
        return fit_within(arrived[episode], moved[episode])
    readout = fit([arrived[e] for e in others], [moved[e] for e in others])
    return readout, readout.explained(arrived[episode], moved[episode])
