"""A disturbance of the world model within a calibrated budget (after LUCID, Seo and Bajcsy 2026).

The adversary shifts the logits of the prior p(z | h) at every imagined step. Three bounds limit the
shift, as in the original:

- The divergence from the prior stays within a budget (`radius`, the mean KL of a variable).
- Only classes that are likely under the prior itself are promoted.
- A disturbed latent that is unlike the data (`threshold`) is replaced by the undisturbed one.

R rows, D deterministic size, S variables, C classes, Z = S * C, F = D + Z features, N latents of
the data.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from wasp_cli.models.base import Latent
from wasp_cli.models.nets import mlp
from wasp_cli.models.world_model import SafetyWorldModel

HALVINGS = 10  # bisections for the largest disturbance within the budget
SHRINK = 0.1  # share of a multiple of the identity in the covariance of latents


class Adversary(nn.Module):
    """The disturbance, and its bounds. Before training it disturbs nothing."""

    centre: Tensor  # [F] mean of latents
    whiten: Tensor  # [F, F] turns centred latents into uncorrelated ones of variance 1
    radius: Tensor  # [] budget, in nats
    threshold: Tensor  # [] largest `oddness` of an undisturbed trajectory

    def __init__(
        self,
        deter: int,
        variables: int,
        classes: int,
        hidden: Sequence[int],
        largest: float = 15.0,
        mass: float = 0.9,
    ) -> None:
        """Build the adversary without a budget.

        Args:
            deter: D.
            variables: S.
            classes: C.
            hidden: widths of the network's layers.
            largest: bound of a shift of a logit.
            mass: probability of the smallest set of classes that counts as likely.
        """
        super().__init__()
        self.variables = variables
        self.classes = classes
        self.largest = largest
        self.mass = mass
        features = deter + variables * classes
        self.net = mlp(deter, hidden, variables * classes, zero=True)
        self.register_buffer("centre", torch.zeros(features))
        self.register_buffer("whiten", torch.eye(features))
        self.register_buffer("radius", torch.tensor(0.0))
        self.register_buffer("threshold", torch.tensor(torch.inf))

    def tilt(self, h: Tensor, prior: Tensor) -> Tensor:
        """Return the shift [R, S, C] of the logits of a prior [R, S, C] at h [R, D], before the
        budget limits it.
        """
        shift = self.largest * torch.tanh(self.net(h)).unflatten(-1, (self.variables, self.classes))
        unlikely = ~likely(prior, self.mass)
        return torch.where(unlikely, shift.amin(-1, keepdim=True), shift)

    def disturbed(self, h: Tensor, prior: Tensor, share: float = 1.0) -> Tensor:
        """Return the disturbed prior, log-probabilities [R, S, C]: with as much of the tilt as
        `share` times the budget allows.
        """
        return within(prior, self.tilt(h, prior), share * self.radius)

    def oddness(self, latent: Latent) -> Tensor:
        """Return how unlike the data latents [R, .] are, [R]: the mean squared whitened feature,
        which is 1 on average over the data.
        """
        return ((latent.features - self.centre) @ self.whiten).square().mean(-1)

    def learn_data(self, features: Tensor) -> None:
        """Fit the Gaussian by which `oddness` measures to features of the data [N, F]."""
        self.centre.copy_(features.mean(0))
        covariance = torch.cov(features.T.double())
        size = len(covariance)
        level = covariance.diagonal().mean()
        covariance = (1 - SHRINK) * covariance + SHRINK * level * torch.eye(size).double()
        inverse = torch.linalg.inv(covariance)
        self.whiten.copy_(torch.linalg.cholesky(inverse).float())


class DisturbedModel:
    """A world model whose imagined steps the adversary disturbs; its heads are unchanged.
    Implements `models.base.Dynamics`.
    """

    def __init__(self, model: SafetyWorldModel, adversary: Adversary, share: float = 1.0) -> None:
        """Disturb the steps of a model with `share` times the calibrated budget."""
        self.model = model
        self.adversary = adversary
        self.share = share
        self.action_size = model.action_size
        self.noise_size = model.noise_size
        self.reward = model.reward
        self.cost = model.cost
        self.continues = model.continues

    def imagine(self, latent: Latent, action: Tensor, noise: Tensor) -> Latent:
        """Imagine one prior step for actions [R, A] with the Gumbel draws [R, Z] that the
        undisturbed model would use.
        """
        rssm = self.model.rssm
        h = rssm.recur(latent, action)
        prior = rssm.prior(h)
        draws = noise.unflatten(-1, (rssm.variables, rssm.classes))

        # The disturbed latent, or the undisturbed one where that looks like none of the data.
        z = rssm.sample(self.adversary.disturbed(h, prior, self.share), draws)
        odd = self.adversary.oddness(Latent(h, z)) > self.adversary.threshold
        undisturbed_z = rssm.sample(prior, draws)
        return Latent(h, torch.where(odd.unsqueeze(-1), undisturbed_z, z))


def likely(prior: Tensor, mass: float) -> Tensor:
    """Return which classes belong to the smallest set with a probability of `mass`: bool [..., C]
    for log-probabilities [..., C].
    """
    probs, order = prior.exp().sort(dim=-1, descending=True)
    mass_before = probs.cumsum(-1) - probs  # of the classes that are more likely
    return torch.zeros_like(prior, dtype=torch.bool).scatter(-1, order, mass_before < mass)


def divergence(left: Tensor, right: Tensor) -> Tensor:
    """Return KL[left || right] in nats, the mean over variables [...], for log-probabilities
    [..., S, C].
    """
    return (left.exp() * (left - right)).sum(-1).mean(-1)


def within(prior: Tensor, tilt: Tensor, radius: Tensor) -> Tensor:
    """Return log-probabilities [R, S, C] of the prior with the largest share of a tilt [R, S, C]
    whose divergence is at most the radius.

    The divergence grows with the share, so that bisection finds the share, which carries no
    gradient. At a radius of 0 the prior comes back as it was.
    """
    with torch.no_grad():
        # The share of each row, between `low`, which is within the radius, and `high`.
        low = prior.new_zeros(len(prior), 1, 1)
        high = torch.ones_like(low)
        whole = divergence(_tilted(prior, tilt), prior).view(-1, 1, 1) <= radius
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            fits = divergence(_tilted(prior, middle * tilt), prior).view(-1, 1, 1) <= radius
            low = torch.where(fits, middle, low)
            high = torch.where(fits, high, middle)
        share = torch.where(whole, 1.0, low)
    return torch.where((share > 0) & (radius > 0), _tilted(prior, share * tilt), prior)


def _tilted(prior: Tensor, tilt: Tensor) -> Tensor:
    return F.log_softmax(prior + tilt, -1)
