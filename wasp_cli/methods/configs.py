"""Decision-time configuration of every assistant. Light: `wasp plan` reads it without torch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

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


WASPVariant = Literal["full", "safety-only", "task-only", "no-case2", "no-rollout", "as-printed"]

AS_PRINTED: WASPVariant = "as-printed"
"""The variant that is the recipe of the paper beside our own in one spec: it sets `recipe`."""

PAPER_RECIPE: Mapping[str, Any] = {
    "composition": "hold", "discounts": "reward", "bootstrap_cost": True, "bootstrap_reward": True, "continuation": False,
    "operator_model": "rule", "tau_c": "calibrated", "witness": "sum", "probe_with": "random", "probe_first": False, "task_search": True,
    "safety_search": True, "rescore": False, "takeover_shares": (), "braking": False, "forced": False, "warm_start": False,
    "case2_memory": 0, "finalists": 0, "recheck": False, "best_of": "all", "effort": "sampled",
    "elites_kept": 0.0, "shrink": 1.0, "momentum": 0.0, "alpha": 0.1, "tau_r_floor": 0.05,
}  # fmt: skip
"""Section 4 to the letter. What it leaves open stays as it is: sizes, quantiles; M is one number. alpha and the floor of tau_r are open
too, but suit what is judged: sampled plans here, takeovers in our own recipe."""


class Coverage(Config):
    """A threshold by what it has to guarantee, taken from Human-only episodes (stage `coverage`)."""

    coverage: float = assumed(
        0.1, "largest share of costly episodes of the operators alone with an onset before which nothing was foreseen", gt=0.0, lt=1.0
    )


class WASPConfig(Config):
    """WASP: gates (section 4.2) and residual planning (section 4.3). N candidates, M rollouts, H horizon, L residuals."""

    variant: WASPVariant = "full"
    recipe: Literal["own", "paper"] = deviates(
        "own",
        "`paper`: section 4 to the letter, whatever the fields say that it settles; `own`: as they say. The variant `as-printed` sets it",
    )
    horizon: int = from_paper(15, "H, section 5.1", ge=1)
    residual_steps: int = from_paper(5, "L, section 5.1", ge=1)
    probe: int = from_paper(300, "N_probe, section 5.1: random sequences of the task gate, where it draws any", ge=1)
    candidates: int = from_paper(300, "N, section 5.1", ge=2)
    elites: int = from_paper(100, "N_e, section 5.1", ge=1)
    iterations: int = from_paper(6, "I, section 5.1", ge=1)
    rollouts: int = assumed(1, "M: rollouts per candidate, with common random numbers over candidates", ge=1)
    gate_rollouts: int = deviates(
        8, "rollouts of the commands alone and of every second scoring; the paper has one M (recipe `paper`: `rollouts`)", ge=1
    )
    takeover_rollouts: int = assumed(8, "rollouts of each takeover: the first of `gate_rollouts`, or all where it is no divisor", ge=1)
    probe_with: Literal["takeovers", "random", "both"] = deviates(
        "takeovers", "what the task gate asks about: the expert's takeovers instead of N_probe random sequences, which the paper samples"
    )
    takeover_shares: tuple[Annotated[float, Field(gt=0.0, le=1.0)], ...] = deviates(
        (1.0,),
        "the expert takes over the next 1..L commands, by each of these shares: candidates of probe and search beside the paper's samples",
    )
    braking: bool = deviates(False, "commands of zero for the next 1..L decisions are candidates too; the paper only samples")
    probe_first: bool = deviates(
        True, "random sequences of a probe that fired are the first iteration of the search; the paper has the probe for gating only"
    )
    rescore: bool = deviates(True, "the probe's winner must gain tau_r on fresh rollouts too; the paper takes the gain as it was scored")
    task_search: bool = deviates(
        False, "where the task gate fired the probe's winner is carried out; section 4.3 searches a residual plan there too"
    )
    safety_search: bool = deviates(
        False, "where the safety gate fired a plan is searched only if no takeover is safe; section 4.3 searches one whenever it fired"
    )
    finalists: int = deviates(
        4, "best plans by either score that are scored again with fresh rollouts; the paper selects the best as scored (0)", ge=0
    )
    recheck: bool = deviates(
        True,
        "the command stands where it is safe on the finalists' fresh rollouts after all and no plan gains more than tau_r; "
        "the paper corrects whenever the safety gate has fired",
    )
    best_of: Literal["all", "last"] = assumed("all", "iterations among whose candidates the plan is selected")
    forced: bool = deviates(True, "no residual and the mean are candidates of every iteration; the paper only samples")
    warm_start: bool = deviates(
        True, "the search begins with the last plan, shifted, where one was carried out; the paper carries nothing over"
    )
    case2_memory: int = deviates(
        4, "decisions for which the plan that Case II chose stays a candidate, shifted; the paper carries nothing over", ge=0
    )
    elites_kept: float = deviates(
        0.3, "share of the elites that stay candidates of the next iteration (iCEM); the paper samples each batch afresh", ge=0.0, le=1.0
    )
    shrink: float = deviates(1.25, "factor by which the population falls from iteration to iteration (iCEM); the paper has one N", ge=1.0)
    feasible: int = assumed(100, "N_f: safe candidates needed for Case I; N_e as in SafeDreamer", ge=1)
    alpha: float = assumed(0.02, "weight of the squared residual (Eq. 11, 16, 17); recipe `paper`: 0.1, for plans that are sampled", ge=0.0)
    effort: Literal["clipped", "sampled"] = deviates(
        "clipped", "the residual that Eq. 11, 16 and 17 penalise: what is executed of it within the bounds; the paper: as it was sampled"
    )
    tau_c: Annotated[float, Field(gt=0.0)] | Literal["calibrated"] | Coverage = assumed(
        0.7,
        "costly decision steps expected within H, discounted by gamma_c, above which the safety gate fires; 0.4 costs less; "
        "`calibrated`: a quantile of its own signal under the expert; `{coverage: 0.1}`: so that of the costly episodes of the operators "
        "alone at most this share has an onset without an alert",
    )
    tau_c_quantile: float = assumed(
        0.95, "which one, over held-out decisions of the unimpaired expert after which nothing cost within W", gt=0.0, lt=1.0
    )
    witness: Literal["sum", "head", "both"] = deviates(
        "sum",
        "what must speak for a cost before the safety gate fires. `sum`: Eq. 9; `head`: the direct look ahead (stage `lookahead`); `both`: "
        "the sum, and either the look ahead too or the sum of the decision before. The paper has the first alone",
    )
    tau_head: float = assumed(0.1, "witness head, both: probability of any cost above which the look ahead speaks for one", ge=0.0, lt=1.0)
    head_window: int = assumed(5, "decisions within which; of 5, 10 and 15 the first needs the fewest alarms for the same recall", ge=1)
    tau_r: float | Literal["calibrated"] = assumed("calibrated", "quantile of the gain under the unimpaired expert; of takeovers it is 0")
    tau_r_quantile: float = assumed(0.95, "which quantile", gt=0.0, lt=1.0)
    tau_r_floor: float = assumed(0.15, "smallest calibrated tau_r: a gain below it is noise", ge=0.0)
    discounts: Literal["two", "reward", "cost"] = deviates(
        "two", "gamma_r for rewards and gamma_c for costs; the paper has one gamma: that of the rewards or of the costs for both"
    )
    bootstrap_cost: bool = deviates(False, "V_c after H for the cost, as in Eq. 7-8; the discounted sum over H ranks as well")
    bootstrap_reward: bool = from_paper(
        True,
        "V_r after H for the reward, Eq. 7-8: without it a takeover whose gain lies behind H is not seen, and a lost operator stays lost",
    )
    continuation: bool = deviates(
        True, "what lies behind an imagined end of the episode counts with the probability that it goes on; Eq. 8 knows no ends"
    )
    operator_model: Literal["rule", "expert", "hold", "cloned"] = from_paper(
        "rule",
        "section 4.2: the very operator with its memory is imagined; `expert`: the unimpaired one in its place; "
        "`hold`: the last command, held; `cloned`: a policy fitted to recorded commands of that operator (stage `clone`)",
    )
    initial_std: float = assumed(0.5, "standard deviation of the first residual distribution", gt=0.0)
    std_floor: float = assumed(0.05, "keeps the distribution from collapsing", gt=0.0)
    momentum: float = assumed(0.1, "weight of the old mean in a CEM update", ge=0.0, lt=1.0)
    composition: Literal["per_step", "hold"] = deviates(
        "per_step", "a^H_{t+k} + delta_{t+k} as in the text of section 4; Eq. 13 as printed holds a^H_t for L steps (`hold`)"
    )

    @model_validator(mode="before")
    @classmethod
    def _one_recipe(cls, data: Any) -> Any:
        if not isinstance(data, Mapping):
            return data
        if isinstance(shares := data.get("takeover_shares"), list):
            data = {**data, "takeover_shares": tuple(shares)}  # behind this validator JSON is no longer told from Python, which has tuples
        if data.get("variant") == AS_PRINTED:
            data = {**data, "recipe": "paper"}
        if data.get("recipe") == "paper":
            data = {**data, **PAPER_RECIPE, "gate_rollouts": data.get("rollouts", cls.model_fields["rollouts"].default)}
        return data

    @model_validator(mode="after")
    def _sizes_fit(self) -> WASPConfig:
        if self.residual_steps > self.horizon:
            raise ValueError(f"residual_steps ({self.residual_steps}) is longer than horizon ({self.horizon})")
        if self.probe_with != "random" and not (self.takeover_shares or self.braking):
            raise ValueError(f"probe_with is '{self.probe_with}', but takeover_shares is empty")
        if isinstance(self.tau_c, Coverage) and self.operator_model == "cloned":
            raise ValueError(
                "tau_c with a coverage is taken from a mixture of operators, and a clone is of one; give tau_c a number or `calibrated`"
            )
        # A random probe becomes the first iteration.
        batches = ("candidates", *(("probe",) if self.probe_with != "takeovers" and self.probe_first else ()))
        for name in ("elites", "feasible", "finalists"):
            for batch in batches:
                if getattr(self, name) > getattr(self, batch):
                    raise ValueError(f"{name} ({getattr(self, name)}) is more than {batch} ({getattr(self, batch)})")
        if self.rollouts > self.gate_rollouts:
            raise ValueError(
                f"rollouts ({self.rollouts}) is more than gate_rollouts ({self.gate_rollouts}), with which it shares its draws"
            )
        return self

    def population(self, iteration: int) -> int:
        """Return how many candidates an iteration samples: never fewer than its elites."""
        return max(round(self.candidates / self.shrink**iteration), min(self.candidates, max(self.elites, self.feasible)))
