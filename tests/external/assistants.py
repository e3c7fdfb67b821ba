"""Our Diffusion and our IDA for an external world: what they learn from is the expert's flights
that reached the goal.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3 import SAC
from torch import Tensor, nn

from tests.external.expert import actor
from tests.external.flights import WORLD, alone
from tests.external.lander import CHUNKS, SEEN, GoalLander, Kind
from wasp_cli.learning.configs.baselines import DenoiserConfig
from wasp_cli.learning.denoiser import denoiser_quality, noise_loss, train_denoiser
from wasp_cli.learning.latents import Latents
from wasp_cli.learning.sampling import generator
from wasp_cli.learning.shards import HELD_OUT, Recording
from wasp_cli.methods.base import Assistant, Parts
from wasp_cli.methods.configs import DiffusionConfig, IDAConfig
from wasp_cli.methods.diffusion import Diffusion
from wasp_cli.methods.ida import IDA
from wasp_cli.models.ensemble import QEnsemble
from wasp_cli.models.policy import Skills
from wasp_cli.models.weights import save_weights
from wasp_cli.seeds import derive

ROWS = 1_000_000  # decisions that are demonstrated; the authors have ten millions
TOGETHER = 100
# candidates among which IDA votes where targets are in the air; pads have but nine places
TARGETS = 24


def fly_demonstrations(kind: Kind, model: SAC, path: Path, report: Callable[[str], None]) -> None:
    """Write states [N, 8], the expert's actions there [N, 2] and the number of the episode [N]
    of flights that reached the goal.
    """
    states, actions, episodes, count, number = [], [], [], 0, 0
    while count < ROWS:
        worlds = [derive("external-demonstration", kind, number + i) for i in range(TOGETHER)]
        loop = alone(kind, "expert", actor(model), worlds, keep=True)
        for column in np.flatnonzero(loop.goals.any(0)):
            alive = loop.alive[:, column]
            states.append(loop.h[torch.from_numpy(alive), column].numpy())
            actions.append(loop.a_h[alive, column])
            episodes.append(np.full(alive.sum(), number + column, np.int32))
            count += len(episodes[-1])
        number += TOGETHER
        report(f"{kind}: {count} of {ROWS} demonstrated decisions")
    np.savez(
        path,
        state=np.concatenate(states),
        action=np.concatenate(actions),
        episode=np.concatenate(episodes),
    )


def learn_denoiser(
    kind: Kind,
    demonstrations: Path,
    folder: Path,
    config: DenoiserConfig,
    report: Callable[[str], None],
) -> dict[str, Any]:
    """Train Diffusion's denoiser and return how well it does on flights that it has not seen
    (`learning.denoiser`).
    """
    with np.load(demonstrations) as shown:
        state, labels = torch.from_numpy(shown["state"]), torch.from_numpy(shown["action"])
        empty = dict.fromkeys(Recording._fields, np.zeros(0)) | {"episode": shown["episode"]}
    recording = Recording(**empty)
    latents = Latents(state, torch.zeros(len(state), 0, dtype=torch.uint8), 1)
    torch.manual_seed(derive("external-denoiser-weights", kind))
    denoiser, schedule, summary = train_denoiser(
        recording,
        labels,
        latents,
        config,
        derive("external-denoiser", kind),
        lambda share, text: report(f"{kind}: {text}"),
    )
    save_weights(
        denoiser,
        folder / "denoiser.safetensors",
        features=SEEN,
        action=labels.shape[1],
        hidden=list(config.hidden),
        steps=schedule.steps,
        schedule={"steps": config.steps, "beta_min": config.beta_min, "beta_max": config.beta_max},
    )
    held = torch.from_numpy(np.flatnonzero(recording.held_out(HELD_OUT)))
    held = held[:: max(1, len(held) // 4000)]
    source = generator(derive("external-denoiser-quality", kind))
    seen, expert = latents.at(held).features, labels[held]
    summary["heldout_noise_loss"] = noise_loss(denoiser, schedule, seen, expert, source)
    found = summary | {
        "updates": config.updates,
        "batch": config.batch,
        "quality": denoiser_quality(denoiser, schedule, seen, expert, expert, source),
    }
    (folder / "quality.json").write_text(json.dumps(found))
    return found


def candidates(kind: Kind) -> Tensor:
    """Return the goals [K, G] that may be meant: the nine pads, or targets drawn as the world
    draws them.
    """
    if kind == "lander":
        return torch.linspace(-1, 1, CHUNKS)[1:-1, None]
    world = GoalLander(kind)
    return torch.from_numpy(
        np.stack([world.reset(seed=derive("external-target", i))[0][SEEN:] for i in range(TARGETS)])
    )


@torch.no_grad()
def votes(model: SAC, goals: Tensor) -> QEnsemble:
    """Return the expert's critic as an ensemble over goals [K, G]: member k says what an action is
    worth if goal k is meant.

    This is the original's intervention score, with its goals inserted: in the first layer a goal is
    a bias.
    """
    first, *rest = (
        layer for layer in model.policy.critic.q_networks[0] if isinstance(layer, nn.Linear)
    )
    actions = model.action_space.shape[0]
    ensemble = QEnsemble(
        len(goals),
        SEEN,
        actions,
        [first.out_features, *(layer.out_features for layer in rest[:-1])],
    )
    seen, goal, action = first.weight.split([SEEN, goals.shape[1], actions], 1)
    ensemble.weights[0].copy_(torch.cat([seen, action], 1).T.expand_as(ensemble.weights[0]))
    ensemble.biases[0].copy_((first.bias + goals @ goal.T).unsqueeze(1))
    for layer, weight, bias in zip(rest, ensemble.weights[1:], ensemble.biases[1:], strict=True):
        weight.copy_(layer.weight.T.expand_as(weight))
        bias.copy_(layer.bias.expand_as(bias))
    return ensemble


def save_votes(kind: Kind, model: SAC, folder: Path) -> None:
    """Write IDA's ensemble for a world."""
    ensemble = votes(model, candidates(kind))
    hidden = [weight.shape[2] for weight in ensemble.weights[:-1]]
    save_weights(
        ensemble,
        folder / "ensemble.safetensors",
        members=ensemble.members,
        features=SEEN,
        action=2,
        hidden=hidden,
    )


def parts(folder: Path) -> Parts:
    """Return what assistants are built from. Nobody's policy is among it: without the goal
    there is none.
    """
    nobody = Skills((1.0,), SEEN, (1,), 2)
    inputs = {"denoiser": folder, "ida_q": folder}
    return Parts(WORLD, nobody, inputs, {}, gamma_r=0.99, gamma_c=0.99, lam=0.95)


def assistant(name: str, ratio: float, folder: Path) -> Assistant:
    """Build `diffusion` at a ratio, or `ida`, whose copilot it is: a_c instead of a_h where
    every possible goal is better served by it.
    """
    if name == "diffusion":
        return Diffusion(DiffusionConfig(ratio=ratio), parts(folder))
    return IDA(IDAConfig(copilot="diffusion", ratio=ratio), parts(folder))
