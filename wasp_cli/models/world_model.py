"""The safety-aware world model: RSSM, decoder, and heads for reward, cost and continuation (Eq.
6). It sees camera images, or vectors where a task shows no image.

Dimension letters: B rows or sequences, T steps of a sequence, N starts of imagined rollouts of K
steps, A actions, D deterministic size, S variables (of an observed vector: components), C classes,
Z = S * C, F = D + Z features, E embedding.
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
    """The constructor's arguments; stored beside the weights."""

    action: int  # A
    deter: int  # D
    hidden: int  # width of the layers around the recurrence
    variables: int  # S
    classes: int  # C
    depth: int  # channels of the encoder's first layer
    head: int  # width of the heads
    unimix: float  # share of a uniform distribution in every categorical
    reward_scale: float  # factor of rewards in the loss
    cost_weight: float  # weight of costly steps in the loss
    action_scales: Sequence[float] = (1.0,)  # see `RSSM.scaled`
    # Mean and standard deviation of the dataset's vectors, S numbers each; empty for a model that
    # sees images. They stand here because weights are stored in 16 bits.
    state_mean: Sequence[float] = ()
    state_std: Sequence[float] = ()
    reward_unit: float = 1.0  # in the loss, rewards are multiplied by reward_scale / reward_unit

    @property
    def stored(self) -> dict[str, Any]:
        """The arguments as they are written beside the weights: without vectors where the model
        sees images, and without a unit where it is 1.
        """
        values = asdict(self)
        if not self.state_mean:
            del values["state_mean"], values["state_std"]
        if self.reward_unit == 1.0:
            del values["reward_unit"]
        return values


class Batch(NamedTuple):
    """Sequences by arrival: entry t holds o_t and what came with it (a_{t-1}, r_t, c_t).

    Flags are 0 or 1.
    """

    seen: Tensor  # images, uint8 [B, T, 6, 64, 64], or vectors [B, T, S]
    action: Tensor  # [B, T, A]
    reward: Tensor  # [B, T]
    cost: Tensor  # [B, T] whether the step cost
    terminal: Tensor  # [B, T] whether the episode ended by the task's own rule
    first: Tensor  # [B, T] whether an episode starts


class Ahead(NamedTuple):
    """What followed N steps of a batch of sequences in the next K steps, to be imagined from their
    latents.
    """

    row: Tensor  # [N] sequence of each start
    step: Tensor  # [N] its step
    action: Tensor  # [N, K, A] what was executed from there on
    reward: Tensor  # [N, K]
    cost: Tensor  # [N, K]
    # [N, K] 1 within the same episode, then 0: what follows a reset cannot be imagined
    within: Tensor
    # [M], M <= N: the imagined step in 0..K-1 whose observation is decoded, of the first M starts
    shown: Tensor
    seen: Tensor  # [M, ...]: that observation, an image or a vector
    noise: Tensor  # [K, N, S * C] standard Gumbel draws


