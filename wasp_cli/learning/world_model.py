"""World-model training: Eq. 6 on sequences, then a refit of the reward, cost and continuation
heads on prior latents.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from wasp_cli.errors import TrainingError
from wasp_cli.learning.checkpoint import restore_training, save_training
from wasp_cli.learning.configs.world import WorldModelConfig
from wasp_cli.learning.device import mixed_precision
from wasp_cli.learning.latents import Latents
from wasp_cli.learning.privileged_state import Mirror, Readout
from wasp_cli.learning.sampling import generator, gumbel, roll_prior
from wasp_cli.learning.shards import Recording
from wasp_cli.learning.windows import Context, Window, Windows
from wasp_cli.models.base import Latent
from wasp_cli.models.vectors import Standard
from wasp_cli.models.world_model import Ahead, Batch, SafetyWorldModel, Sizes

Report = Callable[[float, str], None]
SKIPS = 5  # updates with a non-finite loss or gradient that are skipped before training stops
SHOWN = 20  # updates between two points of the curves
REFIT_RATE = 1e-3  # initial learning rate of the refit; it decays linearly to a tenth


def build(
    config: WorldModelConfig,
    action: int,
    vectors: Standard | None = None,
    reward_unit: float = 1.0,
) -> SafetyWorldModel:
    """Build an untrained model of the configured sizes.

    Args:
        config: the sizes.
        action: components of an action.
        vectors: mean and standard deviation of the vectors that the model sees; None for a model
            that sees images.
        reward_unit: unit of the task's rewards, see `learning.reward_unit`.
    """
    names = (
        "deter",
        "hidden",
        "variables",
        "classes",
        "depth",
        "head",
        "unimix",
        "reward_scale",
        "cost_weight",
        "action_scales",
    )
    values = {name: getattr(config, name) for name in names}
    sizes = Sizes(action=action, reward_unit=reward_unit, **values)
    if vectors is not None:
        sizes = replace(sizes, state_mean=vectors.mean, state_std=vectors.std)
    return SafetyWorldModel(sizes)


def loss_weights(config: WorldModelConfig) -> dict[str, float]:
    """Return the factor of each term of the loss, by the name of the term: the terms of Eq. 6,
    those on imagined steps, and that on the privileged vector. Terms that are switched off are
    left out.
    """
    weights: dict[str, float] = {
        name: getattr(config, name)
        for name in ("alpha_q", "alpha_p", "beta_o", "beta_r", "beta_c", "beta_n")
    }
    if config.ahead_starts:
        weights["ahead_r"] = config.ahead * config.beta_r
        weights["ahead_c"] = config.ahead * config.beta_c
        if config.ahead_images:
            weights["ahead_o"] = config.ahead_image * config.beta_o
    if config.privileged:
        weights["privileged"] = config.privileged
    return weights


def mean_image(recording: Recording) -> Tensor:
    """Return the mean of about 2000 images of the dataset: [6, 64, 64], in [0, 1]."""
    stride = max(1, len(recording.pixels) // 2000)
    images = recording.pixels[::stride]
    return torch.from_numpy(images.astype(np.float32).mean(0) / 255.0)


def train(
    model: SafetyWorldModel,
    recording: Recording,
    rows: NDArray[np.int64],
    config: WorldModelConfig,
    updates: int,
    seed: int,
    work: Path,
    report: Report,
    *,
    readout: Readout | None = None,
    mirror: NDArray[np.float32] | None = None,
    privileged_mirror: Mirror | None = None,
) -> tuple[dict[str, list[float]], int]:
    """Minimise Eq. 6 on sequences of the recording, on the model's device. An interrupted training
    goes on from its checkpoint in `work`, and ends with the same weights.

    Args:
        model: trained in place; its `eval` mode is set at the end.
        recording: the whole dataset, N rows.
        rows: [K] the rows that may be learned from.
        config: sizes, weights and rates.
        updates: gradient steps in all, those before an interruption included.
        seed: of all draws.
        work: folder of the checkpoint.
        report: called with the share that is done and a text.
        readout: head of the loss on the privileged vector, trained along, where `config.privileged`
            gives that loss a weight.
        mirror: [A, A] what an action becomes in a mirror; None: no sequence is mirrored.
        privileged_mirror: what a privileged vector becomes there; None where that is not known.

    Returns:
        The loss curves by term and that of the gradient norm, a value per 20 updates; and the
        number of updates that were skipped because a loss or gradient was not finite.

    Raises:
        TrainingError: too many updates had to be skipped, or the rows are fewer than one sequence.
    """
    device = model.device
    # Vectors are decoded by a small network, so every step of a sequence is decoded.
    decode_share = 1.0
    observation = "vector"
    if model.reads == "pixels":
        decode_share = config.decode_share
        observation = "image"
    decode_count = max(1, round(decode_share * config.length))

    # -- parameters and optimizer
    weights = loss_weights(config)
    modules: dict[str, nn.Module] = {"model": model}
    if readout is not None:
        modules["readout"] = readout
    whole = nn.ModuleDict(modules)
    optimizer = torch.optim.Adam(whole.parameters(), lr=config.learning_rate, fused=True)
    compute = torch.compile(model.losses) if config.compile else model.losses

    # -- data: sequences, and the latents from which they go on
    privileged = torch.from_numpy(recording.privileged)
    source = generator(seed, device)
    views = 1 if mirror is None else 2  # a row and its mirror image are remembered apart
    context = Context(views * len(recording.first), config.deter, config.variables, device)
    windows = Windows(recording, rows, config.length, config.cost_windows, device, mirror)

    # -- where an interrupted training stopped
    beginning: dict[str, Any] = {
        "update": 0,
        "skipped": 0,
        "curves": {name: [] for name in [*weights, "gradient_norm"]},
    }
    counters = restore_training(work, whole, optimizer, source, context) or beginning

    model.train()
    for update in range(counters["update"], updates):
        # -- anneal the rate
        _set_rate(optimizer, config, update, updates)

        # -- sample sequences, with the latents before them
        window = windows.sample(config.batch, source)
        start: Latent | None = None
        if config.context:
            batch, start = context.enter(window, config.classes)
        else:
            batch = _without_past(window)
        noise = gumbel((config.batch, config.length, config.variables, config.classes), source)
        order = torch.randperm(config.length, generator=source, device=device)
        decoded = order[:decode_count]  # steps whose observation is decoded
        ahead: Ahead | None = None
        if config.ahead_starts:
            ahead = windows.ahead(
                window,
                config.ahead_starts,
                config.ahead_horizon,
                config.ahead_images,
                model.noise_size,
                source,
            )

        # -- losses
        with mixed_precision(device):
            losses, latent = compute(
                batch, noise, decoded, config.free_nats, start=start, ahead=ahead
            )
            if readout is not None:
                vectors = privileged[window.rows.cpu()].to(device)  # [B, T, P]
                losses["privileged"] = readout.loss(
                    latent.features, vectors, window.mirrored, privileged_mirror
                )
        if losses.keys() != weights.keys():
            raise TrainingError(f"losses {sorted(losses)} and weights {sorted(weights)} differ")
        total = torch.stack([weights[name] * loss for name, loss in losses.items()]).sum()

        # -- update, unless it would spoil the weights
        optimizer.zero_grad(set_to_none=True)
        total.backward()
        norm = torch.nn.utils.clip_grad_norm_(whole.parameters(), config.clip)
        if not math.isfinite(float(total.detach()) + float(norm)):
            _skip(counters, update, losses)
            continue
        optimizer.step()
        if config.context:
            context.keep(window, latent)

        # -- curves and checkpoint
        if update % SHOWN == 0 or update == updates - 1:
            values = {name: float(loss.detach()) for name, loss in losses.items()}
            for name, value in values.items():
                counters["curves"][name].append(value)
            counters["curves"]["gradient_norm"].append(float(norm))
            text = (
                f"update {update + 1}/{updates}, {observation} {values['beta_o']:.0f}, reward "
                f"{values['beta_r']:.2f}, cost {values['beta_c']:.2f}"
            )
            report((update + 1) / updates, text)
        if (update + 1) % config.checkpoint_every == 0:
            save_training(
                work, whole, optimizer, source, counters | {"update": update + 1}, context
            )
    model.eval()
    curves: dict[str, list[float]] = counters["curves"]
    return curves, counters["skipped"]


def _without_past(window: Window) -> Batch:
    """Return the batch with every sequence marked as the beginning of an episode."""
    first = window.batch.first.clone()
    first[:, 0] = 1.0
    return window.batch._replace(first=first)


def _skip(counters: dict[str, Any], update: int, losses: dict[str, Tensor]) -> None:
    """Count an update that would have spoiled the weights; too many end the training."""
    counters["skipped"] += 1
    if counters["skipped"] > SKIPS:
        named = ", ".join(f"{name} {float(loss.detach()):.3g}" for name, loss in losses.items())
        problem = (
            f"{counters['skipped']} updates had a non-finite loss or gradient, last at update "
            f"{update}: {named}"
        )
        raise TrainingError(
            problem,
            "lower world_model.learning_rate and run again; the checkpoint before it is kept",
        )


def _set_rate(
    optimizer: torch.optim.Optimizer, config: WorldModelConfig, update: int, updates: int
) -> None:
    """Linear warm-up, then a linear decay to a tenth over the second half."""
    scale = min(1.0, (update + 1) / max(1, config.warmup))
    half = updates / 2
    if update > half:
        scale *= 1.0 - 0.9 * (update - half) / half
    for group in optimizer.param_groups:
        group["lr"] = config.learning_rate * scale


def refit_heads(
    model: SafetyWorldModel,
    recording: Recording,
    latents: Latents,
    allowed: NDArray[np.bool_],
    config: WorldModelConfig,
    seed: int,
    report: Callable[[float, str], None],
) -> None:
    """Train the reward, cost and continuation heads on what they will read: prior latents 1 to K =
    `refit_horizon` steps ahead. The rest of the model stays frozen.

    Heads that were trained jointly overpredict the cost more and more along an imagined rollout
    (2.3 times at step 15 in a study). The last step of an episode counts; imagined steps behind it
    do not.

    Args:
        model: its heads are trained in place, and frozen afterwards.
        recording: the whole dataset, N rows.
        latents: filtered latents of the N rows.
        allowed: [N] rows from which a rollout may start.
        config: updates, rollouts per update and horizon of the refit.
        seed: of all draws.
        report: called every 50 updates with the share that is done and a text.
    """
    # -- starts: rows after which the episode goes on
    horizon = config.refit_horizon
    starts = np.flatnonzero(allowed[:-1] & (recording.episode[:-1] == recording.episode[1:]))
    if not len(starts) or not config.refit_updates:
        return

    # -- only the heads are trained
    heads = [
        *model.reward_head.parameters(),
        *model.cost_head.parameters(),
        *model.continue_head.parameters(),
    ]
    for parameter in heads:
        parameter.requires_grad_(True)
    optimizer = torch.optim.Adam(heads, lr=REFIT_RATE, fused=True)
    device = model.device
    last = len(recording.first) - 1
    source = generator(seed, device)
    for update in range(config.refit_updates):
        # -- sample starts [B] and the rows [B, K] that followed them
        places = torch.randint(len(starts), (config.refit_starts,), generator=source, device=device)
        index = starts[places.cpu().numpy()]
        ahead = index[:, None] + 1 + np.arange(horizon)
        follow = np.minimum(ahead, last)
        same = (recording.episode[follow] == recording.episode[index][:, None]) & (ahead <= last)
        within = torch.from_numpy(same.astype(np.float32)).to(device)
        action = torch.from_numpy(recording.action[follow]).to(device)
        reward = torch.from_numpy(recording.reward[follow]).to(device)
        cost = torch.from_numpy(recording.cost[follow]).to(device)
        terminal = torch.from_numpy(recording.terminal[follow]).to(device)

        # -- imagine under the recorded actions
        with torch.no_grad():
            start = latents.at(torch.from_numpy(index)).to(device)
            features = roll_prior(model, start, action, source).features

        # -- losses
        reward_loss, cost_loss = model.head_losses(features, reward, cost, within)
        continuation_loss = model.continuation_loss(features, terminal, within)

        # -- update at a falling rate
        for group in optimizer.param_groups:
            group["lr"] = REFIT_RATE * (1 - 0.9 * update / config.refit_updates)
        optimizer.zero_grad(set_to_none=True)
        (reward_loss + cost_loss + continuation_loss).backward()
        optimizer.step()
        if update % 50 == 0:
            report(
                update / config.refit_updates,
                f"refit {update}/{config.refit_updates}, cost {float(cost_loss.detach()):.3f}",
            )
    for parameter in heads:
        parameter.requires_grad_(False)
