"""Small untrained artifacts of every kind that assistants read."""

import json
from pathlib import Path

import torch

from wasp_cli.models.adversary import Adversary
from wasp_cli.models.base import Latent
from wasp_cli.models.consistency import Consistency
from wasp_cli.models.critics import LatentCritics
from wasp_cli.models.denoiser import Denoiser, NoiseSchedule
from wasp_cli.models.ensemble import QEnsemble
from wasp_cli.models.fallback import SafetyActor
from wasp_cli.models.policy import (
    PrivilegedPolicy,
    Skills,
    checkpoint_name,
    save_privileged,
    save_skills,
)
from wasp_cli.models.reachability import SafetyValue
from wasp_cli.models.residual import ResidualPolicy
from wasp_cli.models.weights import save_weights
from wasp_cli.models.world_model import SafetyWorldModel, Sizes, save_world_model

SIZES = Sizes(
    action=2,
    deter=12,
    hidden=8,
    variables=2,
    classes=4,
    depth=2,
    head=8,
    unimix=0.01,
    reward_scale=5.0,
    cost_weight=5.0,
)


def tiny_artifacts(root: Path) -> dict[str, Path]:
    """Folders by stage kind, written below `root`."""
    torch.manual_seed(0)
    kinds = (
        "world_model",
        "policies",
        "critics",
        "ida_q",
        "denoiser",
        "consistency",
        "reachability",
        "fallback",
        "adversary",
        "residual",
        "calibration",
    )
    folders = {kind: root / kind for kind in kinds}
    for folder in folders.values():
        folder.mkdir(parents=True)
    model = SafetyWorldModel(SIZES)
    # an untrained reward head is zero; here rewards should differ
    torch.nn.init.normal_(model.reward_head[-1].weight)
    save_world_model(model, folders["world_model"])
    skills = Skills([0.25, 1.0], model.feature_size, [8], 2)
    skills.exploration.fill_(0.3)
    save_skills(skills, folders["policies"], model.feature_size, [8], 2)
    save_weights(
        LatentCritics(model.feature_size, [8]),
        folders["critics"] / "critics.safetensors",
        features=model.feature_size,
        hidden=[8],
    )
    ensemble = {"members": 3, "features": model.feature_size, "action": 2, "hidden": [8]}
    save_weights(
        QEnsemble(3, model.feature_size, 2, [8]),
        folders["ida_q"] / "ensemble.safetensors",
        **ensemble,
    )
    schedule = {"steps": 10, "beta_min": 1e-4, "beta_max": 0.26}
    denoiser = {
        "features": model.feature_size,
        "action": 2,
        "hidden": [8],
        "steps": NoiseSchedule(**schedule).steps,
    }
    save_weights(
        Denoiser(**denoiser),
        folders["denoiser"] / "denoiser.safetensors",
        **denoiser,
        schedule=schedule,
    )
    consistency = {"features": model.feature_size, "action": 2, "width": 8, "depth": 2}
    save_weights(
        Consistency(**consistency),
        folders["consistency"] / "consistency.safetensors",
        **consistency,
    )
    safety = {"features": model.feature_size, "action": 2, "hidden": 8, "action_scales": [1.0, 0.1]}
    save_weights(SafetyValue(**safety), folders["reachability"] / "safety.safetensors", **safety)
    residual = {"features": model.feature_size, "action": 2, "hidden": [8]}
    save_weights(
        ResidualPolicy(**residual), folders["residual"] / "residual.safetensors", **residual
    )
    save_weights(SafetyValue(**safety), folders["fallback"] / "safety.safetensors", **safety)
    actor = {"features": model.feature_size, "action": 2, "hidden": [8]}
    save_weights(SafetyActor(**actor), folders["fallback"] / "actor.safetensors", **actor)
    disturbing = {
        "deter": SIZES.deter,
        "variables": SIZES.variables,
        "classes": SIZES.classes,
        "hidden": [8],
    }
    adversary = Adversary(**disturbing)
    torch.nn.init.normal_(adversary.net[-1].weight)
    adversary.radius.fill_(0.5)
    adversary.threshold.fill_(100.0)
    save_weights(adversary, folders["adversary"] / "adversary.safetensors", **disturbing)
    (folders["calibration"] / "calibration.json").write_text(
        json.dumps({"tau_r": 0.1, "tau_q": 0.0})
    )
    return folders


def tiny_latents(rows: int, seed: int) -> Latent:
    """Random ones of the tiny world model."""
    source = torch.Generator().manual_seed(seed)
    h = torch.randn(rows, SIZES.deter, generator=source)
    drawn = torch.randint(SIZES.classes, (rows, SIZES.variables), generator=source)
    return Latent(h, torch.nn.functional.one_hot(drawn, SIZES.classes).float().flatten(1))


def tiny_expert(folder: Path, inputs: int) -> Path:
    """The untrained privileged policies, of observations [B, inputs], of the two skills above;
    returns their folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(1)
    for fraction in (0.25, 1.0):
        policy = PrivilegedPolicy(inputs, [8], 2)
        save_privileged(policy, folder / checkpoint_name(fraction), inputs, [8], 2)
    return folder
