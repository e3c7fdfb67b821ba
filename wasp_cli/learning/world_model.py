"""World-model training (Eq. 6), refit of the heads on prior latents, and what the model is worth on held-out episodes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wasp_cli.errors import TrainingError
from wasp_cli.learning.checkpoint import restore_training, save_training
from wasp_cli.learning.configs import WorldModelConfig
from wasp_cli.learning.draws import generator, gumbel
from wasp_cli.learning.replay import Replay
from wasp_cli.metrics.ranking import average_precision
from wasp_cli.models.base import Latent
from wasp_cli.models.weights import load_weights, read_arguments, read_tensors, save_weights
from wasp_cli.models.world_model import Batch, SafetyWorldModel, Sizes

Report = Callable[[float, str], None]
SKIPS = 5
"""Updates with a non-finite loss that are skipped before training stops."""


class Latents(NamedTuple):
    """Filtered latents of N recorded rows. z is stored as class indices."""

    h: Tensor
    """[N, D]"""
    z: Tensor
    """uint8 [N, S]"""
    classes: int

    def at(self, index: Tensor) -> Latent:
        """Latents of some rows, with z one-hot again."""
        one_hot = torch.nn.functional.one_hot(self.z[index].long(), self.classes).to(torch.float32)
        return Latent(self.h[index].float(), one_hot.flatten(-2))


def build(config: WorldModelConfig, action: int) -> SafetyWorldModel:
    """An untrained model of the configured sizes."""
    names = ("deter", "hidden", "variables", "classes", "depth", "head", "unimix", "reward_scale", "cost_weight")
    return SafetyWorldModel(Sizes(action=action, **{name: getattr(config, name) for name in names}))


def save_world_model(model: SafetyWorldModel, folder: Path) -> None:
    """Write `world_model.safetensors` and its sizes."""
    from dataclasses import asdict

    save_weights(model, folder / "world_model.safetensors", **asdict(model.sizes))


def load_world_model(folder: Path) -> SafetyWorldModel:
    """The frozen model of a world-model artifact."""
    path = folder / "world_model.safetensors"
    model = SafetyWorldModel(Sizes(**read_arguments(path)))
    load_weights(model, path)
    return model


class Windows:
    """Random sequences of a replay; a share of them contains a costly step."""

    def __init__(self, replay: Replay, length: int, cost_share: float) -> None:
        self._replay, self._length, self._share = replay, length, cost_share
        self._starts = len(replay.first) - length + 1
        if self._starts < 1:
            raise TrainingError(f"the dataset has {len(replay.first)} rows, fewer than one sequence of {length}", "collect more steps")
        self._costly = np.flatnonzero(replay.cost > 0)

    def sample(self, batch: int, source: torch.Generator) -> Batch:
        """B sequences; episodes may change within one (`first` marks it)."""
        start = torch.randint(self._starts, (batch,), generator=source).numpy()
        wanted = round(self._share * batch)
        if wanted and len(self._costly):
            picked = self._costly[torch.randint(len(self._costly), (wanted,), generator=source).numpy()]
            back = torch.randint(self._length, (wanted,), generator=source).numpy()
            start[:wanted] = np.clip(picked - back, 0, self._starts - 1)
        index = start[:, None] + np.arange(self._length)  # [B, T]
        replay = self._replay
        first = replay.first[index].copy()
        first[:, 0] = 1.0  # a sequence begins without a past

        def take(values: NDArray[Any]) -> Tensor:
            return torch.from_numpy(values[index])

        return Batch(
            take(replay.pixels), take(replay.action), take(replay.reward), take(replay.cost), take(replay.terminal), torch.from_numpy(first)
        )


def train(
    model: SafetyWorldModel, replay: Replay, config: WorldModelConfig, seed: int, work: Path, report: Report
) -> dict[str, list[float]]:
    """Minimise Eq. 6; goes on from its own checkpoint in `work`.

    Returns:
        The loss curves by term, a value per 20 updates.

    Raises:
        TrainingError: more than a handful of updates had a non-finite loss.
    """
    weights = {name: getattr(config, name) for name in ("alpha_q", "alpha_p", "beta_o", "beta_r", "beta_c", "beta_n")}
    optimizer = torch.optim.Adam(model.parameters(), lr=config.learning_rate, fused=True)
    source = generator(seed)
    mean = replay.pixels[:: max(1, len(replay.pixels) // 2000)].astype(np.float32).mean(0) / 255.0
    model.mean_image.copy_(torch.from_numpy(mean))
    counters = restore_training(work, model, optimizer, source) or {"update": 0, "skipped": 0, "curves": {name: [] for name in weights}}
    windows = Windows(replay, config.length, config.cost_windows)
    model.train()
    for update in range(counters["update"], config.updates):
        _set_rate(optimizer, config, update)
        batch = windows.sample(config.batch, source)
        noise = gumbel((config.batch, config.length, config.variables, config.classes), source)
        decoded = torch.randperm(config.length, generator=source)[: max(1, round(config.decode_share * config.length))]
        losses = model.losses(batch, noise, decoded, config.free_nats)
        if losses.keys() != weights.keys():
            raise TrainingError(f"losses {sorted(losses)} and weights {sorted(weights)} differ")
        total = torch.stack([weights[name] * loss for name, loss in losses.items()]).sum()
        optimizer.zero_grad(set_to_none=True)
        if not torch.isfinite(total):
            counters["skipped"] += 1
            if counters["skipped"] > SKIPS:
                named = ", ".join(f"{name} {float(loss.detach()):.3g}" for name, loss in losses.items())
                problem = f"{counters['skipped']} updates had a non-finite loss, last at update {update}: {named}"
                raise TrainingError(problem, "lower world_model.learning_rate")
            continue
        total.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), config.clip)
        optimizer.step()
        if update % 20 == 0 or update == config.updates - 1:
            values = {name: float(loss.detach()) for name, loss in losses.items()}
            for name, value in values.items():
                counters["curves"][name].append(value)
            shown = f"image {values['beta_o']:.0f}, reward {values['beta_r']:.2f}, cost {values['beta_c']:.2f}"
            report((update + 1) / config.updates, f"update {update + 1}/{config.updates}, {shown}")
        if (update + 1) % config.checkpoint_every == 0:
            save_training(work, model, optimizer, source, counters | {"update": update + 1})
    model.eval()
    curves: dict[str, list[float]] = counters["curves"]
    return curves


def _set_rate(optimizer: torch.optim.Optimizer, config: WorldModelConfig, update: int) -> None:
    """Linear warm-up, then a linear decay to a tenth over the second half."""
    scale = min(1.0, (update + 1) / max(1, config.warmup))
    half = config.updates / 2
    if update > half:
        scale *= 1.0 - 0.9 * (update - half) / half
    for group in optimizer.param_groups:
        group["lr"] = config.learning_rate * scale


@torch.inference_mode()
def encode(model: SafetyWorldModel, replay: Replay, report: Report) -> Latents:
    """Filter every recorded row as the closed loop would: episodes side by side, the posterior's mode."""
    episodes = [np.flatnonzero(replay.episode == e) for e in np.unique(replay.episode)]
    h = torch.zeros(len(replay.first), model.sizes.deter)
    z = torch.zeros(len(replay.first), model.sizes.variables, dtype=torch.uint8)
    for begin in range(0, len(episodes), 16):
        group = episodes[begin : begin + 16]
        latent = model.initial(len(group))
        for t in range(max(len(rows) for rows in group)):
            # Rows whose episode is over repeat its last row; what they produce is not stored.
            index = np.array([rows[min(t, len(rows) - 1)] for rows in group])
            action, pixels, first = (torch.from_numpy(field[index]) for field in (replay.action, replay.pixels, replay.first))
            latent = model.filter(latent, action, pixels, first)
            live = np.array([t < len(rows) for rows in group])
            keep = torch.from_numpy(index[live])
            h[keep] = latent.h[live]
            z[keep] = latent.z[live].unflatten(-1, (model.sizes.variables, -1)).argmax(-1).to(torch.uint8)
        report(min(1.0, (begin + 16) / len(episodes)), f"encoding episode {min(begin + 16, len(episodes))}/{len(episodes)}")
    return Latents(h, z, model.sizes.classes)


