"""The safety-aware world model: RSSM, decoder, and heads for reward, cost and continuation (Eq.
6).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from wasp_cli.models.base import Latent
from wasp_cli.models.nets import CHANNELS, Decoder, Encoder, centred, mlp
from wasp_cli.models.rssm import RSSM, Observed, balanced_kl
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
    reward_unit: float = 1.0
    """What a reward of 1 is in the loss: rewards are multiplied by reward_scale / reward_unit."""


class Batch(NamedTuple):
    """Sequences by arrival: entry t holds o_t and what came with it (a_{t-1}, r_t, c_t)."""

    pixels: Tensor  # uint8 [B, T, 6, 64, 64]
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
    # [M], M <= N: the imagined step in 0..K-1 whose image is decoded, of the first M starts
    shown: Tensor
    pixels: Tensor  # uint8 [M, 6, 64, 64]: that image
    noise: Tensor  # [K, N, S * C] standard Gumbel draws


class SafetyWorldModel(nn.Module):
    """Implements `models.base.WorldModel`; also its own losses."""

    reads: ClassVar[str] = "pixels"
    mean_image: Tensor

    def __init__(self, sizes: Sizes) -> None:
        super().__init__()
        self.sizes = sizes
        self.action_size = sizes.action
        self.encoder = Encoder(sizes.depth)
        self.rssm = RSSM(
            action=sizes.action,
            embed=self.encoder.size,
            deter=sizes.deter,
            hidden=sizes.hidden,
            variables=sizes.variables,
            classes=sizes.classes,
            unimix=sizes.unimix,
            action_scales=sizes.action_scales,
        )
        self.feature_size = sizes.deter + self.rssm.flat
        self.noise_size = self.rssm.flat
        self.decoder = Decoder(self.feature_size, sizes.depth)
        heads = (sizes.head, sizes.head)
        self.reward_head = mlp(self.feature_size, heads, 1, zero=True)
        self.cost_head = mlp(self.feature_size, heads, 1)
        self.continue_head = mlp(self.feature_size, heads, 1)
        # Images are centred by the data set's mean, so that the decoder spends nothing on what
        # never changes.
        self.register_buffer("mean_image", torch.zeros(CHANNELS, 64, 64))

    # -- perception --------------------------------------------------------------------------------

    def embed(self, pixels: Tensor) -> Tensor:
        """Map uint8 images [B, 6, 64, 64] to the image half of the posterior's first layer [B,
        hidden].
        """
        return self.rssm.posterior_o(self.encoder(pixels, self.mean_image))  # type: ignore[no-any-return]

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
        """Decode images [B, 6, 64, 64] in [0, 1]."""
        images: Tensor = (self.decoder(latent.features) + self.mean_image).clamp(0, 1)
        return images

    # -- losses of Eq. 6 ---------------------------------------------------------------------------

    def observe(self, batch: Batch, noise: Tensor, start: Latent | None = None) -> Observed:
        """Filter a batch of sequences; `noise` are Gumbel draws [B, T, S, C], `start` is the
        latent before their first step.
        """
        projected = self.embed(batch.pixels.flatten(0, 1)).unflatten(0, batch.action.shape[:2])
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
            decode_steps: indices of the steps whose image is decoded (a random share saves a third
                of the time).
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
        decoded, pixels = (
            features[:, decode_steps].flatten(0, 1),
            batch.pixels[:, decode_steps].flatten(0, 1),
        )
        if ahead is None:
            return terms | {"beta_o": self._image_errors(decoded, pixels).mean()}, seen.latent
        imagined = self._imagined(seen.latent, ahead)
        terms["ahead_r"], terms["ahead_c"] = self.head_losses(
            imagined, ahead.reward, ahead.cost, ahead.within
        )
        # Both kinds of images in one pass of the decoder.
        each = torch.arange(len(ahead.shown), device=ahead.row.device)
        errors = self._image_errors(
            torch.cat((decoded, imagined[each, ahead.shown])), torch.cat((pixels, ahead.pixels))
        )
        terms["beta_o"] = errors[: len(decoded)].mean()
        if len(ahead.shown):
            counts = ahead.within[each, ahead.shown]
            terms["ahead_o"] = (errors[len(decoded) :] * counts).sum() / counts.sum().clamp(min=1.0)
        return terms, seen.latent

    def _image_errors(self, features: Tensor, pixels: Tensor) -> Tensor:
        """Squared errors of decoded images, summed over pixels: [N]. A sum over 24,576 values
        needs float32, whatever the autocast.
        """
        target = centred(pixels, self.mean_image)
        return F.mse_loss(self.decoder(features).float(), target, reduction="none").sum((1, 2, 3))

    def _imagined(self, latent: Latent, ahead: Ahead) -> Tensor:
        """Features [N, K, F] along imagined rollouts from latents [B, T, .] under the recorded
        actions.

        Eq. 6 trains the prior on single steps, and what it knows of the surroundings blurs within
        ten. Reward, cost and images of these count up to the end of the episode; the images teach h
        to carry the surroundings.
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
    save_weights(model, folder / "world_model.safetensors", **asdict(model.sizes))


def load_world_model(folder: Path) -> SafetyWorldModel:
    """Load the frozen model of a world-model artifact."""
    return load_module(
        lambda **sizes: SafetyWorldModel(Sizes(**sizes)), folder / "world_model.safetensors"
    )
