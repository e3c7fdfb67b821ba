"""The configuration section of every stage: sizes and budgets. Light: `wasp plan` reads it without torch.

Defaults are the `cpu` preset; the other presets override them (`spec.presets`).
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from wasp_cli.config import Config, assumed, deviates, from_paper

Layers = Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(min_length=1)]
"""Widths of hidden layers."""


class ReturnsConfig(Config):
    """Constants of the TD-lambda returns (Eq. 7-8), shared by critics, gates and planner."""

    gamma_r: float = assumed(0.99, "discount of the reward return", gt=0.0, le=1.0)
    gamma_c: float = deviates(
        0.95, "discount of the cost return; Eq. 8 has one gamma for both, and V_c at 0.997 made the gate nearly useless", gt=0.0, le=1.0
    )
    lam: float = assumed(0.95, "lambda, as in DreamerV3 and SafeDreamer", gt=0.0, le=1.0)


class ExpertConfig(Config):
    """PPO with an adaptive Lagrange multiplier on privileged observations."""

    interactions: int = assumed(400_000, "decision steps", ge=1)
    envs: int = assumed(32, "episodes side by side", ge=1)
    rollout: int = assumed(64, "decision steps per environment and update", ge=1)
    epochs: int = assumed(8, "passes over a rollout", ge=1)
    batch: int = assumed(1024, "minibatch", ge=2)
    learning_rate: float = assumed(4e-4, "decays linearly to a tenth", gt=0.0)
    gamma: float = assumed(0.98, "discount per decision step", gt=0.0, le=1.0)
    gae_lambda: float = assumed(0.95, "GAE", gt=0.0, le=1.0)
    hidden: Layers = assumed((128, 128), "layers of actor and value network")
    entropy: float = assumed(0.0, "entropy bonus", ge=0.0)
    log_std_init: float = assumed(-0.3, "initial exploration")
    log_std_floor: float = assumed(-1.2, "keeps exploring, so that the multiplier can act")
    cost_limit: float = assumed(25.0, "kappa per 1000 env steps; the benchmark's convention", ge=0.0)
    multiplier_init: float = assumed(0.3, "penalty per costly decision step from the first update", ge=0.0)
    multiplier_lr: float = assumed(0.01, "step of the multiplier per update and unit of relative excess cost", ge=0.0)
    multiplier_min: float = assumed(
        0.05,
        "bound of the multiplier from below: untrained policies cost little, and would lower it to nothing before it is needed",
        ge=0.0,
    )
    multiplier_max: float = assumed(5.0, "bound of the multiplier", gt=0.0)
    checkpoints: tuple[float, ...] = assumed((0.10, 0.25, 0.50, 1.00), "fractions of the interactions at which a skill is stored")
    evaluation_episodes: int = assumed(64, "episodes of the final evaluation of each checkpoint", ge=1)

    @model_validator(mode="after")
    def _checkpoints_rise_to_one(self) -> ExpertConfig:
        rising = list(self.checkpoints) == sorted(set(self.checkpoints))
        if not rising or not self.checkpoints or self.checkpoints[-1] != 1.0 or self.checkpoints[0] <= 0:
            raise ValueError("checkpoints must rise and end at 1.0")
        return self


class MixtureConfig(Config):
    """Shares of the behaviours in the dataset; they must sum to 1."""

    expert: float = assumed(0.23, "expert with Gaussian noise 0.25", ge=0.0, le=1.0)
    noisy: float = assumed(0.10, "uniform replacement with probability 0.2, 0.4 or 0.6", ge=0.0, le=1.0)
    laggy: float = assumed(0.12, "repetition with probability 0.5, 0.7 or 0.85", ge=0.0, le=1.0)
    delayed: float = assumed(0.14, "the command for what was seen 2, 3 or 5 decision steps ago", ge=0.0, le=1.0)
    tardy: float = assumed(0.00, "the same with 2 to 6 decision steps and Gaussian noise 0.15 to 0.5", ge=0.0, le=1.0)
    early: float = assumed(0.05, "the first two checkpoints", ge=0.0, le=1.0)
    between: float = assumed(0.00, "the mean of one of them and the expert", ge=0.0, le=1.0)
    bursts: float = assumed(0.08, "expert interrupted by random commands held for 2-11 steps", ge=0.0, le=1.0)
    careless: float = assumed(0.20, "repetition with probability 0.9 or 0.95: commands held for a second and more", ge=0.0, le=1.0)
    wandering: float = assumed(0.00, "noise of 0.6 to 1.3 that persists for half a second to three", ge=0.0, le=1.0)
    biased: float = assumed(0.00, "a constant of 0.3, 0.4 or 0.8 added to one component", ge=0.0, le=1.0)
    scaled: float = assumed(0.00, "half or twice the command, with Gaussian noise 0.15", ge=0.0, le=1.0)
    random: float = assumed(0.08, "uniform random commands", ge=0.0, le=1.0)

    @model_validator(mode="after")
    def _shares_sum_to_one(self) -> MixtureConfig:
        total = sum(getattr(self, name) for name in type(self).model_fields)
        if abs(total - 1.0) > 1e-6:
            raise ValueError(f"the shares sum to {total:g}, not 1")
        return self


class DatasetConfig(Config):
    """Episodes with images from a mixture of behaviours."""

    steps: int = assumed(100_000, "decision steps", ge=1)
    envs: int = assumed(16, "episodes side by side; one shard each", ge=1)
    decisions: int | None = assumed(
        None,
        "recorded of an episode: one of its parts of so many decisions, so that the same images show more layouts; null: whole episodes, "
        "which hold more costs; parts of 50 with a wider mixture foresaw costs of unseen operators no better",
        ge=2,
    )
    whole_share: float = assumed(0.1, "share of the episodes that are recorded whole all the same", ge=0.0, le=1.0)
    mixture: MixtureConfig = MixtureConfig()


class WorldModelConfig(Config):
    """RSSM with categorical latents and heads for image, reward, cost and continuation (Eq. 6)."""

    deter: int = assumed(256, "size of h", ge=1)
    hidden: int = assumed(128, "width of the layers around the GRU", ge=1)
    variables: int = assumed(24, "categorical variables in z", ge=1)
    classes: int = assumed(16, "classes of each", ge=2)
    depth: int = assumed(16, "channels of the first convolution", ge=1)
    head: int = assumed(128, "width of the two layers of each head", ge=1)
    unimix: float = assumed(0.01, "share of a uniform distribution mixed into every categorical", ge=0.0, lt=1.0)
    action_scales: Annotated[tuple[Annotated[float, Field(gt=0.0)], ...], Field(min_length=1)] = deviates(
        (1.0, 0.3, 0.1, 0.03),
        "the recurrence reads clip(a / s, -1, 1) for each s, not a alone: motors saturate, here at 0.02 to 0.05",
    )
    batch: int = assumed(8, "sequences per update", ge=1)
    length: int = assumed(32, "decision steps per sequence; they go on from remembered latents", ge=2)
    updates: int = assumed(4000, "gradient steps", ge=1)
    learning_rate: float = assumed(8e-4, "Adam; decays linearly over the second half to a tenth", gt=0.0)
    warmup: int = assumed(200, "updates of linear warm-up", ge=0)
    clip: float = assumed(300.0, "gradient norm", gt=0.0)
    alpha_q: float = assumed(0.1, "Eq. 6: weight of the representation term", ge=0.0)
    alpha_p: float = assumed(1.0, "Eq. 6: weight of the prediction term", ge=0.0)
    free_nats: float = deviates(1.0, "KL below which no gradient flows, on the sum over variables; Eq. 6 has no such bound (0)", ge=0.0)
    beta_o: float = assumed(1.0, "Eq. 6: image, squared error summed over pixels", ge=0.0)
    beta_r: float = assumed(50.0, "Eq. 6: reward; 5 is lost beside the loss on the privileged vector", ge=0.0)
    beta_c: float = assumed(50.0, "Eq. 6: cost; 1 drowns in the image sum", ge=0.0)
    beta_n: float = deviates(1.0, "weight of the continuation; not in Eq. 6, but Race1 ends at the goal", ge=0.0)
    reward_scale: float = assumed(5.0, "rewards are multiplied by it before the squared error", gt=0.0)
    cost_weight: float = deviates(5.0, "weight of costly steps, 1 in Eq. 6; its logarithm is removed from the logit at inference", ge=1.0)
    cost_windows: float = assumed(1 / 3, "share of sequences that contain a costly step", ge=0.0, le=1.0)
    mirror: bool = deviates(
        True,
        "half of the sequences are seen in a mirror, not as replayed, where the task has one: Goal, not the tracks; and of the images of "
        "`taught`",
    )
    context: bool = deviates(
        True, "sequences within an episode go on from the latent that training last inferred before them; Eq. 6 begins at t = 1"
    )
    ahead: float = deviates(1.0, "weight of reward and cost on imagined steps, relative to beta_r and beta_c; not in Eq. 6", ge=0.0)
    ahead_image: float = deviates(0.3, "weight of the image on imagined steps, relative to beta_o; not in Eq. 6", ge=0.0)
    ahead_starts: int = deviates(64, "imagined rollouts per update for these; 0 leaves them out, as Eq. 6 does", ge=0)
    ahead_images: int = deviates(32, "of which this many, at most, decode one image; none in Eq. 6", ge=0)
    ahead_horizon: int = deviates(15, "their length in decision steps; Eq. 6 predicts one", ge=1)
    decode_share: float = assumed(0.25, "share of the steps whose image is decoded", gt=0.0, le=1.0)
    refit_updates: int = deviates(
        600, "last step, not in section 4.1 (0): heads of reward, cost and continuation on prior latents, model frozen", ge=0
    )
    refit_starts: int = deviates(64, "imagined rollouts per update of the refit, which section 4.1 lacks", ge=1)
    refit_horizon: int = deviates(15, "imagined steps of the refit, which section 4.1 lacks", ge=1)
    later_updates: int = assumed(1000, "gradient steps of a later round of data, from the weights of the round before", ge=1)
    taught: int = deviates(
        2000,
        "updates on single images, before Eq. 6, in which the encoder learns to tell the privileged vector: reconstruction alone does not "
        "teach it where to look; 0 as in the paper",
        ge=0,
    )
    taught_batch: int = assumed(128, "images per such update", ge=1)
    taught_rate: float = assumed(1e-3, "Adam; decays linearly over the second half to a tenth", gt=0.0)
    taught_head: int = assumed(256, "width of the two layers that read the embedding meanwhile", ge=1)
    privileged: float = deviates(
        10.0,
        "weight of the squared error, summed over the standardised privileged vector, of a head on filtered latents; not in Eq. 6; "
        "0 as in the paper",
        ge=0.0,
    )
    compile: bool = assumed(False, "torch.compile of the loss; worth its minute only on a GPU")
    checkpoint_every: int = assumed(200, "updates between checkpoints of the training itself", in_key=False, ge=1)


class LatentsConfig(Config):
    """What the world model infers at every recorded row; nothing to choose."""


class DiagnosticsConfig(Config):
    """What the world model is worth on episodes that it was not trained on."""

    episodes: int = assumed(32, "fresh episodes under operators that are not in the dataset", ge=1)
    horizon: int = from_paper(15, "H", ge=1)
    starts: int = assumed(4000, "moments of each set from which is imagined", ge=1)
    samples: int = assumed(4, "imagined futures that are averaged", ge=1)
    image_starts: int = assumed(128, "moments from which images are imagined", ge=1)
    readout_rows: int = assumed(8000, "recorded moments from which a ridge regression learns to tell the privileged vector", ge=2)
    readout_penalty: float = assumed(0.01, "its penalty, per row, relative to the features' mean variance", gt=0.0)
    readout_step: int = assumed(5, "imagined step at which it is read too", ge=1)
    threshold: float = assumed(
        0.5,
        "expected costly steps within the horizon, discounted as in the safety gate, from which a cost counts as foreseen: tau_c",
        ge=0.0,
    )


class ReinforceConfig(Config):
    """PPO with a Lagrange multiplier on the latents, from the distilled expert; only where labels alone did not reach the bounds."""

    interactions: int = assumed(200_000, "decision steps; 0 leaves the latent expert as it was distilled", ge=0)
    return_share: float = assumed(
        0.85, "latent return / privileged return from which, within the cost, nothing is reinforced; labels may aim higher", gt=0.0
    )
    envs: int = assumed(32, "episodes side by side", ge=1)
    rollout: int = assumed(128, "decision steps per environment and update", ge=1)
    epochs: int = assumed(4, "passes over a rollout", ge=1)
    batch: int = assumed(512, "minibatch", ge=2)
    learning_rate: float = assumed(2e-4, "Adam; decays linearly to a tenth; low, so that what was distilled is kept", gt=0.0)
    gamma: float = assumed(0.98, "discount per decision step", gt=0.0, le=1.0)
    log_std_init: float = assumed(-1.2, "initial exploration")
    log_std_floor: float = assumed(-1.6, "keeps exploring")
    value_warmup: float = assumed(0.08, "share of the interactions that train only the value function", ge=0.0, lt=1.0)
    multiplier_init: float = assumed(0.2, "penalty per costly decision step", ge=0.0)
    multiplier_lr: float = assumed(0.02, "step of the multiplier per update and unit of relative excess cost", ge=0.0)
    multiplier_min: float = assumed(0.05, "bound of the multiplier from below", ge=0.0)
    multiplier_max: float = assumed(5.0, "bound of the multiplier", gt=0.0)


class PoliciesConfig(Config):
    """Latent actors distilled from the expert checkpoints, rounds in which they drive and the checkpoints label, and reinforcement."""

    hidden: Layers = assumed((128, 128), "layers of a latent actor")
    updates: int = assumed(1500, "gradient steps of the distillation", ge=1)
    batch: int = assumed(512, "latents per update", ge=1)
    learning_rate: float = assumed(1e-3, "Adam, linear decay", gt=0.0)
    imagined_share: float = assumed(
        0.25, "share of the latents that are prior samples, as operators meet them in imagination", ge=0.0, le=1.0
    )
    imagined_depth: int = assumed(5, "most prior steps from a recorded latent to such a sample", ge=1)
    labelling_rounds: int = assumed(3, "most on-policy labelling rounds; they end when return and cost are reached", ge=0)
    labelling_episodes: int = assumed(48, "episodes per round; what the labels teach grows with the layouts met", ge=1)
    labelling_updates: int = assumed(1500, "gradient steps per round", ge=1)
    labelled_share: float = assumed(0.5, "share of a round's batches that comes from the rounds so far", ge=0.0, le=1.0)
    driver_share: float = assumed(0.4, "share of a round's episodes driven by impaired experts and earlier skills", ge=0.0, le=1.0)
    reinforce: ReinforceConfig = ReinforceConfig()
    return_share: float = assumed(0.85, "least latent return / privileged return", gt=0.0)
    cost_ratio: float = assumed(1.3, "most latent cost / privileged cost", ge=0.0)
    cost_allowance: float = assumed(2.5, "cost per 1000 env steps above the privileged one that is always allowed; kappa / 10", ge=0.0)
    evaluation_episodes: int = assumed(
        48, "episodes that judge a round, and others that evaluate each skill; the share of the return is then known to .05", ge=1
    )


class CriticsConfig(Config):
    """V_r and V_c of the nominal expert, from imagined rollouts and from recorded transitions."""

    hidden: Layers = assumed((128, 128), "layers of a critic")
    updates: int = assumed(1000, "gradient steps; curve.json shows whether V_r has converged", ge=1)
    starts: int = assumed(128, "imagined rollouts per update, and as many recorded segments", ge=1)
    cost_starts: float = assumed(
        0.0, "share of the rollouts that begin where a cost followed within H recorded steps; 0.3 ranked no better", ge=0.0, le=1.0
    )
    horizon: int = from_paper(15, "H", ge=1)
    bins: int = assumed(63, "values as distributions over bins spaced evenly in symlog; odd", ge=3)
    reach: float = assumed(1000.0, "largest value that the bins can say", gt=0.0)
    learning_rate: float = assumed(1e-3, "Adam; decays linearly over the second half to a tenth", gt=0.0)
    slow: float = assumed(
        0.2, "share of the online critic that enters the target critic per update; at 0.02 V_r takes thousands", gt=0.0, le=1.0
    )
    recorded: float = deviates(
        0.3,
        "weight of Q of recorded transitions, read at the expert's action, as a second target of V; the paper has latent roll-outs alone "
        "(0), whose drift V then learns; as the replay loss of DreamerV3's critic",
        ge=0.0,
    )
    q_updates: int = assumed(2500, "gradient steps of Q", ge=1)
    q_batch: int = assumed(256, "recorded transitions per update of Q", ge=1)
    q_learning_rate: float = assumed(5e-4, "Adam; decays linearly over the second half to a tenth", gt=0.0)
    q_slow: float = assumed(
        0.1, "share of the online Q that enters the target per update; a reward travels back one decision in 1 / q_slow", gt=0.0, le=1.0
    )


class LookaheadConfig(Config):
    """A direct look ahead: the probability of any cost within the next decisions, from the latent and the next commands."""

    horizon: int = from_paper(15, "decisions ahead; H and W", ge=1)
    commands: int = assumed(
        5, "next commands that it reads; L. One, ten and fifteen ranked alike under imagined commands (Goal1, quick)", ge=1
    )
    members: int = assumed(3, "heads, one batched product; their mean is what counts", ge=1)
    hidden: Layers = assumed((128, 128), "layers of a head")
    dropout: float = assumed(0.3, "hidden units left out while learning: episodes are few, and learned by heart", ge=0.0, lt=1.0)
    updates: int = assumed(1500, "gradient steps; more of them learn the episodes by heart", ge=1)
    batch: int = assumed(256, "recorded rows per update", ge=1)
    learning_rate: float = assumed(1e-3, "Adam; decays linearly over the second half to a tenth", gt=0.0)
    samples: int = assumed(4, "imagined futures of the rolled-out sum that it is compared with", ge=1)

    @model_validator(mode="after")
    def _commands_fit(self) -> LookaheadConfig:
        if self.commands > self.horizon:
            raise ValueError(f"commands ({self.commands}) are more than the decisions of the horizon ({self.horizon})")
        return self


class CloneConfig(Config):
    """A policy fitted to recorded commands of one operator, for planners that are not to know its rule."""

    episodes: int = assumed(20, "Human-only episodes of the operator to learn from, on seeds of their own", ge=1)
    heldout_episodes: int = assumed(8, "others that judge the clone", ge=1)
    hidden: Layers = assumed((64,), "layers of the correction of the expert's command")
    updates: int = assumed(1000, "gradient steps", ge=1)
    batch: int = assumed(256, "commands per update", ge=1)
    learning_rate: float = assumed(2e-3, "Adam; decays linearly", gt=0.0)
    weight_decay: float = assumed(0.1, "AdamW: episodes are few", ge=0.0)
    draws: int = assumed(256, "of the next command, by which every model of the operator is judged", ge=1)


class GateSignalsConfig(Config):
    """Which number foresees costs best at the safety gate, and the return at the task gate, on fresh Human-only episodes."""

    operators: dict[str, tuple[float, ...]] = assumed(
        {"laggy": (0.7,), "noisy": (0.4,), "reaction-time": (0.24,), "limited-skill": (0.25,)},
        "who drives, besides the unimpaired operator; a skill that the expert has no checkpoint of is left out",
    )
    episodes: int = assumed(8, "fresh episodes of each operator", ge=1)
    window: int = from_paper(15, "W, section 5.3: a cost within it is to be foreseen", ge=1)
    horizon: int = from_paper(15, "H, section 5.1", ge=1)
    rollouts: int = assumed(8, "M: imagined futures of the operator, the same for every signal", ge=1)
    first_steps: int = assumed(5, "imagined steps of the short sum; L", ge=1)
    gammas: tuple[Annotated[float, Field(gt=0.0, le=1.0)], ...] = assumed(
        (0.9, 0.95, 0.99, 0.997),
        "discounts at which V_c and V_r are compared, besides gamma_c and gamma_r; critics at others are trained here",
    )
    threshold: float = assumed(0.5, "tau_c, at which the gate is judged", gt=0.0)
    critics: CriticsConfig = CriticsConfig(updates=500)


class HeldoutConfig(Config):
    """Episodes of the unimpaired expert on seeds of their own, for every threshold."""

    episodes: int = assumed(20, "held-out episodes", ge=1)


class CalibrationConfig(Config):
    """Thresholds from the held-out episodes."""

    window: int = from_paper(15, "W, section 5.3", ge=1)
    decisions: int = assumed(1500, "held-out decisions at which the task gate is probed", ge=1)
    tau_R_fraction: float = assumed(0.1, "tau_R as a fraction of the expert's mean W-step return", ge=0.0)


class EnsembleConfig(Config):
    """IDA's Q ensemble for the expert, TD on real and noisy transitions."""

    members: int = assumed(5, "ensemble size, as in TS2C", ge=1)
    hidden: Layers = assumed((256, 256), "layers of a member")
    updates: int = assumed(4000, "gradient steps", ge=1)
    batch: int = assumed(256, "transitions per update", ge=1)
    learning_rate: float = assumed(3e-4, "Adam", gt=0.0)
    target_rate: float = assumed(
        0.05,
        "share of the online network that enters the target per update: a reward travels back one decision in 1 / rate updates",
        gt=0.0,
        le=1.0,
    )