def roll_prior(model: SafetyWorldModel, start: Latent, actions: Tensor, source: torch.Generator) -> Latent:
    """Arrived prior latents under given actions [B, H, A]: fields [B, H, .]."""
    noise = gumbel((actions.shape[1], actions.shape[0], model.noise_size), source)
    hs, zs = [], []
    latent = start
    for k in range(actions.shape[1]):
        latent = model.imagine(latent, actions[:, k], noise[k])
        hs.append(latent.h)
        zs.append(latent.z)
    return Latent(torch.stack(hs, 1), torch.stack(zs, 1))


def refit_heads(model: SafetyWorldModel, replay: Replay, latents: Latents, config: WorldModelConfig, seed: int, report: Report) -> None:
    """Train the reward and cost heads on what they will read: prior latents up to `refit_horizon`, the rest frozen.

    Heads trained jointly overpredict the cost more and more along an imagined rollout (2.3 times at step 15 in a study).
    """
    horizon = config.refit_horizon
    starts = replay.window_starts(horizon + 1)
    if not len(starts) or not config.refit_updates:
        return
    heads = [*model.reward_head.parameters(), *model.cost_head.parameters()]
    optimizer = torch.optim.Adam(heads, lr=1e-3)
    source = generator(seed)
    for update in range(config.refit_updates):
        index = torch.from_numpy(starts[torch.randint(len(starts), (64,), generator=source).numpy()])
        follow = (index[:, None] + 1 + torch.arange(horizon)).numpy()
        with torch.no_grad():
            features = roll_prior(model, latents.at(index), torch.from_numpy(replay.action[follow]), source).features
        reward, cost = model.head_losses(features, torch.from_numpy(replay.reward[follow]), torch.from_numpy(replay.cost[follow]))
        loss = reward + cost
        for group in optimizer.param_groups:
            group["lr"] = 1e-3 * (1 - 0.9 * update / config.refit_updates)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        if update % 50 == 0:
            report(update / config.refit_updates, f"refit {update}/{config.refit_updates}, cost {float(cost.detach()):.3f}")


