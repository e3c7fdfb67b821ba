"""CSA's consistency model: a teacher learns the expert's actions at recorded latents, and its
probability flow is distilled into one step.

After Sun et al. 2025 (FlashBack) and the authors' configurations: the teacher is a diffusion model
as in Karras et al. 2022, the student is made consistent along the teacher's flow, dx / dsigma = (x
- D(x, sigma)) / sigma, solved by one step of Heun between neighbouring levels (Song et al. 2023,
Algorithm 2). K decisions of held-out episodes, B rows of a batch, A components of an action, F
features.

What differs from the authors' code: the student starts as the teacher, and is its own target
without a gradient (theirs follows the student at a rate that falls from .999 to .37); the teacher's
loss is weighted by level as in Karras et al., not by a learned weight; both are conditioned on the
latent features instead of the state. Theirs has a second condition in half of the loss: the
direction in which the command moves the state, as a learned forward model predicts it. The paper
calls the variant without this condition CSA, and that with it CSA dagger.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from wasp_cli.learning.configs.consistency import ConsistencyConfig
from wasp_cli.learning.latents import Latents
from wasp_cli.learning.sampling import generator
from wasp_cli.learning.shards import HELD_OUT, Recording
from wasp_cli.models.consistency import (
    SIGMA_DATA,
    SIGMA_MAX,
    SIGMA_MIN,
    Consistency,
    ladder,
    sigma_at,
)

# shares of the ladder: sigma .017, .17, .97 and 11.5; at 0 a command is not changed
RATIOS = (0.1, 0.25, 0.4, 0.69)
LOG_MEAN, LOG_STD = -1.2, 1.6
"""Mean and standard deviation of ln sigma in the training of the teacher: the mean of Karras et
al. 2022, the deviation of the authors' code.
"""

Draw = Callable[[], tuple[Tensor, Tensor]]
"""Returns features [B, F] and clean actions [B, A] of a batch."""
Report = Callable[[float, str], None]


class Averaged(NamedTuple):
    """What a training leaves."""

    model: Consistency  # with the averaged weights
    loss: float  # in the end, smoothed


class Distillation(NamedTuple):
    """A student and its teacher."""

    student: Consistency
    teacher: Consistency
    numbers: dict[str, float]  # of the training, for the summary


def train_consistency(
    recording: Recording,
    labels: Tensor,
    latents: Latents,
    config: ConsistencyConfig,
    seed: int,
    report: Report,
) -> Distillation:
    """Train a teacher on the same data as Diffusion's denoiser, and distil it.

    Args:
        recording: N recorded rows; held-out ones are not learned.
        labels: [N, A] the expert's own action at every row.
        latents: of the N rows.
        config: sizes, updates and rates.
        seed: of all draws but the initial weights.
        report: called every 100 updates with the share that is done and a text.
    """
    source = generator(seed)
    rows = torch.from_numpy(np.flatnonzero(~recording.held_out(HELD_OUT)))

    teacher_share = config.teacher_updates / (config.teacher_updates + config.updates)

    def draw() -> tuple[Tensor, Tensor]:
        """Sample features [B, F] and the expert's actions [B, A]."""
        index = rows[torch.randint(len(rows), (config.batch,), generator=source)]
        return latents.at(index).features, labels[index]

    def report_teacher(share: float, text: str) -> None:
        report(share * teacher_share, text)

    def report_student(share: float, text: str) -> None:
        report(teacher_share + share * (1 - teacher_share), text)

    untrained = Consistency(latents.features, labels.shape[1], config.width, config.depth)
    teacher = teach(untrained, draw, config, source, report_teacher)
    student = distil(teacher.model, draw, config, source, report_student)
    numbers = {
        "teacher_loss": teacher.loss,
        "consistency_loss": student.loss,
        "demonstrations": float(len(rows)),
    }
    return Distillation(student.model, teacher.model, numbers)


def teach(
    model: Consistency,
    draw: Draw,
    config: ConsistencyConfig,
    source: torch.Generator,
    report: Report,
) -> Averaged:
    """Train `model` in place to predict clean actions from noisy ones, and return a copy with its
    averaged weights. The loss is weighted by level.
    """

    def loss() -> Tensor:
        # -- sample states, levels and noise
        features, clean = draw()
        log_sigma = LOG_MEAN + LOG_STD * torch.randn(len(clean), generator=source)
        sigma = log_sigma.exp().clamp(SIGMA_MIN, SIGMA_MAX)
        noise = torch.randn(tuple(clean.shape), generator=source)

        # -- denoise
        noisy = clean + sigma.unsqueeze(-1) * noise
        return weighted(model(features, noisy, sigma), clean, sigma)

    def report_teacher(share: float, text: str) -> None:
        report(share, f"teacher, {text}")

    return _minimise(model, loss, config.teacher_updates, config, report_teacher)


