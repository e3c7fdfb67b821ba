"""The recurrent state-space model with categorical latents (section 4.1 of the paper).

Dimension letters: B sequences, T steps, A action, K scales of an action, D deterministic size, S
variables, C classes, Z = S * C, E embedding. A step is indexed by arrival: h_t follows from
(h_{t-1}, z_{t-1}, a_{t-1}); z_t is inferred from h_t and o_t.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from wasp_cli.models.base import Latent
from wasp_cli.models.unroll import unroll, weights


class Observed(NamedTuple):
    """A filtered sequence."""

    latent: Latent  # h [B, T, D], z [B, T, Z] (straight-through samples)
    posterior: Tensor  # [B, T, S, C] log-probabilities of q(z_t | h_t, o_t)
    prior: Tensor  # [B, T, S, C] log-probabilities of p(z_t | h_t)


class RSSM(nn.Module):
    """f_theta, p_theta and q_theta of Eq. 6."""

    scales: Tensor  # [K, 1]

    def __init__(
        self,
        *,
        action: int,
        embed: int,
        deter: int,
        hidden: int,
        variables: int,
        classes: int,
        unimix: float,
        action_scales: Sequence[float] = (1.0,),
    ) -> None:
        """Build the model.

        Args:
            action: A.
            embed: E.
            deter: D.
            hidden: width of the layers around the recurrence.
            variables: S.
            classes: C.
            unimix: share of a uniform distribution in every categorical.
            action_scales: see `scaled`.
        """
        super().__init__()
        # Constructor arguments define the scales; they are not stored with the weights.
        scales = torch.tensor(tuple(action_scales)).unsqueeze(-1)
        self.register_buffer("scales", scales, persistent=False)
        self.deter = deter
        self.variables = variables
        self.classes = classes
        self.unimix = unimix
        self.flat = variables * classes
        self.inputs = nn.Sequential(
            nn.Linear(self.flat + len(action_scales) * action, hidden),
            nn.LayerNorm(hidden),
            nn.SiLU(),
        )
        self.cell = nn.GRUCell(hidden, deter)
        self.prior_net = nn.Sequential(
            nn.Linear(deter, hidden), nn.LayerNorm(hidden), nn.SiLU(), nn.Linear(hidden, self.flat)
        )
        # The first posterior layer in two halves: the image half needs no recurrence and runs once
        # for a whole sequence.
        self.posterior_h = nn.Linear(deter, hidden)
        self.posterior_o = nn.Linear(embed, hidden, bias=False)
        self.posterior_net = nn.Sequential(
            nn.LayerNorm(hidden), nn.SiLU(), nn.Linear(hidden, self.flat)
        )

    def initial(self, batch: int) -> Latent:
        """Return the latent [B, .] before an episode: zeros, as after the mask at its start."""
        reference = self.posterior_h.weight
        return Latent(reference.new_zeros(batch, self.deter), reference.new_zeros(batch, self.flat))

    def recur(self, latent: Latent, action: Tensor) -> Tensor:
        """Return h_{t+1} = f_theta(h_t, z_t, a_t), [B, D], for actions [B, A]."""
        h: Tensor = self.cell(self.inputs(torch.cat([latent.z, self.scaled(action)], -1)), latent.h)
        return h

    def scaled(self, action: Tensor) -> Tensor:
        """Return the action as the recurrence reads it, [..., K * A]: clip(a / s, -1, 1) for every
        scale s.

        Motors saturate: a torque may be at its limit from |a| = 0.02 on. A smooth layer fits such a
        step by a slope, and a planner then finds corrections that do something in the model and
        nothing in the world.
        """
        return (action.unsqueeze(-2) / self.scales).clamp(-1, 1).flatten(-2)

    def prior(self, h: Tensor) -> Tensor:
        """Return log-probabilities of p_theta(z | h), [..., S, C], at h [..., D]."""
        return self._mixed(self.prior_net(h))

    def posterior(self, h: Tensor, projected: Tensor) -> Tensor:
        """Return log-probabilities of q_theta(z | h, o), [..., S, C], at h [..., D];
        `projected` [..., hidden] is posterior_o(embedding).
        """
        return self._mixed(self.posterior_net(self.posterior_h(h) + projected))

    def _mixed(self, logits: Tensor) -> Tensor:
        """Return log-probabilities [..., S, C] of logits [..., Z] with a share of a uniform
        distribution.
        """
        # The uniform share keeps every KL finite. In float32, whatever the autocast.
        shaped = logits.float().unflatten(-1, (self.variables, self.classes))
        probs = (1 - self.unimix) * shaped.softmax(-1) + self.unimix / self.classes
        logs: Tensor = probs.log()
        return logs

    def sample(self, log_probs: Tensor, noise: Tensor | None) -> Tensor:
        """Draw one-hot z [..., Z] from log-probabilities [..., S, C] by the Gumbel trick, with
        straight-through gradients.

        Args:
            log_probs: [..., S, C].
            noise: standard Gumbel draws [..., S, C]; None: the mode is returned.
        """
        scores = log_probs if noise is None else log_probs + noise
        hard = F.one_hot(scores.argmax(-1), self.classes).to(log_probs.dtype)
        if torch.is_grad_enabled():
            probs = log_probs.exp()
            hard = hard + probs - probs.detach()
        return hard.flatten(-2)

    def observe(
        self,
        projected: Tensor,
        action: Tensor,
        first: Tensor,
        noise: Tensor,
        start: Latent | None = None,
    ) -> Observed:
        """Filter sequences.

        Args:
            projected: posterior_o(embedding), [B, T, hidden].
            action: a_{t-1} that led to step t, [B, T, A].
            first: 1 where an episode starts, [B, T]; h, z and the action are masked there.
            noise: standard Gumbel draws [B, T, S, C].
            start: the latent before step 0; zeros by default.
        """
        # The order of these statements is that in which autograd adds up gradients, to the bit.
        keep = (1.0 - first.float()).t().unsqueeze(-1)  # [T, B, 1]
        added = (projected + self.posterior_h.bias).transpose(0, 1)
        norm, _, logits = self.posterior_net
        hidden = self.posterior_h.weight
        layers = weights(self.inputs, self.cell, hidden, norm, logits, self.flat)  # type: ignore[arg-type]
        if start is None:
            start = self.initial(len(action))
        inputs = self._from_action(action.transpose(0, 1) * keep)
        sequence = unroll(start, inputs, keep, added, noise.transpose(0, 1), self.unimix, layers)
        return Observed(
            latent=sequence.latent,
            posterior=sequence.log_probs,
            prior=self.prior(sequence.latent.h),
        )

    def imagine(self, start: Latent, action: Tensor, noise: Tensor) -> Latent:
        """Imagine K steps from N latents [N, .] by the prior, with gradients: fields [N, K, .].

        Args:
            start: the latents before the first step.
            action: the actions that are executed, [N, K, A].
            noise: standard Gumbel draws [K, N, Z].
        """
        first, norm, _, logits = self.prior_net
        hidden = first.weight
        layers = weights(self.inputs, self.cell, hidden, norm, logits, self.flat)  # type: ignore[arg-type]
        inputs = self._from_action(action.transpose(0, 1))
        added = first.bias.expand(*noise.shape[:2], -1)  # type: ignore[operator]
        draws = noise.unflatten(-1, (self.variables, self.classes))
        return unroll(start, inputs, None, added, draws, self.unimix, layers).latent

    def _from_action(self, action: Tensor) -> Tensor:
        """Return what the action [..., A] and the bias give to the layer that reads z and action,
        [..., hidden].
        """
        layer = self.inputs[0]
        return F.linear(self.scaled(action), layer.weight[:, self.flat :], layer.bias)  # type: ignore[index, arg-type]


def kl_divergence(left: Tensor, right: Tensor) -> Tensor:
    """Return KL[left || right] in nats, [...], of categoricals given as log-probabilities
    [..., S, C], summed over the S variables.
    """
    return (left.exp() * (left - right)).sum((-2, -1))


def balanced_kl(posterior: Tensor, prior: Tensor, free_nats: float) -> tuple[Tensor, Tensor]:
    """Return the first two terms of Eq. 6 for log-probabilities [..., S, C]: (representation,
    prediction), each a mean over steps.

    Free nats clip the KL summed over the variables, so that no gradient flows below them.
    """
    representation = kl_divergence(posterior, prior.detach()).clamp(min=free_nats).mean()
    prediction = kl_divergence(posterior.detach(), prior).clamp(min=free_nats).mean()
    return representation, prediction
