"""The authors' experts and denoisers, from a checkout of their repository. Their weights have
no licence and are not kept here.
"""

from pathlib import Path

import torch
from stable_baselines3 import SAC
from torch import nn
from torch.nn import functional

from tests.external.lander import GoalLander, Kind

FOLDERS: dict[Kind, str] = {"lander": "v5", "reacher": "v1"}
# the denoisers that they evaluated
STEPS: dict[Kind, str] = {"lander": "00024000", "reacher": "00029999"}


class TheirDenoiser(nn.Module):
    """A denoiser of theirs, called as ours is: levels scale layers before their softplus, and
    noise of the state is predicted too.
    """

    def __init__(self, kind: Kind, checkout: Path) -> None:
        super().__init__()
        path = (
            checkout
            / "data-dir"
            / "ddpm"
            / f"lunarlander-{FOLDERS[kind]}"
            / f"step_{STEPS[kind]}.pt"
        )
        self.state = torch.load(path, map_location="cpu", weights_only=True)["model"]

    def forward(
        self, features: torch.Tensor, noisy: torch.Tensor, level: torch.Tensor
    ) -> torch.Tensor:
        x = torch.cat([features, noisy], -1)
        for name in ("lin1", "lin2", "lin3"):
            linear = functional.linear(
                x, self.state[f"{name}.lin.weight"], self.state[f"{name}.lin.bias"]
            )
            x = functional.softplus(self.state[f"{name}.embed.weight"][level] * linear)
        return functional.linear(x, self.state["lin4.weight"], self.state["lin4.bias"])[
            :, features.shape[1] :
        ]


@torch.no_grad()
def their_expert(kind: Kind, checkout: Path) -> SAC:
    """Load an expert of theirs, actor and first critic, as a model of Stable-Baselines3."""
    folder = checkout / "data-dir" / "experts" / "lunarlander" / FOLDERS[kind]
    model = SAC(
        "MlpPolicy",
        GoalLander(kind),
        policy_kwargs={"net_arch": [128, 128]},
        buffer_size=1,
        device="cpu",
    )
    *hidden, last = _layers(folder / "policy.pt")
    actor = model.policy.actor
    _fill([layer for layer in actor.latent_pi if isinstance(layer, nn.Linear)], hidden)
    for layer, values in zip(
        (actor.mu, actor.log_std), zip(*(part.chunk(2) for part in last), strict=True), strict=True
    ):
        _fill([layer], [values])
    _fill(
        [layer for layer in model.policy.critic.q_networks[0] if isinstance(layer, nn.Linear)],
        _layers(folder / "q_func1.pt"),
    )
    return model


def _layers(path: Path) -> list[tuple[torch.Tensor, ...]]:
    """Read (weight, bias) of each linear layer, in order; nothing else is unpickled."""
    state = torch.load(path, map_location="cpu", weights_only=True)
    return [
        (state[f"{i}.weight"], state[f"{i}.bias"])
        for i in sorted({int(name.partition(".")[0]) for name in state})
    ]


def _fill(layers: list[nn.Linear], values: list[tuple[torch.Tensor, ...]]) -> None:
    for layer, (weight, bias) in zip(layers, values, strict=True):
        layer.weight.copy_(weight)
        layer.bias.copy_(bias)
