"""CSA's consistency model: a teacher learns the expert's actions at recorded latents, and its
probability flow is distilled into one step.

After Sun et al. 2025 (FlashBack) and the authors' configurations: the teacher is a diffusion model
as in Karras et al. 2022, the student is made consistent along the teacher's flow, dx / dsigma = (x
- D(x, sigma)) / sigma, solved by one step of Heun between neighbouring levels (Song et al. 2023,
Algorithm 2). K decisions on held-out episodes, A actions, F features.

What differs from the authors' code: the student starts as the teacher, and is its own target
without a gradient (theirs follows the student at a rate that falls from .999 to .37); the teacher's
loss is weighted by level as in Karras et al., not by a learned weight; both are conditioned on the
latent features instead of the state. Theirs has a second condition, the direction in which a
learned forward model sees the command take the state, in half of the loss; the variant without it
is what is called CSA in the paper (with it CSA dagger).
"""

from __future__ import annotations

import copy
from collections.abc import Callable

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

# shares of the ladder: sigma .017, .17, .97 and 11.5; at 0 a command stays as it is
RATIOS = (0.1, 0.25, 0.4, 0.69)
LOG_MEAN, LOG_STD = -1.2, 1.6
"""Of ln sigma in the training of the teacher: mean of Karras et al. 2022, spread of the
authors' code.
"""

# returns features [B, F] and clean actions [B, A] of a batch
Draw = Callable[[], tuple[Tensor, Tensor]]
Report = Callable[[float, str], None]


def train_consistency(
    recording: Recording,
    labels: Tensor,
    latents: Latents,
    config: ConsistencyConfig,
    seed: int,
    report: Report,
) -> tuple[Consistency, Consistency, dict[str, float]]:
    """Train a teacher on the data of Diffusion, and distil it; returns student, teacher and numbers
    of the training.

    Args:
        recording: recorded rows; held-out ones are not learned.
        labels: the expert's own action at every row [N, A].
    """
    source = generator(seed)
    rows = torch.from_numpy(np.flatnonzero(~recording.held_out(HELD_OUT)))

    def draw() -> tuple[Tensor, Tensor]:
        index = rows[torch.randint(len(rows), (config.batch,), generator=source)]
        return latents.at(index).features, labels[index]

    share = config.teacher_updates / (config.teacher_updates + config.updates)
    features = latents.h.shape[1] + latents.z.shape[1] * latents.classes
    untrained = Consistency(features, labels.shape[1], config.width, config.depth)
    teacher, taught = teach(
        untrained, draw, config, source, lambda done, text: report(done * share, text)
    )
    student, distilled = distil(
        teacher, draw, config, source, lambda done, text: report(share + done * (1 - share), text)
    )
    return (
        student,
        teacher,
        {"teacher_loss": taught, "consistency_loss": distilled, "demonstrations": float(len(rows))},
    )


def teach(
    model: Consistency,
    draw: Draw,
    config: ConsistencyConfig,
    source: torch.Generator,
    report: Report,
) -> tuple[Consistency, float]:
    """Train `model` to predict clean actions from noisy ones; returns its averaged weights and
    the loss in the end, weighted by level.
    """

    def loss() -> Tensor:
        features, clean = draw()
        sigma = (
            (LOG_MEAN + LOG_STD * torch.randn(len(clean), generator=source))
            .exp()
            .clamp(SIGMA_MIN, SIGMA_MAX)
        )
        noise = torch.randn(tuple(clean.shape), generator=source)
        return weighted(model(features, clean + sigma.unsqueeze(-1) * noise, sigma), clean, sigma)

    return _descend(
        model,
        loss,
        config.teacher_updates,
        config,
        lambda done, text: report(done, f"teacher, {text}"),
    )


def distil(
    teacher: Consistency,
    draw: Draw,
    config: ConsistencyConfig,
    source: torch.Generator,
    report: Report,
) -> tuple[Consistency, float]:
    """Make a student say the same at neighbouring levels of the teacher's flow; returns its
    averaged weights and its loss in the end.
    """
    student, levels = copy.deepcopy(teacher).requires_grad_(True), ladder(config.levels)

    def loss() -> Tensor:
        features, clean = draw()
        index = torch.randint(config.levels - 1, (len(clean),), generator=source)
        sigma, below = levels[index], levels[index + 1]
        noisy = clean + sigma.unsqueeze(-1) * torch.randn(tuple(clean.shape), generator=source)
        context = student.context(features)
        with torch.no_grad():
            target = student.within(
                context, heun(teacher, teacher.context(features), noisy, sigma, below), below
            )
        return weighted(student.within(context, noisy, sigma), target, sigma)

    return _descend(
        student, loss, config.updates, config, lambda done, text: report(done, f"student, {text}")
    )


