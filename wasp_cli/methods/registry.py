"""The assistants by name. Adding one is a module with its class, a config in `configs` and one line here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from wasp_cli.registry import Registry


@dataclass(frozen=True)
class MethodInfo:
    """What is known of an assistant without importing torch."""

    name: str
    title: str
    """Name in tables."""
    target: str
    """Import string of what makes the `Assistant` from its configuration and `Parts`."""
    config: str
    """Import string of its config model."""
    needs: tuple[str, ...] = ()
    """Stage kinds whose artifacts it reads, besides `world_model` and `policies`."""
    needs_with: tuple[tuple[str, str, str], ...] = ()
    """Further ones that it reads only under a setting: (field of its configuration, value, stage kind)."""
    calibrated: bool = False
    """Whether its thresholds come from held-out episodes of the unimpaired expert (stage `calibration`)."""
    impaired: bool = True
    """False for the reference row: it runs the unimpaired operator, once for all variants."""
    intervenes: bool = True
    """False where the operator's command is always executed, so that there is no intervention to ask about."""
    variants: tuple[str, ...] = ("full",)
    """Ablations that are configurations of the same class."""
    own_thresholds: tuple[str, ...] = ()
    """Variants whose thresholds have another unit, so that they are calibrated by themselves."""

    def needs_of(self, config: Mapping[str, Any]) -> tuple[str, ...]:
        """The stage kinds that it reads under a configuration (resolved, as JSON values)."""
        return (*self.needs, *(kind for field, value, kind in self.needs_with if config.get(field) == value))


METHODS: Registry[MethodInfo] = Registry(
    "method",
    "wasp.methods",
    (
        MethodInfo("human", "Human-only", "wasp_cli.methods.human:HumanOnly", "wasp_cli.methods.configs:HumanConfig", intervenes=False),
        MethodInfo(
            "ida",
            "IDA",
            "wasp_cli.methods.ida:IDA",
            "wasp_cli.methods.configs:IDAConfig",
            ("ida_q",),
            needs_with=(("copilot", "diffusion", "denoiser"),),
            calibrated=True,
        ),
        MethodInfo(
            "diffusion", "Diffusion", "wasp_cli.methods.diffusion:Diffusion", "wasp_cli.methods.configs:DiffusionConfig", ("denoiser",)
        ),
        MethodInfo("saferl", "SafeRL-Res", "wasp_cli.methods.saferl:SafeRLRes", "wasp_cli.methods.configs:SafeRLConfig", ("residual",)),
        MethodInfo(
            "wasp",
            "WASP",
            "wasp_cli.methods.wasp.assistant:wasp",
            "wasp_cli.methods.configs:WASPConfig",
            ("critics",),
            calibrated=True,
            variants=("full", "safety-only", "task-only", "no-case2", "no-rollout"),
            own_thresholds=("no-rollout",),
        ),
        MethodInfo(
            "expert", "Expert", "wasp_cli.methods.human:HumanOnly", "wasp_cli.methods.configs:HumanConfig", impaired=False, intervenes=False
        ),
        MethodInfo(
            "filter",
            "Safety filter",
            "wasp_cli.methods.filter:SafetyFilter",
            "wasp_cli.methods.configs:FilterConfig",
            ("critics",),
            calibrated=True,
        ),
    ),
)