class SafetyWorldModel(nn.Module):
    """The world model, which implements `models.base.WorldModel`, and its losses."""

    mean_image: Tensor  # [6, 64, 64] of the dataset, in [0, 1]
    state_mean: Tensor  # [S] of the dataset's vectors
    state_std: Tensor  # [S]

    def __init__(self, sizes: Sizes) -> None:
        """Build an untrained model; its reward head predicts 0."""
        super().__init__()
        self.sizes = sizes
        self.action_size = sizes.action

        # Perception, which feeds the posterior.
        self.encoder: nn.Module
        if sizes.state_mean:
            embed = sizes.hidden
            self.encoder = mlp(len(sizes.state_mean), (sizes.hidden, sizes.hidden), embed)
        else:
            self.encoder = Encoder(sizes.depth)
            embed = self.encoder.size
        self.embedding_size = embed

        # The recurrent state-space model.
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

        # Decoder and heads.
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

        # Observations are centred by the dataset's mean, so that the decoder spends no capacity on
        # what never changes.
        if sizes.state_mean:
            for name in ("state_mean", "state_std"):
                values = torch.tensor(tuple(getattr(sizes, name)), dtype=torch.float64)
                self.register_buffer(name, values, persistent=False)
        else:
            self.register_buffer("mean_image", torch.zeros(CHANNELS, 64, 64))

    @property
    def reads(self) -> str:
        """Which field of an observation it sees (`tasks.base.Observation`): `pixels` or
        `state`.
        """
        return "state" if self.sizes.state_mean else "pixels"

    @property
    def device(self) -> torch.device:
        """The device of its weights."""
        return self.rssm.posterior_h.weight.device

    # -- perception --------------------------------------------------------------------------------

    def encoded(self, seen: Tensor) -> Tensor:
        """Return embeddings [B, E] of uint8 images [B, 6, 64, 64], or of vectors [B, S]."""
        if self.sizes.state_mean:
            return self.encoder(self.standardised(seen))  # type: ignore[no-any-return]
        return self.encoder(seen, self.mean_image)  # type: ignore[no-any-return]

    def standardised(self, vectors: Tensor) -> Tensor:
        """Return vectors [..., S] in standard deviations of the dataset (`models.vectors`)."""
        return standardised(vectors, self.state_mean, self.state_std)

    def embed(self, seen: Tensor) -> Tensor:
        """Return what uint8 images [B, 6, 64, 64], or vectors [B, S], give to the posterior's first
        layer: [B, hidden].
        """
        return self.rssm.posterior_o(self.encoded(seen))  # type: ignore[no-any-return]

    def initial(self, batch: int) -> Latent:
        """Return the latent [B, .] before an episode."""
        return self.rssm.initial(batch)

    def filter(self, latent: Latent, action: Tensor, seen: Tensor, first: Tensor) -> Latent:
        """See `models.base.WorldModel.filter`. z is the posterior's mode, so that filtering draws
        nothing.
        """
        keep = (1.0 - first.to(latent.h.dtype)).unsqueeze(-1)
        h = self.rssm.recur(Latent(latent.h * keep, latent.z * keep), action * keep)
        return Latent(h, self.rssm.sample(self.rssm.posterior(h, self.embed(seen)), None))

    def imagine(self, latent: Latent, action: Tensor, noise: Tensor) -> Latent:
        """See `models.base.Dynamics.imagine`."""
        h = self.rssm.recur(latent, action)
        draws = noise.unflatten(-1, (self.rssm.variables, self.rssm.classes))
        return Latent(h, self.rssm.sample(self.rssm.prior(h), draws))

    @property
    def reward_unit(self) -> float:
        """The unit of rewards in assistants' settings: see `learning.reward_unit`."""
        return self.sizes.reward_unit

    @property
    def _reward_factor(self) -> float:
        """The factor of rewards in the loss."""
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
        """Filter a batch of sequences.

        Args:
            batch: B sequences of T steps.
            noise: Gumbel draws [B, T, S, C].
            start: the latent before their first step; zeros by default.
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
        """Return the terms of Eq. 6, and the filtered latents [B, T, .].

        A term is an unweighted mean over steps; its name is that of the weight that multiplies it.

        Args:
            batch: B sequences of T steps.
            noise: Gumbel draws [B, T, S, C].
            decode_steps: indices of the steps whose observation is decoded. With images, a random
                share of them saves a third of the time.
            free_nats: see `balanced_kl`.
            start: the latent before the sequences; zeros by default.
            ahead: starts from which latents are imagined, and scored too (terms `ahead_r`,
                `ahead_c` and `ahead_o`, which are not in Eq. 6).
        """
        # Filter the sequences; their latents are scored by everything but the decoder.
        sequence = self.observe(batch, noise, start)
        features = sequence.latent.features  # [B, T, F]
        representation, prediction = balanced_kl(sequence.posterior, sequence.prior, free_nats)
        reward, cost = self.head_losses(features, batch.reward, batch.cost)
        terms = {
            "alpha_q": representation,
            "alpha_p": prediction,
            "beta_r": reward,
            "beta_c": cost,
            "beta_n": self.continuation_loss(features, batch.terminal),
        }

        # Decode some of their steps.
        decoded = features[:, decode_steps].flatten(0, 1)
        true = batch.seen[:, decode_steps].flatten(0, 1)
        if ahead is None:
            errors = self._decoding_errors(decoded, true)
            return terms | {"beta_o": errors.mean()}, sequence.latent

        # Imagine from some of their latents, and score that too.
        imagined = self._imagined(sequence.latent, ahead)  # [N, K, F]
        ahead_reward, ahead_cost = self.head_losses(
            imagined, ahead.reward, ahead.cost, ahead.within
        )
        terms["ahead_r"] = ahead_reward
        terms["ahead_c"] = ahead_cost

        # Filtered and imagined steps go through the decoder together.
        starts = torch.arange(len(ahead.shown), device=ahead.row.device)
        shown = imagined[starts, ahead.shown]  # [M, F]
        errors = self._decoding_errors(torch.cat((decoded, shown)), torch.cat((true, ahead.seen)))
        terms["beta_o"] = errors[: len(decoded)].mean()
        if len(ahead.shown):
            counts = ahead.within[starts, ahead.shown]
            total = counts.sum().clamp(min=1.0)
            terms["ahead_o"] = (errors[len(decoded) :] * counts).sum() / total
        return terms, sequence.latent

    def _decoding_errors(self, features: Tensor, seen: Tensor) -> Tensor:
        """Return the squared errors [R] of what features [R, F] decode to: of images, summed over
        pixels, or of vectors (`vector_errors`).

        A sum over 24,576 values needs float32, whatever the autocast.
        """
        if self.sizes.state_mean:
            return vector_errors(self.decoder(features), self.standardised(seen))
        target = centred(seen, self.mean_image)
        return F.mse_loss(self.decoder(features).float(), target, reduction="none").sum((1, 2, 3))

    def _imagined(self, latent: Latent, ahead: Ahead) -> Tensor:
        """Return the features [N, K, F] of rollouts imagined from latents [B, T, .] under the
        recorded actions.

        Eq. 6 trains the prior on single steps, and what it knows of the surroundings blurs within
        ten steps. Observations of these rollouts teach h to keep the surroundings; they count up to
        the end of the episode, and so do rewards and costs.
        """
        start = Latent(latent.h[ahead.row, ahead.step], latent.z[ahead.row, ahead.step])
        return self.rssm.imagine(start, ahead.action, ahead.noise).features

    def head_losses(
        self, features: Tensor, reward: Tensor, cost: Tensor, counts: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return the squared error of the scaled reward, and the weighted cross-entropy of the
        cost: means over steps.

        Args:
            features: [..., F].
            reward: [...].
            cost: [...] 0 or 1.
            counts: [...] 1 for the steps that count, 0 for others; all by default.
        """
        if counts is None:
            counts = torch.ones_like(reward)
        total = counts.sum().clamp(min=1.0)

        scaled_reward = self.reward_head(features).squeeze(-1).float()
        error = (scaled_reward - self._reward_factor * reward).square()

        logit = self.cost_head(features).squeeze(-1).float()
        weight = torch.as_tensor(self.sizes.cost_weight, dtype=cost.dtype, device=cost.device)
        cross_entropy = F.binary_cross_entropy_with_logits(
            logit, cost, pos_weight=weight, reduction="none"
        )
        return (error * counts).sum() / total, (cross_entropy * counts).sum() / total

    def continuation_loss(
        self, features: Tensor, terminal: Tensor, counts: Tensor | None = None
    ) -> Tensor:
        """Return the cross-entropy of the probability that the episode goes on: a mean over steps.

        Args:
            features: [..., F].
            terminal: [...] 1 where the episode ended.
            counts: as in `head_losses`.
        """
        if counts is None:
            counts = torch.ones_like(terminal)
        logit = self.continue_head(features).squeeze(-1).float()
        cross_entropy = F.binary_cross_entropy_with_logits(logit, 1.0 - terminal, reduction="none")
        return (cross_entropy * counts).sum() / counts.sum().clamp(min=1.0)


def save_world_model(model: SafetyWorldModel, folder: Path) -> None:
    """Write `world_model.safetensors` to a folder, and the sizes beside it."""
    save_weights(model, folder / "world_model.safetensors", **model.sizes.stored)


def load_world_model(folder: Path) -> SafetyWorldModel:
    """Return the frozen model of a world-model artifact.

    Raises:
        ArtifactError: a file of it cannot be read.
    """

    def build(**sizes: Any) -> SafetyWorldModel:
        return SafetyWorldModel(Sizes(**sizes))

    return load_module(build, folder / "world_model.safetensors")