def weighted(found: Tensor, wanted: Tensor, sigma: Tensor) -> Tensor:
    """Return the mean over a batch of squared errors [B, A], weighted by 1 / sigma^2 + 1 /
    SIGMA_DATA^2 of levels [B] (Karras et al.).
    """
    return ((sigma**-2 + SIGMA_DATA**-2) * (found - wanted).square().mean(-1)).mean()


def heun(
    teacher: Consistency, context: Tensor, noisy: Tensor, sigma: Tensor, below: Tensor
) -> Tensor:
    """Follow the teacher's flow from actions [B, A] at levels `sigma` [B] to those `below` [B]
    by one step of Heun.
    """
    sigma_, below_ = sigma.unsqueeze(-1), below.unsqueeze(-1)
    slope = (noisy - teacher.within(context, noisy, sigma)) / sigma_
    ahead = noisy + (below_ - sigma_) * slope
    then = (ahead - teacher.within(context, ahead, below)) / below_
    return noisy + (below_ - sigma_) * (slope + then) / 2


@torch.inference_mode()
def follow(
    teacher: Consistency, features: Tensor, noisy: Tensor, ratio: float, steps: int
) -> Tensor:
    """Follow the teacher's flow from actions [B, A] at a ratio to its end, in so many steps."""
    context, x = teacher.context(features), noisy
    for i in range(steps):
        sigma, below = (
            torch.full((len(x),), sigma_at(ratio * (1 - j / steps))) for j in (i, i + 1)
        )
        x = heun(teacher, context, x, sigma, below)
    return x


@torch.inference_mode()
def one_step_error(
    student: Consistency,
    teacher: Consistency,
    features: Tensor,
    noisy: Tensor,
    ratio: float,
    steps: int,
) -> float:
    """Return the mean distance of one step of the student from many of the teacher, from the
    same actions [K, A] at a ratio.
    """
    found = student(features, noisy, torch.full((len(noisy),), sigma_at(ratio)))
    return float((found - follow(teacher, features, noisy, ratio, steps)).norm(dim=-1).mean())


@torch.inference_mode()
def consistency_quality(
    student: Consistency, features: Tensor, expert: Tensor, commands: dict[str, Tensor]
) -> dict[str, dict[str, dict[str, float]]]:
    """Return mean distances by kind of command and ratio: `conformity` to the expert's action,
    `fidelity` to the command (0 is nearest).

    Args:
        student: trained.
        features: [K, F]
        expert: [K, A] the expert's own action there.
        commands: by kind, [K, A] what was commanded there.
    """
    found: dict[str, dict[str, dict[str, float]]] = {}
    for kind, command in commands.items():
        found[kind] = {}
        for ratio in (0.0, *RATIOS):
            executed = student(
                features, command, torch.full((len(command),), sigma_at(ratio))
            ).clamp(-1, 1)
            near, kept = ((executed - other).norm(dim=-1).mean() for other in (expert, command))
            found[kind][f"{ratio:g}"] = {"conformity": float(near), "fidelity": float(kept)}
    return found


def _descend(
    model: Consistency,
    loss_of: Callable[[], Tensor],
    updates: int,
    config: ConsistencyConfig,
    report: Report,
) -> tuple[Consistency, float]:
    """So many updates of `model`; a copy with its averaged weights, and the loss in the end."""
    average = copy.deepcopy(model).requires_grad_(False)
    optimizer = torch.optim.RAdam(model.parameters(), lr=config.learning_rate)
    falling = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, updates)
    smoothed = None
    for update in range(updates):
        loss = loss_of()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        falling.step()
        # The average forgets the first updates: its decay rises with the number of them.
        decay = min(config.ema, (1 + update) / (10 + update))
        with torch.no_grad():
            for old, new in zip(average.parameters(), model.parameters(), strict=True):
                old.lerp_(new, 1 - decay)
        smoothed = (
            float(loss.detach())
            if smoothed is None
            else 0.98 * smoothed + 0.02 * float(loss.detach())
        )
        if update % 100 == 0:
            report(update / updates, f"update {update}/{updates}, loss {smoothed:.4f}")
    return average.eval(), smoothed or 0.0