@torch.inference_mode()
def open_loop(
    model: SafetyWorldModel, replay: Replay, latents: Latents, horizon: int, seed: int, samples: int = 4
) -> list[dict[str, float]]:
    """Held-out quality of imagined rewards and costs, a row per imagined step 1..H.

    Columns: base rate of cost, AUPRC of c-hat, AUPRC of persistence ("cost stays what it is"), mean predicted / base rate, reward R2.
    """
    starts = replay.window_starts(horizon + 1)
    if not len(starts):
        return []
    starts = starts[:: max(1, len(starts) // 4000)]
    index = torch.from_numpy(starts)
    follow = starts[:, None] + 1 + np.arange(horizon)
    source = generator(seed)
    cost, reward = torch.zeros(len(starts), horizon), torch.zeros(len(starts), horizon)
    for _ in range(samples):
        arrived = roll_prior(model, latents.at(index), torch.from_numpy(replay.action[follow]), source)
        cost += model.cost(arrived) / samples
        reward += model.reward(arrived) / samples
    rows = []
    now: NDArray[Any] = replay.cost[starts]
    for k in range(horizon):
        true_cost, true_reward = replay.cost[follow[:, k]], replay.reward[follow[:, k]]
        base = float(true_cost.mean())
        residual = float(((reward[:, k].numpy() - true_reward) ** 2).mean())
        rows.append(
            {
                "k": k + 1, "base": base,
                "auprc": average_precision(true_cost > 0, cost[:, k].numpy()),
                "persistence": average_precision(true_cost > 0, now),
                "predicted_over_base": float(cost[:, k].mean()) / base if base else float("nan"),
                "reward_r2": 1.0 - residual / max(float(true_reward.var()), 1e-12),
            }
        )  # fmt: skip
    return rows


def save_latents(latents: Latents, folder: Path) -> None:
    """Write `latents.safetensors`."""
    from safetensors.torch import save_file

    save_file({"h": latents.h.half(), "z": latents.z, "classes": torch.tensor(latents.classes)}, folder / "latents.safetensors")


def load_latents(folder: Path) -> Latents:
    """The latents of a world-model artifact, row for row those of its dataset."""
    tensors = read_tensors(folder / "latents.safetensors")
    return Latents(tensors["h"].float(), tensors["z"], int(tensors["classes"]))