class DenoiserConfig(Config):
    """Diffusion's action denoiser, conditioned on the latent features."""

    steps: int = assumed(50, "T: diffusion steps of the original", ge=2)
    beta_min: float = assumed(1e-4, "first beta of the sigmoid schedule", gt=0.0, lt=1.0)
    beta_max: float = assumed(0.26, "last beta of the sigmoid schedule", gt=0.0, lt=1.0)
    hidden: Layers = assumed((128, 128, 128), "layers")
    updates: int = assumed(8000, "gradient steps (the original has 30,000)", ge=1)
    batch: int = assumed(512, "transitions per update (the original has 4096)", ge=1)
    learning_rate: float = assumed(1e-3, "Adam", gt=0.0)
    ema: float = assumed(0.999, "decay of the averaged weights that are used", ge=0.0, lt=1.0)
    states: Literal["all", "careful"] = assumed(
        "all",
        "where the expert's action is learned: in all recorded states, as with the original's option of random behaviour and the "
        "expert's labels; `careful`: near-expert episodes of little cost alone, too few here: they were learned by heart",
    )
    cost_limit: float = assumed(25.0, "states careful: the most that such an episode may cost per 1000 env steps (kappa)", ge=0.0)


LADDER: dict[str, tuple[float, ...]] = {
    "noisy": (0.2, 0.4, 0.6),
    "laggy": (0.5, 0.7, 0.85),
    "limited-skill": (0.50, 0.25, 0.10),
    "reaction-time": (0.16, 0.24, 0.40),
}


