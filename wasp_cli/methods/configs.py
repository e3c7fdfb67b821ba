"""Decision-time configuration of every assistant. Light: `wasp plan` reads it without torch."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from wasp_cli.config import Config, assumed, deviates, from_paper


class HumanConfig(Config):
    """Human-only and Expert: the operator's command is executed as it is."""


class IDAConfig(Config):
    """IDA: override by a copilot when a Q ensemble votes for it."""

    copilot: Literal["expert", "diffusion"] = from_paper(
        "expert", "section 5.1: an expert action; `diffusion` is the original's copilot, the command partly diffused and denoised"
    )
    ratio: float = assumed(
        0.4, "forward diffusion ratio of the copilot `diffusion`: sigma .49, as the original's .2 in its schedule", ge=0.0, le=1.0
    )
    vote: float = assumed(0.99, "class default of the authors' code", gt=-1.0, le=1.0)
    quantile: float = assumed(0.95, "tau_Q: quantile of the least advantage over the members under the expert with noise", gt=0.0, lt=1.0)
    exploration: float = assumed(0.25, "standard deviation of that noise, as in the dataset's near-expert episodes", gt=0.0)


class DiffusionConfig(Config):
    """Diffusion: partial forward and reverse diffusion of the operator's command."""

    ratio: float = assumed(0.4, "forward diffusion ratio gamma_fwd of the original's main experiments", ge=0.0, le=1.0)
    last_noise: bool = assumed(False, "noise at the last reverse step too, as in the original's code: then every command is changed")


class FilterConfig(Config):
    """Safety filter (after Oh et al. 2025): the least correction that keeps one imagined step and V_c behind it below a threshold."""

    tau_c: Annotated[float, Field(gt=0.0)] | Literal["calibrated"] = assumed(
        "calibrated", "bound of Q_c, expected costly decision steps discounted by gamma_c; `calibrated`: a quantile of Q_c under the expert"
    )
    quantile: float = assumed(
        0.95, "which one, over held-out decisions of the unimpaired expert after which nothing cost within W", gt=0.0, lt=1.0
    )
    candidates: int = assumed(
        64, "random actions among which the safest is sought, beside zero and, unless they are more, all corners", ge=1
    )
    segment: int = assumed(32, "points from the command to the safest action at which Q_c is read (the original has 2000)", ge=1)
    rollouts: int = assumed(8, "imagined next states over which Q_c is a mean, the same for every action", ge=1)


class SafeRLConfig(Config):
    """SafeRL-Res: the deterministic mean of the residual policy."""


WASPVariant = Literal["full", "safety-only", "task-only", "no-case2", "no-rollout"]


class Coverage(Config):
    """A threshold by what it has to guarantee, taken from Human-only episodes (stage `coverage`)."""

    coverage: float = assumed(
        0.1, "largest share of costly episodes of the operators alone with an onset before which nothing was foreseen", gt=0.0, lt=1.0
    )


class WASPConfig(Config):
    """WASP: gates (section 4.2) and residual planning (section 4.3). N candidates, M rollouts, H horizon, L residuals."""

    variant: WASPVariant = "full"
    horizon: int = from_paper(15, "H, section 5.1", ge=1)
    residual_steps: int = from_paper(5, "L, section 5.1", ge=1)
    probe: int = from_paper(300, "N_probe, section 5.1", ge=1)
    candidates: int = from_paper(300, "N, section 5.1", ge=2)
    elites: int = from_paper(100, "N_e, section 5.1", ge=1)
    iterations: int = from_paper(6, "I, section 5.1", ge=1)
    rollouts: int = assumed(1, "M: rollouts per candidate, with common random numbers over candidates", ge=1)
    gate_rollouts: int = assumed(8, "rollouts of the nominal gate and of every second scoring", ge=1)
    finalists: int = deviates(
        4, "best plans by either score that are scored again with fresh rollouts; the paper selects the best as scored (0)", ge=0
    )
    recheck: bool = deviates(
        True,
        "the command stands where it is safe on the finalists' fresh rollouts after all and no plan gains more than tau_r; "
        "the paper corrects whenever the safety gate has fired",
    )
    feasible: int = assumed(100, "N_f: safe candidates needed for Case I; N_e as in SafeDreamer", ge=1)
    alpha: float = assumed(0.1, "weight of the squared residual (Eq. 11, 16, 17)", ge=0.0)
    tau_c: Annotated[float, Field(gt=0.0)] | Coverage = assumed(
        0.5,
        "costly decision steps expected within H, discounted by gamma_c, above which the safety gate fires; 0.3 costs less; "
        "`{coverage: 0.1}`: so that of the costly episodes of the operators alone at most this share has an onset without an alert",
    )
    tau_r: float | Literal["calibrated"] = assumed("calibrated", "quantile of the re-scored gain under the unimpaired expert")
    tau_r_quantile: float = assumed(0.95, "which quantile", gt=0.0, lt=1.0)
    tau_r_floor: float = assumed(0.05, "smallest calibrated tau_r: a gain below it is noise", ge=0.0)
    bootstrap_cost: bool = deviates(False, "V_c after H for the cost, as in Eq. 7-8; the discounted sum over H ranks as well")
    bootstrap_reward: bool = deviates(
        False, "V_r after H for the reward, as in Eq. 7-8; the discounted sum over H foresees the operator's next 15 decisions better"
    )
    continuation: bool = deviates(
        True, "what lies behind an imagined end of the episode counts with the probability that it goes on; Eq. 8 knows no ends"
    )
    case2_memory: int = assumed(4, "decisions for which the plan that Case II chose stays a candidate, shifted", ge=0)
    initial_std: float = assumed(0.5, "standard deviation of the first residual distribution", gt=0.0)
    std_floor: float = assumed(0.05, "keeps the distribution from collapsing", gt=0.0)
    momentum: float = assumed(0.1, "weight of the old mean in a CEM update", ge=0.0, lt=1.0)
    composition: Literal["per_step", "hold"] = assumed("per_step", "Eq. 13: a^H_{t+k} + delta_{t+k} as in the text; `hold`: as printed")

    @model_validator(mode="after")
    def _sizes_fit(self) -> WASPConfig:
        if self.residual_steps > self.horizon:
            raise ValueError(f"residual_steps ({self.residual_steps}) is longer than horizon ({self.horizon})")
        for name in ("elites", "feasible", "finalists"):
            for batch in ("candidates", "probe"):  # a probe becomes the first iteration
                if getattr(self, name) > getattr(self, batch):
                    raise ValueError(f"{name} ({getattr(self, name)}) is more than {batch} ({getattr(self, batch)})")
        if self.rollouts > self.gate_rollouts:
            raise ValueError(
                f"rollouts ({self.rollouts}) is more than gate_rollouts ({self.gate_rollouts}), with which it shares its draws"
            )
        return self
