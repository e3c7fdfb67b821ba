"""Decision-time configuration of every assistant. It imports no torch, so that `wasp plan` is
fast.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from wasp_cli.config import Config, assumed, from_paper


class HumanConfig(Config):
    """Human-only and Expert: the operator's command is executed as it is."""


class IDAConfig(Config):
    """IDA: override by a copilot when a Q ensemble votes for it."""

    copilot: Literal["expert", "diffusion"] = from_paper(
        "expert",
        "section 5.1: an expert action; `diffusion` is the original's copilot, the command "
        "partly diffused and denoised",
    )
    ratio: float = assumed(
        0.4,
        "forward diffusion ratio of the copilot `diffusion`; it gives sigma .45, as .2 does in "
        "the original's schedule",
        ge=0.0,
        le=1.0,
    )
    vote: float = assumed(0.99, "class default of the authors' code", gt=-1.0, le=1.0)
    quantile: float = assumed(
        0.95,
        "quantile that gives tau_Q: of the margin at which the vote tips, under the expert with "
        "exploration noise",
        gt=0.0,
        lt=1.0,
    )
    exploration: float = assumed(
        0.25,
        "standard deviation of the exploration noise, as in the dataset's near-expert episodes",
        gt=0.0,
    )


class DiffusionConfig(Config):
    """Diffusion: partial forward and reverse diffusion of the operator's command."""

    ratio: float = assumed(
        0.4,
        "forward diffusion ratio gamma_fwd; .4 in the original's main experiments",
        ge=0.0,
        le=1.0,
    )
    last_noise: bool = assumed(
        False,
        "draw noise at the last reverse step too, as in the original's code: then every command "
        "is changed",
    )


class CSAConfig(Config):
    """CSA: the operator's command is denoised in one step."""

    ratio: float = assumed(
        0.69,
        "level at which the command is denoised, as a share of the ladder of noise levels; .69 is "
        "9 of 30 from the top (sigma 11.5), as for the Lunar Lander in the authors' code; theirs "
        "for PointGoal1 is .03 (sigma .0045), at which hardly a command is changed",
        ge=0.0,
        le=1.0,
    )


class FilterConfig(Config):
    """Safety filter (after Oh et al. 2025): the least correction that keeps one imagined step
    and V_c behind it below a threshold.
    """

    tau_c: Annotated[float, Field(gt=0.0)] | Literal["calibrated"] = assumed(
        "calibrated",
        "bound of Q_c, the costly decisions expected of an action, discounted by gamma_c; "
        "`calibrated`: a quantile of Q_c under the expert",
    )
    quantile: float = assumed(
        0.95,
        "quantile that gives tau_c, over held-out decisions of the unimpaired expert after which "
        "nothing cost within W",
        gt=0.0,
        lt=1.0,
    )
    candidates: int = assumed(
        64,
        "random actions among which the safest is sought, besides zero and all corners; the "
        "corners are left out where they are more than these",
        ge=1,
    )
    segment: int = assumed(
        32,
        "points from the command to the safest action at which Q_c is read (the original has 2000)",
        ge=1,
    )
    rollouts: int = assumed(
        8,
        "imagined next states of each action, over which Q_c is a mean, with common random numbers",
        ge=1,
    )


class MPMIConfig(Config):
    """MPMI (Broad et al. 2019): many inputs are imagined to be held over the horizon, and the safe
    one nearest to the command is executed.
    """

    tau_c: Annotated[float, Field(gt=0.0)] | Literal["calibrated"] = assumed(
        "calibrated",
        "bound of the costly decisions expected within H if an input is held; `calibrated`: a "
        "quantile of them under the expert",
    )
    quantile: float = assumed(
        0.95,
        "quantile that gives tau_c, over held-out decisions of the unimpaired expert after which "
        "nothing cost within W",
        gt=0.0,
        lt=1.0,
    )
    horizon: int = assumed(
        5,
        "H: .4 s on Goal1, .8 s on the cars; the original has 25 steps at 60 Hz and 30 at 100 Hz",
        ge=1,
    )
    candidates: int = assumed(
        64, "inputs imagined where the command is unsafe; the original has 10,000 on a GPU", ge=1
    )
    rollouts: int = assumed(
        8,
        "M: rollouts of each input, with common random numbers; the original's model is "
        "deterministic",
        ge=1,
    )