class ResidualConfig(Config):
    """SafeRL-Res: PPO with a Lagrange multiplier over (h, z, a^H) in the real task."""

    mode: Literal["lagrangian", "rsa"] = from_paper(
        "lagrangian", "Eq. 5; `rsa`: the least effort for a least return, the form of the original"
    )
    return_share: float = assumed(
        0.75, "mode rsa: the least return, as a share of the unimpaired expert's; the original tunes it per pilot", gt=0.0
    )
    interactions: int = assumed(300_000, "decision steps (the original has 100 M)", ge=1)
    envs: int = assumed(16, "episodes side by side", ge=1)
    rollout: int = assumed(128, "decision steps per environment and update", ge=1)
    epochs: int = assumed(4, "passes over a rollout", ge=1)
    batch: int = assumed(256, "minibatch", ge=2)
    learning_rate: float = assumed(3e-4, "Adam", gt=0.0)
    gamma: float = assumed(0.98, "discount per decision step", gt=0.0, le=1.0)
    hidden: Layers = assumed((128, 128), "layers of actor and value network")
    entropy: float = assumed(0.0, "entropy bonus", ge=0.0)
    log_std_init: float = assumed(
        -0.4,
        "initial exploration of the residual: motors saturate, and small residuals to a full command change nothing that could be learned",
    )
    alpha: float = assumed(0.1, "Eq. 5: weight of the squared residual", ge=0.0)
    cost_limit: float = deviates(
        25.0, "kappa per 1000 env steps, without a discount, as the benchmark counts; Eq. 5 bounds the discounted cost", ge=0.0
    )
    value_warmup: float = assumed(0.02, "share of the interactions that train only the value function", ge=0.0, lt=1.0)
    multiplier_delay: float = assumed(0.05, "share of the interactions before the multiplier moves", ge=0.0, lt=1.0)
    multiplier_init: float = assumed(1.0, "penalty per costly decision step; in mode rsa the weight of the return", ge=0.0)
    multiplier_lr: float = assumed(0.1, "step of the multiplier per update and unit of relative excess", ge=0.0)
    multiplier_max: float = assumed(5.0, "bound of the multiplier", gt=0.0)
    operators: dict[str, tuple[float, ...]] = assumed(LADDER, "operators mixed per episode", min_length=1)


