"""Sections of the world model: its training, its latents, and its diagnostics."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from wasp_cli.config import Config, assumed, deviates, from_paper


class WorldModelConfig(Config):
    """RSSM with categorical latents and heads for image, reward, cost and continuation (Eq. 6)."""

    deter: int = assumed(256, "size of h", ge=1)
    hidden: int = assumed(128, "width of the layers around the GRU", ge=1)
    variables: int = assumed(24, "categorical variables in z", ge=1)
    classes: int = assumed(16, "classes of each", ge=2)
    depth: int = assumed(16, "channels of the first convolution", ge=1)
    head: int = assumed(128, "width of the two layers of each head", ge=1)
    unimix: float = assumed(
        0.01, "share of a uniform distribution mixed into every categorical", ge=0.0, lt=1.0
    )
    action_scales: Annotated[tuple[Annotated[float, Field(gt=0.0)], ...], Field(min_length=1)] = (
        deviates(
            (1.0, 0.3, 0.1, 0.03),
            "the recurrence reads clip(a / s, -1, 1) for each s, not a alone: motors "
            "saturate, here at 0.02 to 0.05",
        )
    )
    batch: int = assumed(8, "sequences per update", ge=1)
    length: int = assumed(
        32, "decision steps per sequence; a sequence goes on from remembered latents", ge=2
    )
    updates: int = assumed(4000, "gradient steps", ge=1)
    learning_rate: float = assumed(
        8e-4, "Adam; decays linearly over the second half to a tenth", gt=0.0
    )
    warmup: int = assumed(200, "updates of linear warm-up", ge=0)
    clip: float = assumed(300.0, "largest gradient norm", gt=0.0)
    alpha_q: float = assumed(0.1, "Eq. 6: weight of the representation term", ge=0.0)
    alpha_p: float = assumed(1.0, "Eq. 6: weight of the prediction term", ge=0.0)
    free_nats: float = deviates(
        1.0,
        "KL below which no gradient flows, on the sum over variables; Eq. 6 has no such bound (0)",
        ge=0.0,
    )
    beta_o: float = assumed(1.0, "Eq. 6: image, squared error summed over pixels", ge=0.0)
    beta_r: float = assumed(
        50.0, "Eq. 6: reward; 5 is too small beside the loss on the privileged vector", ge=0.0
    )
    beta_c: float = assumed(50.0, "Eq. 6: cost; 1 is too small beside the sum over pixels", ge=0.0)
    beta_n: float = deviates(
        1.0, "weight of the continuation; not in Eq. 6, but Race1 ends at the goal", ge=0.0
    )
    reward_scale: float = assumed(
        5.0, "rewards are multiplied by it before the squared error", gt=0.0
    )
    cost_weight: float = deviates(
        5.0,
        "weight of costly steps, 1 in Eq. 6; its logarithm is removed from the logit at inference",
        ge=1.0,
    )
    cost_windows: float = assumed(
        1 / 3, "share of sequences that contain a costly step", ge=0.0, le=1.0
    )
    mirror: bool = deviates(
        True,
        "half of the sequences, and of the images of `taught`, are mirrored where the task has a "
        "mirror image: Goal, not the tracks; Eq. 6 takes sequences as they were recorded",
    )
    context: bool = deviates(
        True,
        "sequences within an episode go on from the latent that training last inferred "
        "before them; Eq. 6 begins at t = 1",
    )
    ahead: float = deviates(
        1.0,
        "weight of reward and cost on imagined steps, relative to beta_r and beta_c; not in Eq. 6",
        ge=0.0,
    )
    ahead_image: float = deviates(
        0.3, "weight of the image on imagined steps, relative to beta_o; not in Eq. 6", ge=0.0
    )
    ahead_starts: int = deviates(
        64, "imagined rollouts per update for these; 0 leaves them out, as Eq. 6 does", ge=0
    )
    ahead_images: int = deviates(
        32, "of which this many, at most, decode one image; none in Eq. 6", ge=0
    )
    ahead_horizon: int = deviates(15, "their length in decision steps; Eq. 6 predicts one", ge=1)
    decode_share: float = assumed(0.25, "share of the steps whose image is decoded", gt=0.0, le=1.0)
    refit_updates: int = deviates(
        600,
        "last step, not in section 4.1 (0): heads of reward, cost and continuation on "
        "prior latents, model frozen",
        ge=0,
    )
    refit_starts: int = deviates(
        64, "imagined rollouts per update of the refit, which section 4.1 lacks", ge=1
    )
    refit_horizon: int = deviates(15, "imagined steps of the refit, which section 4.1 lacks", ge=1)
    taught: int = deviates(
        2000,
        "updates on single images, before Eq. 6, in which the encoder learns to predict the "
        "privileged vector: reconstruction alone does not teach it where to look; 0 as in the "
        "paper",
        ge=0,
    )
    taught_batch: int = assumed(128, "images per such update", ge=1)
    taught_rate: float = assumed(
        1e-3, "Adam; decays linearly over the second half to a tenth", gt=0.0
    )
    taught_head: int = assumed(
        256, "width of the two layers that read the embedding in these updates", ge=1
    )
    privileged: float = deviates(
        10.0,
        "weight of the squared error, summed over the standardised privileged vector, of a "
        "head on filtered latents; not in Eq. 6; 0 as in the paper",
        ge=0.0,
    )
    compile: bool = assumed(False, "torch.compile of the loss; worth its minute only on a GPU")
    checkpoint_every: int = assumed(
        200, "updates between checkpoints of the training itself", in_key=False, ge=1
    )


class LatentsConfig(Config):
    """What the world model infers at every recorded row; it has no settings."""


class DiagnosticsConfig(Config):
    """Quality of the world model on episodes that it was not trained on."""

    episodes: int = assumed(32, "fresh episodes under operators that are not in the dataset", ge=1)
    horizon: int = from_paper(15, "H", ge=1)
    starts: int = assumed(4000, "starts of imagined futures in each set of episodes", ge=1)
    samples: int = assumed(4, "imagined futures that are averaged", ge=1)
    image_starts: int = assumed(128, "starts from which images are imagined", ge=1)
    readout_rows: int = assumed(
        8000,
        "recorded rows on which a ridge regression to the privileged vector is fitted",
        ge=2,
    )
    readout_penalty: float = assumed(
        0.01,
        "penalty of this regression per row, relative to the mean variance of the features",
        gt=0.0,
    )
    readout_step: int = assumed(5, "imagined step at which the regression is judged too", ge=1)
    threshold: float = assumed(
        0.5,
        "tau_c: expected costly steps within the horizon, discounted as in the safety gate, "
        "above which a cost counts as foreseen",
        ge=0.0,
    )