def distil(
    teacher: Consistency,
    draw: Draw,
    config: ConsistencyConfig,
    source: torch.Generator,
    report: Report,
) -> Averaged:
    """Train a student, which starts as the teacher, to predict the same action at neighbouring
    levels of the teacher's flow, and return a copy with its averaged weights.
    """
    student = copy.deepcopy(teacher).requires_grad_(True)
    levels = ladder(config.levels)

    def loss() -> Tensor:
        # -- sample states, neighbouring levels and noise
        features, clean = draw()
        index = torch.randint(config.levels - 1, (len(clean),), generator=source)
        sigma = levels[index]
        below = levels[index + 1]
        noisy = clean + sigma.unsqueeze(-1) * torch.randn(tuple(clean.shape), generator=source)

        # -- the student one level below, along the teacher's flow, is the target
        context = student.context(features)
        with torch.no_grad():
            denoised = heun(teacher, teacher.context(features), noisy, sigma, below)
            target = student.within(context, denoised, below)
        return weighted(student.within(context, noisy, sigma), target, sigma)

    def report_student(share: float, text: str) -> None:
        report(share, f"student, {text}")

    return _minimise(student, loss, config.updates, config, report_student)


def weighted(predicted: Tensor, target: Tensor, sigma: Tensor) -> Tensor:
    """Return the mean over a batch of squared errors [B, A], weighted by 1 / sigma^2 + 1 /
    SIGMA_DATA^2 of levels [B] (Karras et al.).
    """
    return ((sigma**-2 + SIGMA_DATA**-2) * (predicted - target).square().mean(-1)).mean()


def heun(
    teacher: Consistency, context: Tensor, noisy: Tensor, sigma: Tensor, below: Tensor
) -> Tensor:
    """Follow the teacher's flow, dx / dsigma = (x - D(x, sigma)) / sigma, by one step of Heun.

    Args:
        teacher: D.
        context: of the states, from `teacher.context`.
        noisy: [B, A] actions x.
        sigma: [B] their levels.
        below: [B] the levels to which the step leads.
    """
    level = sigma.unsqueeze(-1)
    next_level = below.unsqueeze(-1)
    slope = (noisy - teacher.within(context, noisy, sigma)) / level
    ahead = noisy + (next_level - level) * slope
    slope_ahead = (ahead - teacher.within(context, ahead, below)) / next_level
    return noisy + (next_level - level) * (slope + slope_ahead) / 2


@torch.inference_mode()
def follow(
    teacher: Consistency, features: Tensor, noisy: Tensor, ratio: float, steps: int
) -> Tensor:
    """Follow the teacher's flow from actions [B, A] at a ratio of the ladder to its end, in a
    number of equal steps.
    """
    context = teacher.context(features)
    action = noisy
    for i in range(steps):
        sigma = torch.full((len(action),), sigma_at(ratio * (1 - i / steps)))
        below = torch.full((len(action),), sigma_at(ratio * (1 - (i + 1) / steps)))
        action = heun(teacher, context, action, sigma, below)
    return action


@torch.inference_mode()
def one_step_error(
    student: Consistency,
    teacher: Consistency,
    features: Tensor,
    noisy: Tensor,
    ratio: float,
    steps: int,
) -> float:
    """Return the mean distance between one step of the student and many of the teacher, from the
    same actions [K, A] at a ratio.
    """
    one_step = student(features, noisy, torch.full((len(noisy),), sigma_at(ratio)))
    many_steps = follow(teacher, features, noisy, ratio, steps)
    return float((one_step - many_steps).norm(dim=-1).mean())


@torch.inference_mode()
def consistency_quality(
    student: Consistency, features: Tensor, expert: Tensor, commands: dict[str, Tensor]
) -> dict[str, dict[str, dict[str, float]]]:
    """Return mean distances of corrected commands, by kind of command and ratio: `conformity` is
    the distance to the expert's action, `fidelity` that to the command.

    Args:
        student: trained.
        features: [K, F] of the decisions.
        expert: [K, A] the expert's own action there.
        commands: by kind, [K, A] what was commanded there.
    """
    distances: dict[str, dict[str, dict[str, float]]] = {}
    for kind, command in commands.items():
        distances[kind] = {}
        for ratio in (0.0, *RATIOS):
            sigma = torch.full((len(command),), sigma_at(ratio))
            executed = student(features, command, sigma).clamp(-1, 1)
            distances[kind][f"{ratio:g}"] = {
                "conformity": float((executed - expert).norm(dim=-1).mean()),
                "fidelity": float((executed - command).norm(dim=-1).mean()),
            }
    return distances


def _minimise(
    model: Consistency,
    loss_of: Callable[[], Tensor],
    updates: int,
    config: ConsistencyConfig,
    report: Report,
) -> Averaged:
    """Update `model` in place, `updates` times, on what `loss_of` returns."""
    average = copy.deepcopy(model).requires_grad_(False)
    optimizer = torch.optim.RAdam(model.parameters(), lr=config.learning_rate)
    scheduler = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, updates)
    smoothed: float | None = None
    for update in range(updates):
        # -- update at a falling rate
        loss = loss_of()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        scheduler.step()

        # -- average the weights; the decay rises, so that the first updates are forgotten
        decay = min(config.ema, (1 + update) / (10 + update))
        with torch.no_grad():
            for mean, online in zip(average.parameters(), model.parameters(), strict=True):
                mean.lerp_(online, 1 - decay)

        # -- progress
        value = float(loss.detach())
        smoothed = value if smoothed is None else 0.98 * smoothed + 0.02 * value
        if update % 100 == 0:
            report(update / updates, f"update {update}/{updates}, loss {smoothed:.4f}")
    return Averaged(average.eval(), smoothed or 0.0)