class CoverageConfig(Config):
    """Human-only episodes for a threshold with a guarantee (`wasp.tau_c: {coverage: ...}`); it holds for this mixture of operators."""

    operators: dict[str, tuple[float, ...]] = assumed(
        LADDER, "who drives: one severity of one variant in each episode, drawn with equal chances", min_length=1
    )
    episodes: int = assumed(60, "episodes from which the threshold is taken; only those that cost count", ge=1)
    fresh: int = assumed(60, "further episodes, on which the share of costly ones with an onset without an alert is measured", ge=0)


class RolloutsConfig(Config):
    """Data of a further round: full WASP assists the operators in the real task, with thresholds that nobody has calibrated yet."""

    steps: int = assumed(20_000, "decision steps that a round adds to the dataset", ge=1)
    envs: int = assumed(16, "episodes side by side; one shard each", ge=1)
    operators: dict[str, tuple[float, ...]] = assumed(
        LADDER, "operators, one per episode in turn; the unimpaired one comes first", min_length=1
    )


class EvaluateConfig(Config):
    """One cell of the grid."""

    episodes: int = assumed(30, "episodes per cell", ge=1)
    success_goals: int | None = assumed(None, "goals that count as success; null: 7 in Goal1, 1 in Race1 and FormulaOne1", ge=1)
    safe_cost: float = assumed(25.0, "kappa per 1000 env steps, as in training: up to it a success is a safe success", ge=0.0)


class CounterfactualConfig(Config):
    """Branches of the real task at intervened decisions: what would have happened without the intervention (Eq. 19-21)."""

    window: int = from_paper(15, "W, section 5.3", ge=1)
    stride: int = assumed(1, "every stride-th intervened decision of a cell is branched, counted on from episode to episode", ge=1)
    most: int | None = assumed(None, "branched decisions of a cell at most: the stride grows until they are no more; null: no limit", ge=1)
    tau_R_fraction: float = assumed(0.1, "tau_R as a fraction of the unimpaired expert's mean W-step return", ge=0.0)
