"""The presets: sizes and budgets that a spec overrides. `cpu` has the defaults of the config
models, except for the planner.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wasp_cli.stages.registry import STAGES

Document = Mapping[str, Any]

PLANNERS = ("wasp", "ida-guarded", "planner")  # the methods that search as WASP does
# Planner of the feasibility study: a decision in 0.6 s on two cores; the models' defaults are the
# paper's sizes.
_CPU_SEARCH: Document = {"candidates": 64, "elites": 20, "iterations": 3, "feasible": 20}
_CPU: Document = {
    **dict.fromkeys(PLANNERS, _CPU_SEARCH),
    "printed": {**_CPU_SEARCH, "probe": 64, "rollouts": 2},
}

# Everything runs, nothing is learned: the code paths of every stage and method in about a minute.
_SMOKE_SEARCH: Document = {
    "candidates": 8,
    "elites": 3,
    "feasible": 3,
    "iterations": 2,
    "rollouts": 1,
}
_SMOKE: Document = {
    "episodes": 2,
    "expert": {
        "interactions": 2000,
        "envs": 8,
        "rollout": 32,
        "batch": 64,
        "hidden": [32, 32],
        "evaluation_episodes": 2,
    },
    "dataset": {"steps": 600, "envs": 4},
    "world_model": {
        "deter": 32,
        "hidden": 32,
        "variables": 4,
        "classes": 4,
        "depth": 4,
        "head": 32,
        "batch": 4,
        "length": 16,
        "updates": 20,
        "warmup": 5,
        "ahead_starts": 8,
        "ahead_images": 4,
        "refit_updates": 5,
        "refit_starts": 16,
        "checkpoint_every": 10,
        "taught": 20,
        "taught_batch": 16,
        "taught_head": 32,
    },
    "diagnostics": {"episodes": 4, "starts": 60, "samples": 2, "image_starts": 4},
    "policies": {
        "updates": 20,
        "batch": 64,
        "hidden": [32, 32],
        "evaluation_episodes": 1,
        "labelling_rounds": 1,
        "labelling_episodes": 2,
        "labelling_updates": 5,
        "reinforce": {"interactions": 128, "envs": 4, "rollout": 32, "batch": 64},
    },
    "critics": {"updates": 5, "starts": 16, "hidden": [32, 32], "q_updates": 5, "q_batch": 16},
    "clone": {"updates": 5, "batch": 32, "hidden": [16]},
    "heldout": {"episodes": 2},
    "ida_q": {"updates": 20, "batch": 64, "hidden": [32, 32]},
    "denoiser": {"updates": 50, "batch": 64, "hidden": [32, 32]},
    "consistency": {"teacher_updates": 50, "updates": 50, "batch": 64, "width": 32, "depth": 2},
    "reachability": {"updates": 10, "batch": 16, "hidden": 32},
    "fallback": {"updates": 10, "batch": 16, "hidden": 32},
    "adversary": {"updates": 3, "batch": 8, "hidden": 16},
    "residual": {"interactions": 512, "envs": 4, "rollout": 32, "batch": 64, "hidden": [32, 32]},
    "calibration": {"decisions": 20},
    "severity": {"episodes": 2},
    "operating": {"episodes": 2},
    "counterfactual": {"window": 4, "most": 3},
    "ida": {"vote": 0.0, "quantile": 0.5},
    "ida-least": {"vote": 0.0, "quantile": 0.5},  # an untrained ensemble must act too
    "filter": {"candidates": 8, "segment": 8, "rollouts": 2, "quantile": 0.5},
    "reach": {"candidates": 8, "segment": 8, "quantile": 0.5},
    "qcbf": {"steps": 4, "segment": 8, "quantile": 0.5},
    **dict.fromkeys(("wasp", "planner"), _SMOKE_SEARCH),
    "ida-guarded": {**_SMOKE_SEARCH, "vote": 0.0, "quantile": 0.5},
    "mpmi": {"candidates": 8, "rollouts": 1, "quantile": 0.5},
    "printed": {**_SMOKE_SEARCH, "probe": 8},
}

# Minutes on two cores for one task with one seed: small, but every method has learned something.
# Where time is short, many small updates of the world model beat few large ones.
_QUICK_SEARCH: Document = {"candidates": 32, "elites": 10, "iterations": 3, "feasible": 10}
_QUICK: Document = {
    "episodes": 10,
    "expert": {
        "interactions": 320_000,
        "gamma": 0.97,
        "multiplier_init": 0.2,
        "multiplier_lr": 0.02,
        "evaluation_episodes": 10,
    },
    "dataset": {"steps": 24_000, "envs": 16},
    "world_model": {
        "deter": 192,
        "hidden": 128,
        "variables": 24,
        "classes": 16,
        "depth": 8,
        "head": 96,
        "batch": 8,
        "length": 16,
        "updates": 1500,
        "taught": 1000,
        "warmup": 100,
        "learning_rate": 1e-3,
        "decode_share": 0.25,
        "ahead_starts": 32,
        "ahead_images": 16,
        "refit_updates": 300,
    },
    "diagnostics": {"episodes": 8, "starts": 2000, "image_starts": 48},
    "policies": {
        "updates": 1500,
        "batch": 256,
        "evaluation_episodes": 20,
        "labelling_rounds": 2,
        "labelling_episodes": 24,
        "labelling_updates": 800,
        "reinforce": {"interactions": 60_000, "envs": 16, "return_share": 0.75},
    },
    "critics": {"updates": 500, "starts": 64, "slow": 0.3},
    "heldout": {"episodes": 16},
    "ida_q": {"updates": 2500, "batch": 128, "hidden": [128, 128]},
    "denoiser": {"updates": 3000, "batch": 256},
    "consistency": {"teacher_updates": 1500, "updates": 2000, "batch": 256},
    "reachability": {"updates": 800},
    "fallback": {"updates": 1500},
    "adversary": {"updates": 150},
    "residual": {"interactions": 64_000},
    "calibration": {"decisions": 300},
    "severity": {"episodes": 10},
    "operating": {"episodes": 10},
    "counterfactual": {"most": 30},
    **dict.fromkeys(PLANNERS, _QUICK_SEARCH),
    "printed": {**_QUICK_SEARCH, "probe": 32, "rollouts": 1},
}

# Sizes for a large GPU, and the planner's are the paper's. The world model trains, latents are
# filtered and assistants are evaluated on one where torch sees it; the other stages still compute
# on the CPU, where these sizes take very long.
_GPU: Document = {
    "expert": {"interactions": 800_000},
    "dataset": {"steps": 200_000},
    "world_model": {
        "deter": 512,
        "hidden": 256,
        "variables": 32,
        "classes": 16,
        "depth": 32,
        "head": 256,
        "batch": 16,
        "length": 64,
        "updates": 20_000,
        "warmup": 1000,
        "learning_rate": 4e-4,
        "decode_share": 1.0,
        "refit_updates": 2000,
    },
    "policies": {
        "updates": 5000,
        "hidden": [256, 256],
        "reinforce": {"interactions": 1_000_000, "envs": 32},
    },
    "critics": {
        "updates": 5000,
        "starts": 512,
        "hidden": [256, 256],
        "q_updates": 10_000,
        "q_batch": 512,
    },
    "denoiser": {"updates": 30_000, "batch": 4096},
    "consistency": {
        "teacher_updates": 15_000,
        "updates": 20_000,
        "batch": 4096,
        "width": 256,
        "depth": 4,
    },
    "residual": {"interactions": 1_000_000, "envs": 32},
}

# The paper's planner (M = 8; 5 in WASP's search), over models that have seen more than `cpu` gives
# them. Budgets of training are not in the paper; these are about four times `cpu`.
_PAPER: Document = {
    "expert": {"interactions": 1_600_000},
    "dataset": {"steps": 200_000},
    "world_model": {"updates": 8000, "refit_updates": 1500},
    "policies": {"updates": 4000, "reinforce": {"interactions": 1_000_000}},
    "critics": {"updates": 4000},
    "heldout": {"episodes": 30},
    "ida_q": {"updates": 10_000},
    "denoiser": {"updates": 30_000, "batch": 4096},
    "consistency": {
        "teacher_updates": 15_000,
        "updates": 20_000,
        "batch": 4096,
        "width": 256,
        "depth": 4,
    },
    "residual": {"interactions": 1_000_000},
    **{
        name: {
            "candidates": 300,
            "elites": 100,
            "iterations": 6,
            "search_rollouts": 5,
            "feasible": 100,
        }
        for name in PLANNERS
    },
    "printed": {"probe": 300, "candidates": 300, "elites": 100, "iterations": 6, "feasible": 100},
}

PRESETS: Mapping[str, Document] = {
    "smoke": _SMOKE,
    "quick": _QUICK,
    "cpu": _CPU,
    "gpu": _GPU,
    "paper": _PAPER,
}


def preset_values(name: str) -> dict[str, Any]:
    """Return the values of a preset, with sections of plugins' stages; empty for an unknown
    name.
    """
    if name not in PRESETS:
        return {}
    sections = {kind: info.presets[name] for kind, info in STAGES.items() if name in info.presets}
    return merged(PRESETS[name], sections)


def merged(under: Document, over: Document, *, removes: bool = False) -> dict[str, Any]:
    """Lay `over` on top of `under`: sections merge key by key, and everything else (lists too) is
    replaced.

    Null in place of a section changes nothing; with `removes`, it removes the section of `under`.
    """
    result = dict(under)
    for key, value in over.items():
        below = result.get(key)
        if value is None and isinstance(below, Mapping):
            if removes:
                del result[key]
            continue
        if isinstance(below, Mapping) and isinstance(value, Mapping):
            value = merged(below, value, removes=removes)
        result[key] = value
    return result
