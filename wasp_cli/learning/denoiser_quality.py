"""What a denoiser is worth: how near it brings commands to the expert's actions, and how far from what was asked for.

After Yoneda et al. 2023: the forward diffusion ratio trades *conformity* (what is executed is near what the expert would do) against
*fidelity* (it is near the command). K decisions on held-out episodes, A actions.
"""

from __future__ import annotations

import torch
from torch import Tensor

from wasp_cli.methods.diffusion import assist
from wasp_cli.models.denoiser import Denoiser, NoiseSchedule

RATIOS = (0.2, 0.3, 0.4, 0.6)
"""Forward diffusion ratios; at 0 a command stays as it is."""


@torch.inference_mode()
def noise_loss(denoiser: Denoiser, schedule: NoiseSchedule, features: Tensor, expert: Tensor, source: torch.Generator) -> float:
    """Mean squared error of the predicted noise over all levels at expert actions [K, A]; predicting none at all scores 1."""
    level = torch.randint(schedule.steps, (len(expert),), generator=source)
    noise = torch.randn(tuple(expert.shape), generator=source)
    return float((denoiser(features, schedule.diffuse(expert, level, noise), level) - noise).square().mean())


@torch.inference_mode()
def denoiser_quality(
    denoiser: Denoiser, schedule: NoiseSchedule, features: Tensor, expert: Tensor, recorded: Tensor, source: torch.Generator
) -> dict[str, dict[str, dict[str, float]]]:
    """Mean distances by kind of command and ratio: `conformity` to the expert's action, `fidelity` to the command (0 is nearest).

    Args:
        denoiser: trained.
        schedule: its levels.
        features: [K, F]
        expert: [K, A] the expert's own action there.
        recorded: [K, A] what an operator executed there.
        source: of the draws.
    """
    uniform = 2 * torch.rand(tuple(expert.shape), generator=source) - 1
    found: dict[str, dict[str, dict[str, float]]] = {}
    for kind, command in (("expert", expert), ("recorded", recorded), ("uniform", uniform)):
        found[kind] = {"0": _distances(command, command, expert)}
        for ratio in RATIOS:
            k = schedule.forward_level(ratio)
            draws = torch.randn((k + 1, *expert.shape), generator=source)
            found[kind][f"{ratio:g}"] = _distances(assist(denoiser, schedule, features, command, k, draws), command, expert)
    return found


def _distances(executed: Tensor, command: Tensor, expert: Tensor) -> dict[str, float]:
    return {"conformity": float((executed - expert).norm(dim=-1).mean()), "fidelity": float((executed - command).norm(dim=-1).mean())}