class ReachConfig(Config):
    """Reachability filter: the action nearest to the command with Q >= gamma V; Q and V come from
    the stage `reachability`.
    """

    gamma: Annotated[float, Field(ge=0.0, le=1.0)] | Literal["calibrated"] = assumed(
        "calibrated",
        "share of V that an action must keep (0.9 in LatentCBF's code); `calibrated`: a "
        "quantile of Q / V under the expert",
    )
    quantile: float = assumed(
        0.95,
        "share of the expert's commands that stand at the calibrated gamma, over held-out "
        "decisions after which nothing cost within W",
        gt=0.0,
        lt=1.0,
    )
    candidates: int = assumed(
        256,
        "actions, spread over the bounds, among which the nearest is sought, besides the extreme "
        "ones (25 in LatentCBF's code)",
        ge=1,
    )
    segment: int = assumed(
        32,
        "points from the command to the fallback's action, among which it is sought too",
        ge=1,
    )


class QCBFConfig(Config):
    """Q-CBF filter: the action nearest to the command with Q >= gamma V; Q and the fallback policy
    come from the stage `fallback`.
    """

    gamma: Annotated[float, Field(ge=0.0, le=1.0)] | Literal["calibrated"] = assumed(
        "calibrated",
        "share of V that an action must keep (0.7 in the paper); `calibrated`: a quantile of "
        "Q / V under the expert",
    )
    quantile: float = assumed(
        0.95,
        "share of the expert's commands that stand at the calibrated gamma, over held-out "
        "decisions after which nothing cost within W",
        gt=0.0,
        lt=1.0,
    )
    steps: int = assumed(
        20,
        "normalised gradient steps from the command at most (10 in the laboratory's code, where "
        "actions are near each other)",
        ge=0,
    )
    step: float = assumed(0.1, "length of a gradient step (.05 in the laboratory's code)", gt=0.0)
    segment: int = assumed(
        32,
        "points on the way to the fallback's action, and to where the steps led (2000 in the "
        "paper, which does not bisect afterwards)",
        ge=1,
    )
    halvings: int = assumed(
        8,
        "bisections between the first point with Q >= gamma V and the one before (10 in the "
        "laboratory's code)",
        ge=0,
    )


class SafeRLConfig(Config):
    """SafeRL-Res: the mean of the residual policy is added; nothing is set."""


WASPVariant = Literal["full", "safety-only", "task-only", "no-case2", "no-rollout"]


class WASPConfig(Config):
    """WASP: the command, then the expert, beside the correction, then the expert. N candidates,
    M rollouts, H horizon, L residuals.
    """

    variant: WASPVariant = "full"
    horizon: int = from_paper(15, "H, section 5.1", ge=1)
    residual_steps: int = from_paper(5, "L, section 5.1", ge=1)
    rollouts: int = assumed(
        8,
        "M: rollouts of each future, with common random numbers; the paper has one M and "
        "does not give it",
        ge=1,
    )
    tau_c: Annotated[float, Field(gt=0.0)] | Literal["calibrated", "auto"] = assumed(
        1.0,
        "costly decisions expected within H, discounted by gamma_c, above which the safety gate "
        "fires; `calibrated`: a quantile of them under the expert; `auto`: a quarter of what an "
        "incident of the dataset costs, at most 1, which is the default on tasks of your own",
    )
    tau_c_quantile: float = assumed(
        0.95,
        "quantile that gives tau_c, over held-out decisions of the unimpaired expert after which "
        "nothing cost within W",
        gt=0.0,
        lt=1.0,
    )
    error_lasts: float = assumed(
        0.0,
        "share of the operator's error (the command minus the expert's action) that is left a "
        "decision later, in a further imagined future; 0: the safety gate imagines the command "
        "once, then the expert, and no such future",
        ge=0.0,
        le=1.0,
    )
    tau_r: float | Literal["calibrated"] = assumed(
        "calibrated",
        "return that a correction must gain; `calibrated`: what the correction of a uniformly "
        "random command gains on average, times `tau_r_share`",
    )
    tau_r_share: float = assumed(
        1.0, "factor of the calibrated tau_r; a smaller one intervenes more often", ge=0.0
    )
    candidates: int = from_paper(300, "N, section 5.1", ge=4)
    elites: int = from_paper(100, "N_e, section 5.1", ge=1)
    iterations: int = from_paper(6, "I, section 5.1", ge=1)
    search_rollouts: int = assumed(
        1, "rollouts of each candidate of the search: the first ones of the M", ge=1
    )
    feasible: int = assumed(
        100, "N_f: safe candidates needed for Case I; N_e as in SafeDreamer", ge=1
    )
    alpha: float = assumed(0.02, "weight of the squared residual (Eq. 16, 17)", ge=0.0)
    initial_std: float = assumed(
        0.5, "standard deviation of the first residual distribution", gt=0.0
    )
    patience: Annotated[int, Field(ge=1)] | Literal["horizon"] | None = assumed(
        None,
        "decisions in a row without a safe plan, at which the expert's action would have gained "
        "tau_r, after which that action is executed for as many, or until its future is safe; "
        "`horizon`: H, which is the default on tasks of one's own; null: the plan of least cost is "
        "executed for as long as none is safe",
    )
    adversary: Literal["none", "lucid"] = assumed(
        "none",
        "what disturbs the imagined transitions from which a gate's costs come; `lucid`: the "
        "network of the stage `adversary`, within a calibrated budget",
    )
    adversary_budget: float = assumed(1.0, "factor of the calibrated budget", ge=0.0)

    @model_validator(mode="after")
    def _sizes_fit(self) -> WASPConfig:
        _check_sizes(self)
        if self.search_rollouts > self.rollouts:
            raise ValueError(
                f"search_rollouts ({self.search_rollouts}) is more than rollouts "
                f"({self.rollouts}), of which it takes the first"
            )
        return self


