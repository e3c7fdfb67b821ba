"""The safety-aware world model: RSSM, decoder, and heads for reward, cost and continuation (Eq.
6). It sees camera images, or vectors where a task shows no image.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from wasp_cli.models.base import Latent
from wasp_cli.models.nets import CHANNELS, Decoder, Encoder, centred, mlp
from wasp_cli.models.rssm import RSSM, Observed, balanced_kl
from wasp_cli.models.vectors import standardised, vector_errors
from wasp_cli.models.weights import load_module, save_weights


@dataclass(frozen=True)
class Sizes:
    """What the constructor needs; stored beside the weights."""

    action: int
    deter: int
    hidden: int
    variables: int
    classes: int
    depth: int
    head: int
    unimix: float
    reward_scale: float
    cost_weight: float
    action_scales: Sequence[float] = (1.0,)
    # Of the vectors of the dataset, S each; empty of a model that sees images. They are kept here,
    # as the numbers that they are, because weights are stored in 16 bits.
    state_mean: Sequence[float] = ()
    state_std: Sequence[float] = ()
    reward_unit: float = 1.0
    """What a reward of 1 is in the loss: rewards are multiplied by reward_scale / reward_unit."""

    @property
    def stored(self) -> dict[str, Any]:
        """What is written beside the weights: nothing about vectors where the model sees images,
        and no unit where it is 1.
        """
        values = asdict(self)
        if not self.state_mean:
            del values["state_mean"], values["state_std"]
        if self.reward_unit == 1.0:
            del values["reward_unit"]
        return values


class Batch(NamedTuple):
    """Sequences by arrival: entry t holds o_t and what came with it (a_{t-1}, r_t, c_t)."""

    seen: Tensor  # images, uint8 [B, T, 6, 64, 64], or vectors [B, T, S]
    action: Tensor  # [B, T, A]
    reward: Tensor  # [B, T]
    cost: Tensor  # [B, T] in {0, 1}
    terminal: Tensor  # [B, T] in {0, 1}: the episode ended by the task's own rule
    first: Tensor  # [B, T] in {0, 1}


class Ahead(NamedTuple):
    """What followed N steps of a batch of sequences, to be imagined from their latents for K
    steps.
    """

    row: Tensor  # [N] sequence of each start
    step: Tensor  # [N] its step
    action: Tensor  # [N, K, A] what was executed from there on
    reward: Tensor  # [N, K]
    cost: Tensor  # [N, K]
    # [N, K] in {0, 1}: still the same episode; what follows a reset cannot be imagined
    within: Tensor
    # [M], M <= N: the imagined step in 0..K-1 whose observation is decoded, of the first M starts
    shown: Tensor
    seen: Tensor  # [M, ...]: that observation, an image or a vector
    noise: Tensor  # [K, N, S * C] standard Gumbel draws


class SafetyWorldModel(nn.Module):
    """Implements `models.base.WorldModel`; also its own losses."""

    mean_image: Tensor
    state_mean: Tensor
    state_std: Tensor

    def __init__(self, sizes: Sizes) -> None:
        super().__init__()
        self.sizes = sizes
        self.action_size = sizes.action
        self.encoder: nn.Module
        if sizes.state_mean:
            embed = sizes.hidden
            self.encoder = mlp(len(sizes.state_mean), (sizes.hidden, sizes.hidden), embed)
        else:
            self.encoder = Encoder(sizes.depth)
            embed = self.encoder.size
        self.embedding_size = embed
        self.rssm = RSSM(
            action=sizes.action,
            embed=embed,
            deter=sizes.deter,
            hidden=sizes.hidden,
            variables=sizes.variables,
            classes=sizes.classes,
            unimix=sizes.unimix,
            action_scales=sizes.action_scales,
        )
        self.feature_size = sizes.deter + self.rssm.flat
        self.noise_size = self.rssm.flat
        self.decoder: nn.Module
        if sizes.state_mean:
            hidden = (sizes.hidden, sizes.hidden)
            self.decoder = mlp(self.feature_size, hidden, len(sizes.state_mean))
        else:
            self.decoder = Decoder(self.feature_size, sizes.depth)
        heads = (sizes.head, sizes.head)
        self.reward_head = mlp(self.feature_size, heads, 1, zero=True)
        self.cost_head = mlp(self.feature_size, heads, 1)
        self.continue_head = mlp(self.feature_size, heads, 1)
        # What is seen is centred by the data set's mean, so that the decoder spends nothing on
        # what never changes.
        if sizes.state_mean:
            for name in ("state_mean", "state_std"):
                values = torch.tensor(tuple(getattr(sizes, name)), dtype=torch.float64)
                self.register_buffer(name, values, persistent=False)
        else:
            self.register_buffer("mean_image", torch.zeros(CHANNELS, 64, 64))

    @property
    def reads(self) -> str:
        """What it sees of an observation (`tasks.base.Observation`): `pixels` or `state`."""
        return "state" if self.sizes.state_mean else "pixels"

    @property
    def device(self) -> torch.device:
        """Where its weights lie."""
        return self.rssm.posterior_h.weight.device

    # -- perception --------------------------------------------------------------------------------

    def encoded(self, seen: Tensor) -> Tensor:
        """Map uint8 images [B, 6, 64, 64], or vectors [B, S], to embeddings [B, E]."""
        if self.sizes.state_mean:
            return self.encoder(self.standardised(seen))  # type: ignore[no-any-return]
        return self.encoder(seen, self.mean_image)  # type: ignore[no-any-return]

    def standardised(self, vectors: Tensor) -> Tensor:
        """Return vectors [..., S] in standard deviations of the dataset (`models.vectors`)."""
        return standardised(vectors, self.state_mean, self.state_std)

    def embed(self, seen: Tensor) -> Tensor:
        """Map uint8 images [B, 6, 64, 64], or vectors [B, S], to their half of the posterior's
        first layer [B, hidden].
        """
        return self.rssm.posterior_o(self.encoded(seen))  # type: ignore[no-any-return]

    def initial(self, batch: int) -> Latent:
        """Return the latent [B, .] before an episode."""
        return self.rssm.initial(batch)

    def filter(self, latent: Latent, action: Tensor, seen: Tensor, first: Tensor) -> Latent:
        """See `models.base.WorldModel.filter`. Takes the posterior's mode, so that filtering
        draws nothing.
        """
        keep = (1.0 - first.to(latent.h.dtype)).unsqueeze(-1)
        h = self.rssm.recur(Latent(latent.h * keep, latent.z * keep), action * keep)
        return Latent(h, self.rssm.sample(self.rssm.posterior(h, self.embed(seen)), None))

    def imagine(self, latent: Latent, action: Tensor, noise: Tensor) -> Latent:
        """See `models.base.WorldModel.imagine`."""
        h = self.rssm.recur(latent, action)
        return Latent(
            h,
            self.rssm.sample(
                self.rssm.prior(h), noise.unflatten(-1, (self.rssm.variables, self.rssm.classes))
            ),
        )

    @property
    def reward_unit(self) -> float:
        """The unit of rewards in which settings of assistants are: see `learning.reward_unit`."""
        return self.sizes.reward_unit

    @property
    def _reward_factor(self) -> float:
        return self.sizes.reward_scale / self.sizes.reward_unit

    # -- heads -------------------------------------------------------------------------------------

    def reward(self, latent: Latent) -> Tensor:
        """Predict the mean reward [...] at the arrived state."""
        return latent.through(self.reward_head).squeeze(-1) / self._reward_factor

    def cost_logit(self, latent: Latent) -> Tensor:
        """Predict the logit [...] of the cost probability.

        The weight of costly steps shifted the trained logit by its logarithm; it is removed.
        """
        return latent.through(self.cost_head).squeeze(-1) - math.log(self.sizes.cost_weight)

    def cost(self, latent: Latent) -> Tensor:
        """Predict c-hat, the probability [...] of a cost event at the arrived state."""
        return self.cost_logit(latent).sigmoid()

    def continues(self, latent: Latent) -> Tensor:
        """Predict the probability [...] that the episode goes on."""
        return latent.through(self.continue_head).squeeze(-1).sigmoid()

    def decode(self, latent: Latent) -> Tensor:
        """Decode images [B, 6, 64, 64] in [0, 1], or vectors [B, S] in the task's own units."""
        if self.sizes.state_mean:
            vectors: Tensor = self.decoder(latent.features) * self.state_std + self.state_mean
            return vectors.float()
        images: Tensor = (self.decoder(latent.features) + self.mean_image).clamp(0, 1)
        return images

    # -- losses of Eq. 6 ---------------------------------------------------------------------------

    def observe(self, batch: Batch, noise: Tensor, start: Latent | None = None) -> Observed:
        """Filter a batch of sequences; `noise` are Gumbel draws [B, T, S, C], `start` is the
        latent before their first step.
        """
        projected = self.embed(batch.seen.flatten(0, 1)).unflatten(0, batch.action.shape[:2])
        return self.rssm.observe(projected, batch.action, batch.first, noise, start)

    def losses(
        self,
        batch: Batch,
        noise: Tensor,
        decode_steps: Tensor,
        free_nats: float,
        *,
        start: Latent | None = None,
        ahead: Ahead | None = None,
    ) -> tuple[dict[str, Tensor], Latent]:
        """Return the terms of Eq. 6 by the weight that multiplies them, unweighted means over
        steps, and the filtered latents [B, T, .].

        Args:
            batch: B sequences of T steps.
            noise: Gumbel draws [B, T, S, C].
            decode_steps: indices of the steps whose observation is decoded (with images, a random
                share saves a third of the time).
            free_nats: see `balanced_kl`.
            start: the latent before the sequences; zeros by default.
            ahead: starts from which imagined latents are scored too (terms `ahead_r`, `ahead_c` and
                `ahead_o`, not in Eq. 6).
        """
        seen = self.observe(batch, noise, start)
        features = seen.latent.features  # [B, T, F]
        representation, prediction = balanced_kl(seen.posterior, seen.prior, free_nats)
        reward, cost = self.head_losses(features, batch.reward, batch.cost)
        terms = {
            "alpha_q": representation,
            "alpha_p": prediction,
            "beta_r": reward,
            "beta_c": cost,
            "beta_n": self.continuation_loss(features, batch.terminal),
        }
        decoded = features[:, decode_steps].flatten(0, 1)
        true = batch.seen[:, decode_steps].flatten(0, 1)
        if ahead is None:
            return terms | {"beta_o": self._decoding_errors(decoded, true).mean()}, seen.latent
        imagined = self._imagined(seen.latent, ahead)
        terms["ahead_r"], terms["ahead_c"] = self.head_losses(
            imagined, ahead.reward, ahead.cost, ahead.within
        )
        # What was filtered and what was imagined in one pass of the decoder.
        each = torch.arange(len(ahead.shown), device=ahead.row.device)
        errors = self._decoding_errors(
            torch.cat((decoded, imagined[each, ahead.shown])), torch.cat((true, ahead.seen))
        )
        terms["beta_o"] = errors[: len(decoded)].mean()
        if len(ahead.shown):
            counts = ahead.within[each, ahead.shown]
            terms["ahead_o"] = (errors[len(decoded) :] * counts).sum() / counts.sum().clamp(min=1.0)
        return terms, seen.latent

    def _decoding_errors(self, features: Tensor, seen: Tensor) -> Tensor:
        """Squared errors [N] of decoded images, summed over pixels, or of vectors
        (`vector_errors`). A sum over 24,576 values needs float32, whatever the autocast.
        """
        if self.sizes.state_mean:
            return vector_errors(self.decoder(features), self.standardised(seen))
        target = centred(seen, self.mean_image)
        return F.mse_loss(self.decoder(features).float(), target, reduction="none").sum((1, 2, 3))

    def _imagined(self, latent: Latent, ahead: Ahead) -> Tensor:
        """Features [N, K, F] along imagined rollouts from latents [B, T, .] under the recorded
        actions.

        Eq. 6 trains the prior on single steps, and what it knows of the surroundings blurs within
        ten. Reward, cost and observations of these count up to the end of the episode; the
        observations teach h to carry the surroundings.
        """
        start = Latent(latent.h[ahead.row, ahead.step], latent.z[ahead.row, ahead.step])
        return self.rssm.imagine(start, ahead.action, ahead.noise).features

    def head_losses(
        self, features: Tensor, reward: Tensor, cost: Tensor, counts: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return squared error of the scaled reward and weighted BCE of the cost: means over
        the steps that `counts` [...] marks with 1.
        """
        sizes = self.sizes
        counts = torch.ones_like(reward) if counts is None else counts
        total = counts.sum().clamp(min=1.0)
        error = (
            self.reward_head(features).squeeze(-1).float() - self._reward_factor * reward
        ).square()
        weight = torch.as_tensor(sizes.cost_weight, dtype=cost.dtype, device=cost.device)
        logit = self.cost_head(features).squeeze(-1).float()
        surprise = F.binary_cross_entropy_with_logits(
            logit, cost, pos_weight=weight, reduction="none"
        )
        return (error * counts).sum() / total, (surprise * counts).sum() / total

    def continuation_loss(
        self, features: Tensor, terminal: Tensor, counts: Tensor | None = None
    ) -> Tensor:
        """Return BCE of the probability that the episode goes on: mean over the steps that
        `counts` [...] marks with 1.
        """
        counts = torch.ones_like(terminal) if counts is None else counts
        logit = self.continue_head(features).squeeze(-1).float()
        surprise = F.binary_cross_entropy_with_logits(logit, 1.0 - terminal, reduction="none")
        return (surprise * counts).sum() / counts.sum().clamp(min=1.0)


def save_world_model(model: SafetyWorldModel, folder: Path) -> None:
    """Write `world_model.safetensors` and its sizes."""
    save_weights(model, folder / "world_model.safetensors", **model.sizes.stored)


def load_world_model(folder: Path) -> SafetyWorldModel:
    """Load the frozen model of a world-model artifact."""
    return load_module(
        lambda **sizes: SafetyWorldModel(Sizes(**sizes)), folder / "world_model.safetensors"
    )
