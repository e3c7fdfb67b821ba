"""Critics: V_r and V_c by TD-lambda on imagined rollouts of the nominal expert (Eq. 7-8), with slow targets."""

from __future__ import annotations

import copy
from collections.abc import Callable

import numpy as np
import torch

from wasp_cli.learning.configs import CriticsConfig, ReturnsConfig
from wasp_cli.learning.draws import generator, gumbel
from wasp_cli.learning.latents import Latents
from wasp_cli.learning.replay import Replay
from wasp_cli.methods.wasp.returns import td_lambda_all
from wasp_cli.models.base import Latent
from wasp_cli.models.critics import LatentCritics
from wasp_cli.models.policy import Skills
from wasp_cli.models.world_model import SafetyWorldModel


def train_critics(
    model: SafetyWorldModel,
    skills: Skills,
    latents: Latents,
    config: CriticsConfig,
    returns: ReturnsConfig,
    seed: int,
    report: Callable[[float, str], None],
) -> LatentCritics:
    """Evaluate the expert in imagination from recorded states; model and policy stay fixed."""
    critics = LatentCritics(model.feature_size, config.hidden)
    slow = copy.deepcopy(critics).requires_grad_(False)
    optimizer = torch.optim.Adam(critics.parameters(), lr=config.learning_rate)
    source = generator(seed)
    for update in range(config.updates):
        index = torch.randint(len(latents.h), (config.starts,), generator=source)
        with torch.no_grad():
            states, reward, cost = _imagine(model, skills, latents.at(index), config.horizon, source)
            arrived = Latent(states.h[1:], states.z[1:])
            target_r = td_lambda_all(reward, slow.value_r(arrived), returns.gamma_r, returns.lam)
            target_c = td_lambda_all(cost, slow.value_c(arrived), returns.gamma_c, returns.lam)
            features = states.features[:-1]
        error_r = critics.reward_net(features).squeeze(-1) - target_r
        error_c = critics.cost_net(features).squeeze(-1) - target_c
        loss = torch.nn.functional.smooth_l1_loss(error_r, torch.zeros_like(error_r)) + error_c.square().mean()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(critics.parameters(), 10.0)
        optimizer.step()
        with torch.no_grad():
            for target, online in zip(slow.parameters(), critics.parameters(), strict=True):
                target.lerp_(online, config.slow)
        if update % 20 == 0:
            means = f"V_r {float(target_r.mean()):.2f}, V_c {float(target_c.mean()):.3f}"
            report(update / config.updates, f"update {update}/{config.updates}, {means}")
    critics.eval().requires_grad_(False)
    return critics


def _imagine(
    model: SafetyWorldModel, skills: Skills, start: Latent, horizon: int, source: torch.Generator
) -> tuple[Latent, torch.Tensor, torch.Tensor]:
    """States 0..H under the expert, [H + 1, B, .], and what the arrived states score, [H, B]."""
    noise = gumbel((horizon, len(start.h), model.noise_size), source)
    hs, zs = [start.h], [start.z]
    latent = start
    for k in range(horizon):
        latent = model.imagine(latent, skills.expert(latent.features), noise[k])
        hs.append(latent.h)
        zs.append(latent.z)
    states = Latent(torch.stack(hs), torch.stack(zs))
    arrived = Latent(states.h[1:], states.z[1:])
    return states, model.reward(arrived), model.cost(arrived)


@torch.inference_mode()
def rank_agreement(critics: LatentCritics, replay: Replay, latents: Latents, returns: ReturnsConfig) -> dict[str, float]:
    """Spearman correlation of V_r and V_c with the real discounted sums that followed in the expert-like episodes.

    The last 50 steps of an episode are left out: their sums are cut off by its end.
    """
    rows = np.flatnonzero(replay.behaviour == "expert")
    rows = rows[: 20 * 250]
    found: dict[str, list[float]] = {"r": [], "c": []}
    kept: list[int] = []
    for episode in np.unique(replay.episode[rows]):
        own = np.flatnonzero(replay.episode == episode)
        sums = {"r": 0.0, "c": 0.0}
        back: dict[str, list[float]] = {"r": [], "c": []}
        for row in own[:0:-1]:
            sums["r"] = float(replay.reward[row]) + returns.gamma_r * sums["r"]
            sums["c"] = float(replay.cost[row]) + returns.gamma_c * sums["c"]
            for name in sums:
                back[name].append(sums[name])
        kept += list(own[:-1][:-50])
        for name in back:
            found[name] += back[name][::-1][:-50]
    if len(kept) < 10:
        return {}
    states = latents.at(torch.tensor(kept))
    predicted = {"r": critics.value_r(states).numpy(), "c": critics.value_c(states).numpy()}
    return {f"rank_{name}": _spearman(predicted[name], np.array(found[name])) for name in predicted}


def _spearman(a: np.ndarray, b: np.ndarray) -> float:
    first, second = (_ranks(x) for x in (a, b))
    return float(np.corrcoef(first, second)[0, 1])


def _ranks(values: np.ndarray) -> np.ndarray:
    """Average ranks: discounted costs have many exact ties at zero."""
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(counts).astype(np.float64)
    average: np.ndarray = (last - (counts - 1) / 2)[inverse]
    return average
