"""Plays the cell of a stored episode again and gathers what a video shows, including all that was
imagined at each decision.

That is the latents along rollouts of the commands alone and of a correction, and where these lead
on the map; `methods.wasp.imagine` keeps only the returns of such rollouts. A latent has no
position, but the robot's movement can be read out of it: by a ridge regression from the features of
a latent to the displacement of the robot in the decision before it, in the robot's frame before
that decision.

B = episodes side by side, T, N = decisions, A = action size, F = features, S = sequences (alone,
corrected), M = rollouts, H = horizon, L = residual steps.
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
from wasp_cli.learning.sampling import generator, gumbel
from wasp_cli.models.base import Latent
from wasp_cli.models.policy import load_skills
from wasp_cli.models.world_model import SafetyWorldModel, load_world_model
from wasp_cli.operators.base import (
    DrawnNoise,
    EpisodeNoise,
    NoiseSource,
    Operator,
    OperatorContext,
    Policy,
    build_operator,
)
from wasp_cli.operators.clones import PlacedClone, placed
from wasp_cli.operators.person import PersonOperator
from wasp_cli.operators.registry import PERSON
from wasp_cli.stages.evaluate import EvaluateStage
from wasp_cli.tasks.base import Floats, Pixels, VectorTask
from wasp_cli.tasks.camera.appearance import Appearance, HasScene, Scene
from wasp_cli.tasks.frames import wrapped
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.pictures import picture_of
from wasp_cli.video.map import poses_of
from wasp_cli.video.picture import asking_for_pictures

ROLLOUTS = 6  # M: enough to show how far imagined futures differ
STRENGTHS = (1.0, 10.0, 100.0, 1000.0, 10000.0)  # of the penalty, chosen by cross-validation
FOLDS = 3
# parts of consecutive decisions in which an episode is divided if it is alone: neighbouring
# decisions are too similar to be in different folds
PARTS = 6


class RolloutStart(NamedTuple):
    """Where imagined rollouts begin: a decision with its latent, command and corrections."""

    t: int
    latent: Latent  # [1, .] filtered
    a_h: NDArray[np.float32]  # [A]
    # who goes on, forked right after the command: S * M rows, sequence after sequence
    operator: Operator
    # [S, L, A]: the first sequence is that of the commands alone, all zero
    residuals: NDArray[np.float32]


class ImaginedTrajectories(NamedTuple):
    """What was imagined from a `RolloutStart`."""

    features: NDArray[np.float32]  # [S, M, H, F] of the arrived latents
    # [S, H] probability of a cost at the arrived states, mean over the rollouts
    cost: NDArray[np.float32]
    # by imagined step from 1 to H, decoded from the first rollout: images [S, 6, 64, 64] in [0, 1],
    # or vectors [S, size]
    images: dict[int, NDArray[np.float32]]


def rollout_start(
    t: int,
    latent: Latent,
    row: int,
    a_h: NDArray[np.float32],
    operator: Operator,
    residuals: NDArray[np.float32] | None,
    horizon: int,
) -> RolloutStart:
    """Return where the rollouts of decision `t` begin, at row `row` of the batch.

    The sequences share the draws of their rollouts, and the draws depend only on `t`.

    Args:
        t: the decision.
        latent: filtered, [B, .].
        row: of the batch.
        a_h: the command [A].
        operator: who goes on, for all rows.
        residuals: of the correction [L, A]; None if there was none.
        horizon: imagined steps, H.
    """
    # The commands alone, and the correction if there is one.
    sequences = np.zeros((1, 1, len(a_h)), np.float32)
    if residuals is not None:
        nothing = np.zeros((1, *np.shape(residuals)), np.float32)
        sequences = np.concatenate([nothing, residuals[None].astype(np.float32)])
    draws = torch.rand((horizon, ROLLOUTS, operator.draws), generator=generator(2 * t)).repeat(
        1, len(sequences), 1
    )
    forked = operator.fork(torch.tensor([row]), len(draws[0]), DrawnNoise(draws))
    return RolloutStart(t, latent.rows(torch.tensor([row])), a_h, forked, sequences)


def following(expert: Policy, action_size: int, batch: int) -> Operator:
    """Return an operator that commands what the expert would, for `batch` rows: who goes on if the
    assistant imagines the expert after a command.
    """
    return Operator(expert, action_size, DrawnNoise(torch.zeros(0, batch, 0)), batch)


@torch.inference_mode()
def imagine(
    model: SafetyWorldModel,
    start: RolloutStart,
    horizon: int,
    shown: Sequence[int],
    *,
    hold: bool = False,
) -> ImaginedTrajectories:
    """Imagine the sequences of a start over `horizon` steps, and decode the steps in `shown` (from
    1). The same arguments give the same result.

    With `hold` residuals are added to the present command instead of the imagined ones, as the
    paper prints Eq. 13.
    """
    # What all sequences share: the operator's memory and the noise of the world model.
    sequences, steps, _ = start.residuals.shape
    begun = start.operator.snapshot()
    rows = sequences * ROLLOUTS
    device = start.latent.h.device
    noise = (
        gumbel((horizon, ROLLOUTS, model.noise_size), generator(2 * start.t + 1))
        .repeat(1, sequences, 1)
        .to(device)
    )
    # [S * M, L, A]
    residuals = torch.from_numpy(start.residuals).to(device).repeat_interleave(ROLLOUTS, 0)
    now = torch.from_numpy(start.a_h).to(device).expand(rows, -1)
    latent = start.latent.expand_rows(rows)

    # Step by step: the operator's command, the residuals on top of it, the next latent.
    features: list[Tensor] = []
    costs: list[Tensor] = []
    images: dict[int, NDArray[np.float32]] = {}
    for k in range(horizon):
        command = now if k == 0 else start.operator.command(latent.features)
        action = command
        if k < steps:
            base = command
            if hold:
                # The first sequence, of the commands alone, has no residuals.
                base = torch.cat([command[:ROLLOUTS], now[ROLLOUTS:]])
            action = (base + residuals[:, k]).clamp(-1, 1)
        start.operator.observe(action)
        latent = model.imagine(latent, action, noise[k])
        features.append(latent.features)
        costs.append(model.cost(latent).view(sequences, ROLLOUTS).mean(1))
        if k + 1 in shown:
            images[k + 1] = (
                model.decode(latent.rows(torch.arange(sequences) * ROLLOUTS)).cpu().numpy()
            )
    start.operator.restore(begun)
    whole = torch.stack(features, 1).unflatten(0, (sequences, ROLLOUTS))
    return ImaginedTrajectories(whole.cpu().numpy(), torch.stack(costs, 1).cpu().numpy(), images)


@dataclass(frozen=True)
class Readout:
    """A linear map from features [F] to (forward, left, turn): m, m and rad within one decision."""

    mean: Floats  # [F]
    weights: Floats  # [F, 3], of centred features
    offset: Floats  # [3]

    def __call__(self, features: NDArray[Any]) -> Floats:
        """[..., F] to [..., 3]."""
        return np.asarray(
            (np.asarray(features, np.float64) - self.mean) @ self.weights + self.offset
        )


def fit(features: Sequence[NDArray[Any]], moves: Sequence[Floats]) -> Readout:
    """Fit a readout to episodes, features [N_e, F] and moves [N_e, 3] each. The strength of its
    penalty is chosen by cross-validation over episodes.
    """
    # A single episode cannot be left out: it gets the middle strength.
    folds: list[list[int]] = []
    if len(features) > 1:
        folds = [[*range(i, len(features), FOLDS)] for i in range(min(FOLDS, len(features)))]
    errors = np.zeros(len(STRENGTHS))
    for held in folds:
        rest = [e for e in range(len(features)) if e not in held]
        candidates = _ridges(
            np.concatenate([features[e] for e in rest]), np.concatenate([moves[e] for e in rest])
        )
        x = np.concatenate([features[e] for e in held])
        y = np.concatenate([moves[e] for e in held])
        # Forward, left and turn weigh the same, whatever their units.
        errors += [np.nansum(1.0 - explained(candidate(x), y)) for candidate in candidates]
    best = int(np.argmin(errors)) if folds else len(STRENGTHS) // 2
    return _ridges(np.concatenate(features), np.concatenate(moves))[best]


def fit_within(features: NDArray[Any], moves: Floats) -> tuple[Readout | None, Floats]:
    """Fit a readout to one episode, features [N, F] and moves [N, 3].

    Returns:
        The readout, None if the episode is too short; and its R2 [3], where each part of the
            episode is predicted from the others.
    """
    if len(moves) < 2 * PARTS:
        return None, np.full(3, np.nan)
    xs = np.array_split(features, PARTS)
    ys = np.array_split(moves, PARTS)
    predicted = [fit(xs[:i] + xs[i + 1 :], ys[:i] + ys[i + 1 :])(xs[i]) for i in range(PARTS)]
    return fit(xs, ys), explained(np.concatenate(predicted), moves)


def _ridges(features: NDArray[Any], moves: Floats) -> list[Readout]:
    x = np.asarray(features, np.float64)
    mean = x.mean(0)
    scale = x.std(0)
    # Divided by its tiny deviation, a feature that hardly varies would weigh most.
    scale = np.maximum(scale, max(1e-3 * float(scale.max()), 1e-12))
    z = (x - mean) / scale
    offset = moves.mean(0)
    gram = z.T @ z
    right = z.T @ (moves - offset)
    return [
        Readout(
            mean,
            np.linalg.solve(gram + strength * np.eye(len(gram)), right) / scale[:, None],
            offset,
        )
        for strength in STRENGTHS
    ]


def explained(predicted: Floats, true: Floats) -> Floats:
    """Return R2 [3] of displacements [N, 3]; NaN if the true ones do not vary."""
    spread = ((true - true.mean(0)) ** 2).sum(0)
    error = ((predicted - true) ** 2).sum(0)
    return np.asarray(1.0 - np.divide(error, spread, out=np.full(3, np.nan), where=spread > 1e-12))


def displacements(places: Floats) -> Floats:
    """Turn poses [T, 3] (x, y, yaw) into displacements [T - 1, 3]: forward and left in the frame of
    the pose before in m, and turn in rad.
    """
    before = places[:-1]
    after = places[1:]
    way = after[:, :2] - before[:, :2]
    sin = np.sin(before[:, 2])
    cos = np.cos(before[:, 2])
    forward = way[:, 0] * cos + way[:, 1] * sin
    left = way[:, 1] * cos - way[:, 0] * sin
    return np.stack([forward, left, wrapped(after[:, 2] - before[:, 2])], 1)


def integrated(start: Floats, moves: Floats) -> Floats:
    """Turn a pose [3] (x, y, yaw) and displacements [..., H, 3] into places [..., H + 1, 2] in
    m.
    """
    # The yaw before each displacement.
    turns = np.cumsum(moves[..., 2], -1)[..., :-1]
    turned = start[2] + np.concatenate([np.zeros_like(moves[..., :1, 2]), turns], -1)
    cos = np.cos(turned)
    sin = np.sin(turned)
    steps = np.stack(
        [moves[..., 0] * cos - moves[..., 1] * sin, moves[..., 0] * sin + moves[..., 1] * cos], -1
    )
    begun = np.broadcast_to(start[:2], (*moves.shape[:-2], 1, 2))
    return np.concatenate([begun, start[:2] + np.cumsum(steps, -2)], -2)


Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class Source:
    """What a cell is played again with: its task and operator, the recorded rows, and the
    models.
    """

    task: str
    action_repeat: int
    seed: int
    operator: str
    value: float | None  # severity of the operator
    recorded: Recorded
    world_model: Path
    policies: Path
    threads: int = 1  # of the simulator; they change nothing
    # its privileged policies are those of operators that know more than assistants perceive; None:
    # they do not
    expert: Path | None = None
    clone: Path | None = None  # of the person in whose place an operator drove
    alone: bool = False
    """Whether the episode is played without the others of its batch. Matrix products round
    differently with another number of rows, so the operator issues the recorded commands, and
    imagines from nearly the same memory.
    """
    # whether the assistant imagines that the expert goes on after a command, not the operator
    expert_goes_on: bool = False

    def world(self) -> VectorTask:
        """Return the task with a row for each recorded episode, and pictures of itself if it draws
        any.
        """
        shown = (*observed(self.task), *asking_for_pictures(self.task))
        return make_task(
            self.task,
            len(self.recorded.a),
            action_repeat=self.action_repeat,
            observe=shown,
            threads=self.threads,
        )

    def operator_in(self, world: VectorTask) -> Operator:
        """Return the operator of the cell, with the seeds of its mistakes; for a person, their
        recorded commands.
        """
        batch = len(self.recorded.a)
        if self.operator == PERSON:
            return SaidAgain(self.recorded, world.action_size)
        mistakes = [
            seeds.operator_seed(self.task, self.operator, self.seed, self.recorded.first + row)
            for row in range(batch)
        ]
        informed = None
        if self.expert is not None:
            informed = informed_policies(self.task, {"expert": self.expert})
        context = OperatorContext(
            load_skills(self.policies).at, world.action_size, world.decision_seconds, informed
        )
        with placed(None if self.clone is None else PlacedClone(self.clone)):
            operator = build_operator(
                self.operator, self.value, context, EpisodeNoise(mistakes), batch
            )
        if self.alone:
            return AsRecorded(operator, self.recorded)
        return operator


class AsRecorded(Operator):
    """An operator that issues the recorded commands. Its memory and its forks go on from the
    commands that it would have issued.

    It only goes forward: a snapshot would not bring the recorded commands back, and no branches are
    played from it.
    """

    def __init__(self, operator: Operator, recorded: Recorded) -> None:
        super().__init__(operator.policy, operator.action_size, operator.noise, operator.batch)
        self._operator = operator
        self._commands = iter(torch.from_numpy(side_by_side(recorded.a_h)))

    @property
    def draws(self) -> int:
        """Random numbers that the operator takes for a decision."""
        return self._operator.draws

    @property
    def knows_more(self) -> bool:
        """Whether the operator knows more than assistants perceive."""
        return self._operator.knows_more

    def command(self, features: Tensor, privileged: Tensor | None = None) -> Tensor:
        """Return the next recorded command [B, A], after the operator has made its own."""
        self._operator.command(features, privileged)
        recorded: Tensor = next(self._commands)
        return recorded

    def observe(self, executed: Tensor) -> None:
        """Tell the operator what was executed [B, A]."""
        self._operator.observe(executed)

    def fork(self, rows: Tensor, copies: int, noise: NoiseSource) -> Operator:
        """Return a fork of the operator itself, whose commands are its own."""
        return self._operator.fork(rows, copies, noise)


class SaidAgain(PersonOperator):
    """A person's recorded commands, one at each decision. In imagination the present command is
    held.
    """

    def __init__(self, recorded: Recorded, action_size: int) -> None:
        nothing = DrawnNoise(torch.zeros(0, len(recorded.a_h), 0))
        super().__init__(
            lambda features: features.new_zeros(len(features), action_size),
            action_size,
            nothing,
            len(recorded.a_h),
        )
        self._commands = iter(torch.from_numpy(side_by_side(recorded.a_h)))

    def command(self, features: Tensor, privileged: Tensor | None = None) -> Tensor:
        """Return the next recorded command [B, A]; in imagination the present one again."""
        if not self.imagined:
            self.say(next(self._commands))
        return super().command(features, privileged)


@contextmanager
def threads_of_evaluations() -> Iterator[None]:
    """Within the block, torch uses as many threads as in evaluations, since rounding may depend on
    their number.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(getattr(EvaluateStage, "torch_threads", 1))
    try:
        yield
    finally:
        torch.set_num_threads(before)


