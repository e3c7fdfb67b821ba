"""Policies: the expert's actor, latent actors, and both on disk.

B rows, P size of a privileged vector, F latent features, A actions.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor, nn

from wasp_cli.models.nets import mlp
from wasp_cli.models.weights import load_module, read_arguments, save_weights

if TYPE_CHECKING:
    from wasp_cli.models.base import Latent


Acts = Literal["mode", "mean"]
"""How a policy that learned with exploration acts without it: by the mode of its Gaussian, cut at
the bounds, or by the mean of what it executed, where each draw was cut.
"""


class PrivilegedPolicy(nn.Module):
    """The action of a PPO actor (tanh layers) on normalised privileged observations, without its
    exploration.
    """

    mean: Tensor  # [P] of observations, by which they are normalised
    std: Tensor  # [P]
    log_std: Tensor  # [A] logarithm of the standard deviation of exploration

    def __init__(
        self, inputs: int, hidden: Sequence[int], action: int, acts: Acts = "mode"
    ) -> None:
        """Build the actor: P = `inputs`, widths of the hidden layers, A = `action`."""
        super().__init__()
        self.acts = acts
        sizes = [inputs, *hidden]
        layers: list[nn.Module] = []
        for a, b in pairwise(sizes):
            layers += [nn.Linear(a, b), nn.Tanh()]
        self.net = nn.Sequential(*layers, nn.Linear(sizes[-1], action))
        self.register_buffer("mean", torch.zeros(inputs))
        self.register_buffer("std", torch.ones(inputs))
        self.register_buffer("log_std", torch.zeros(action))

    def forward(self, privileged: Tensor) -> Tensor:
        """Return actions [B, A] in [-1, 1] for privileged observations [B, P]."""
        centre: Tensor = self.net(((privileged - self.mean) / self.std).clamp(-10, 10))
        if self.acts == "mean":
            return mean_of_clipped(centre, self.log_std.exp())
        return centre.clamp(-1, 1)


def mean_of_clipped(centre: Tensor, deviation: Tensor) -> Tensor:
    """Return E[clip(centre + deviation * e, -1, 1)] for e ~ N(0, 1), element by element.

    With a = (-1 - centre) / deviation, b = (1 - centre) / deviation, the normal density phi and its
    integral Phi, that is 1 - Phi(b) - Phi(a) + centre * (Phi(b) - Phi(a)) + deviation * (phi(a) -
    phi(b)).

    Args:
        centre: [..., A] means before the cut.
        deviation: [A] standard deviations, greater than 0.
    """
    normal = torch.distributions.Normal(torch.zeros_like(deviation), torch.ones_like(deviation))
    low = (-1.0 - centre) / deviation
    high = (1.0 - centre) / deviation
    below = normal.cdf(low)
    above = 1.0 - normal.cdf(high)
    density = normal.log_prob(low).exp() - normal.log_prob(high).exp()
    mean: Tensor = above - below + centre * (1.0 - above - below) + deviation * density
    return mean.clamp(-1, 1)


class LatentPolicy(nn.Module):
    """pi(a | h, z): features [B, F] to a command [B, A] in [-1, 1]."""

    def __init__(self, features: int, hidden: Sequence[int], action: int) -> None:
        """Build the actor, with hidden layers of these widths."""
        super().__init__()
        self.net = mlp(features, hidden, action)

    def forward(self, features: Tensor) -> Tensor:
        """Return commands [B, A] in [-1, 1] at features [B, F]."""
        # Features that were joined from a coded latent (`models.coded`) are read by its classes.
        latent: Latent | None = getattr(features, "latent", None)
        command = self.unbounded(features) if latent is None else latent.through(self.net)
        return command.clamp(-1, 1)

    def unbounded(self, features: Tensor) -> Tensor:
        """Return the output [B, A] before it is cut at the bounds, for a loss whose gradient does
        not vanish there.
        """
        return self.net(features)  # type: ignore[no-any-return]


class Skills(nn.Module):
    """One latent policy per expert checkpoint, by its fraction of the interactions ('0.25',
    '1').
    """

    def __init__(
        self, fractions: Sequence[float], features: int, hidden: Sequence[int], action: int
    ) -> None:
        """Build an actor for each fraction, with hidden layers of these widths."""
        super().__init__()
        self.fractions = tuple(fractions)
        self.actors = nn.ModuleList(LatentPolicy(features, hidden, action) for _ in fractions)
        self.register_buffer("exploration", torch.zeros(action))

    # [A] standard deviation of the expert's own exploration when training ended
    exploration: Tensor

    @property
    def expert(self) -> LatentPolicy:
        """The policy of the last checkpoint."""
        return self.at(1.0)

    def at(self, fraction: float) -> LatentPolicy:
        """Return the policy of a checkpoint.

        Raises:
            KeyError: there is no checkpoint at that fraction.
        """
        for candidate, actor in zip(self.fractions, self.actors, strict=True):
            if abs(candidate - fraction) < 1e-9:
                assert isinstance(actor, LatentPolicy)
                return actor
        available = ", ".join(f"{each:g}" for each in self.fractions)
        raise KeyError(f"no checkpoint at {fraction:g}; there are {available}")


def checkpoint_name(fraction: float) -> str:
    """Return the file name of the privileged policy at a fraction of the interactions."""
    return f"skill-{fraction:g}.safetensors"


def checkpoint_fractions(folder: Path) -> list[float]:
    """Return the fractions of the interactions at which an expert artifact has a policy, in
    ascending order.
    """
    evaluation = json.loads((folder / "evaluation.json").read_text())
    return sorted(float(fraction) for fraction in evaluation)


def save_privileged(
    policy: PrivilegedPolicy, path: Path, inputs: int, hidden: Sequence[int], action: int
) -> None:
    """Write the weights of a privileged policy to `path`, and its constructor's arguments beside
    it.
    """
    save_weights(policy, path, inputs=inputs, hidden=list(hidden), action=action)


def let_act(path: Path, acts: Acts) -> None:
    """Change how a stored privileged policy acts.

    Args:
        path: of its weights, beside which its constructor's arguments lie.
        acts: how it is to act.

    Raises:
        ArtifactError: the arguments cannot be read.
    """
    arguments = {**read_arguments(path), "acts": acts}
    path.with_suffix(".json").write_text(json.dumps(arguments, sort_keys=True, indent=1))


def load_privileged(folder: Path, fraction: float) -> PrivilegedPolicy:
    """Return the frozen privileged policy of a checkpoint of an expert artifact.

    Raises:
        ArtifactError: a file of it cannot be read.
    """
    return load_module(PrivilegedPolicy, folder / checkpoint_name(fraction))


def save_skills(
    skills: Skills, folder: Path, features: int, hidden: Sequence[int], action: int
) -> None:
    """Write `skills.safetensors` to a folder, and its constructor's arguments beside it."""
    path = folder / "skills.safetensors"
    save_weights(
        skills,
        path,
        fractions=list(skills.fractions),
        features=features,
        hidden=list(hidden),
        action=action,
    )


def load_skills(folder: Path) -> Skills:
    """Return the frozen latent policies of a policies artifact.

    Raises:
        ArtifactError: a file of it cannot be read.
    """
    return load_module(Skills, folder / "skills.safetensors")
