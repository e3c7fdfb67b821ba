"""The authors' own experts, from a checkout of github.com/ripl/diffusion-for-shared-autonomy: weights without a licence, not kept here."""

from __future__ import annotations

from pathlib import Path

import torch
from stable_baselines3 import SAC
from torch import nn

from tests.external.lander import GoalLander, Kind

FOLDERS: dict[Kind, str] = {"lander": "v5", "reacher": "v1"}


@torch.no_grad()
def their_expert(kind: Kind, checkout: Path) -> SAC:
    """Load an expert of theirs, actor and first critic, as a model of Stable-Baselines3."""
    folder = checkout / "data-dir" / "experts" / "lunarlander" / FOLDERS[kind]
    model = SAC("MlpPolicy", GoalLander(kind), policy_kwargs={"net_arch": [128, 128]}, buffer_size=1, device="cpu")
    *hidden, last = _layers(folder / "policy.pt")
    actor = model.policy.actor
    _fill([layer for layer in actor.latent_pi if isinstance(layer, nn.Linear)], hidden)
    for layer, values in zip((actor.mu, actor.log_std), zip(*(part.chunk(2) for part in last), strict=True), strict=True):
        _fill([layer], [values])
    _fill([layer for layer in model.policy.critic.q_networks[0] if isinstance(layer, nn.Linear)], _layers(folder / "q_func1.pt"))
    return model


def _layers(path: Path) -> list[tuple[torch.Tensor, ...]]:
    """Read (weight, bias) of each linear layer, in order; nothing else is unpickled."""
    state = torch.load(path, map_location="cpu", weights_only=True)
    return [(state[f"{i}.weight"], state[f"{i}.bias"]) for i in sorted({int(name.partition(".")[0]) for name in state})]


def _fill(layers: list[nn.Linear], values: list[tuple[torch.Tensor, ...]]) -> None:
    for layer, (weight, bias) in zip(layers, values, strict=True):
        layer.weight.copy_(weight)
        layer.bias.copy_(bias)