class PlayedDecision(NamedTuple):
    """What is shown of one decision of the episode."""

    start: RolloutStart
    seen: NDArray[Any]  # [6, 64, 64] what the cameras saw, or the vector [size]
    # decoded from the filtered latent: [6, 64, 64] in [0, 1], or a vector
    decoded: NDArray[np.float32]
    scene: Scene | None  # of one row; None of a task without a map
    picture: Pixels | None = None  # [H, W, 3] what the task draws of itself, where it does


class PlayedEpisode(NamedTuple):
    """What is shown of an episode that was played again."""

    model: SafetyWorldModel
    world: VectorTask
    appearance: Appearance | None
    decisions: list[PlayedDecision]  # in order; the decisions that are shown
    places: Floats  # [T, 2] of the robot before every decision; [0, 2] of a task without a map
    # fitted to the other episodes, or to this one where it is alone; None where it is too short, or
    # without a map
    readout: Readout | None
    explained: Floats  # [3] its R2 of the displacements of this episode: forward, left, turn
    states: Floats  # [T, size] the vectors of the episode; [0, 0] of a task with cameras


@threads_of_evaluations()
def play_episode(
    source: Source,
    episode: int,
    residuals: Sequence[NDArray[Any] | None],
    shown: Collection[int],
    horizon: int,
    progress: Progress,
) -> PlayedEpisode:
    """Play a cell again, and keep what is shown of one of its episodes.

    Args:
        source: the cell.
        episode: row of the episode in the batch.
        residuals: T corrections [L, A]; None where the command was not changed.
        shown: decisions that are kept.
        horizon: imagined steps, H.
        progress: gets the share that is done, and words.

    Raises:
        ArtifactError: the cell comes out differently.
    """
    # The world, the model, and who goes on in imagination.
    world = source.world()
    model = load_world_model(source.world_model)
    appearance = world.appearance() if isinstance(world, HasScene) else None
    rerun = Rerun(world, model, source.operator_in(world), source.recorded)
    everyone = np.arange(world.batch)
    length = int(rerun.lengths[episode])
    follower = rerun.operator
    if source.expert_goes_on:
        follower = following(load_skills(source.policies).expert, world.action_size, world.batch)

    features: list[NDArray[np.float32]] = []
    poses: list[Floats] = []
    decisions: list[PlayedDecision] = []
    states: list[Floats] = []
    for moment in rerun:
        t = moment.t

        # Of all episodes, what the readout is fitted to.
        if appearance is not None and isinstance(world, HasScene):
            poses.append(poses_of(appearance, world.scene(everyone)))
            features.append(moment.latent.features.numpy().copy())

        # Of this episode, what is shown.
        seen = getattr(moment.seen, model.reads)[episode].copy()
        if model.reads == "state" and t < length:
            states.append(seen)
        if t in shown and t < length:
            begun = rollout_start(
                t,
                moment.latent,
                episode,
                moment.a_h[episode].numpy().copy(),
                follower,
                residuals[t],
                horizon,
            )
            with torch.inference_mode():
                decoded = model.decode(begun.latent)[0].numpy()
            scene = world.scene(np.array([episode])) if isinstance(world, HasScene) else None
            picture = picture_of(world, episode)
            decisions.append(PlayedDecision(begun, seen, decoded, scene, picture))
        if t % 25 == 0:
            progress((t + 1) / int(rerun.lengths.max()), f"playing decision {t + 1}")
    places = np.stack(poses)[:length, episode, :2] if poses else np.zeros((0, 2))
    return PlayedEpisode(
        model,
        world,
        appearance,
        decisions,
        places,
        *_read_out(features, poses, rerun.lengths, episode),
        np.array(states) if states else np.zeros((0, 0)),
    )


def _read_out(
    features: list[NDArray[np.float32]],
    poses: list[Floats],
    lengths: NDArray[np.int64],
    episode: int,
) -> tuple[Readout | None, Floats]:
    """A readout that is fitted to the other episodes, and its R2 [3] on this one. If the episode is
    alone, it is fitted to its parts.
    """
    if not poses:
        return None, np.full(3, np.nan)
    # [T, B, .]
    latents = np.stack(features)
    places = np.stack(poses)
    # The latent that has arrived at t, and the way from t - 1 to t.
    arrived = [latents[1:length, e] for e, length in enumerate(lengths)]
    moved = [displacements(places[:length, e]) for e, length in enumerate(lengths)]
    others = [e for e in range(len(lengths)) if e != episode and len(moved[e])]
    if not others:
        return fit_within(arrived[episode], moved[episode])
    readout = fit([arrived[e] for e in others], [moved[e] for e in others])
    return readout, explained(readout(arrived[episode]), moved[episode])