class PrintedConfig(Config):
    """WASP as printed (section 4): the paper's constants, and what the paper leaves open. N
    candidates, M rollouts, H horizon, L residuals.
    """

    variant: WASPVariant = "full"
    horizon: int = from_paper(15, "H, section 5.1", ge=1)
    residual_steps: int = from_paper(5, "L, section 5.1", ge=1)
    probe: int = from_paper(300, "N_probe, section 5.1", ge=1)
    candidates: int = from_paper(300, "N, section 5.1", ge=2)
    elites: int = from_paper(100, "N_e, section 5.1", ge=1)
    iterations: int = from_paper(6, "I, section 5.1", ge=1)
    rollouts: int = assumed(8, "M: rollouts of each candidate", ge=1)
    feasible: int = assumed(
        100, "N_f: safe candidates needed for Case I; N_e as in SafeDreamer", ge=1
    )
    alpha: float = assumed(0.1, "weight of the squared residual (Eq. 11, 16, 17)", ge=0.0)
    tau_c: Annotated[float, Field(gt=0.0)] | Literal["calibrated"] = assumed(
        "calibrated",
        "bound of the cost return; `calibrated`: a quantile of the nominal one under the "
        "unimpaired expert",
    )
    tau_c_quantile: float = assumed(
        0.95,
        "quantile that gives tau_c, over held-out decisions after which nothing cost within W",
        gt=0.0,
        lt=1.0,
    )
    tau_r: float | Literal["calibrated"] = assumed(
        "calibrated",
        "return that a correction must gain; `calibrated`: a quantile of Delta G_t under the "
        "unimpaired expert",
    )
    tau_r_quantile: float = assumed(
        0.95,
        "quantile that gives tau_r, over held-out decisions at which the safety gate is silent",
        gt=0.0,
        lt=1.0,
    )
    initial_std: float = assumed(
        0.5, "sigma_0: standard deviation of the first residual distribution", gt=0.0
    )

    @model_validator(mode="after")
    def _sizes_fit(self) -> PrintedConfig:
        _check_sizes(self)
        return self


class GuardedIDAConfig(IDAConfig, WASPConfig):
    """IDA with the least correction, and WASP's safety gate behind it: the settings of both."""

    tau_c: Annotated[float, Field(gt=0.0)] | Literal["auto"] = assumed(
        1.0,
        "costly decisions expected within H, discounted by gamma_c, above which the safety gate "
        "fires; `auto`: as for WASP",
    )
    adversary: Literal["none"] = "none"


class PlannerConfig(WASPConfig):
    """The planner alone: the settings of WASP's search, with other bounds than the gates have."""

    variant: Literal["full"] = "full"
    error_lasts: float = assumed(
        0.0, "nobody commands, so that there is no error that could last", ge=0.0, le=0.0
    )
    adversary: Literal["none"] = "none"
    tau_c: Annotated[float, Field(gt=0.0)] = assumed(
        0.1,
        "costly decisions that are at most expected of a plan within H; smaller than a gate's "
        "bound, since a search for the best return uses all that its bound allows",
    )
    tau_r: float = assumed(
        0.3,
        "return that a plan must gain over the expert's actions: a search prefers plans about "
        "which the model errs, and they gain less than it predicts",
    )


def _check_sizes(config: WASPConfig | PrintedConfig) -> None:
    """Raise a ValueError where L is larger than H, or N_e or N_f larger than N."""
    if config.residual_steps > config.horizon:
        raise ValueError(
            f"residual_steps ({config.residual_steps}) is longer than horizon ({config.horizon})"
        )
    for name in ("elites", "feasible"):
        number = getattr(config, name)
        if number > config.candidates:
            raise ValueError(f"{name} ({number}) is more than candidates ({config.candidates})")
