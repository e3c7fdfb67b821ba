"""A disturbance of the world model within a calibrated budget (after LUCID, Seo and Bajcsy 2026).

The adversary shifts the logits of the prior p(z | h) at every imagined step. How far is bounded
three times, as in the original: the divergence from the prior stays within a budget (`radius`, mean
KL of a variable), only classes that the prior itself finds likely are promoted, and a disturbed
latent that looks like none of the data (`threshold`) is replaced by the undisturbed one. R rows, D
deterministic size, S variables, C classes, Z = S * C, F = D + Z features.
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
    """The disturbance, and what bounds it. It starts at none."""

    centre: Tensor  # [F] mean of latents
    whiten: Tensor  # [F, F] what turns centred latents into uncorrelated ones of variance 1
    radius: Tensor  # [] budget
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
        """Return what is to be added to the logits of a prior [R, S, C] at h [R, D], before the
        budget.
        """
        shift = self.largest * torch.tanh(self.net(h)).unflatten(-1, (self.variables, self.classes))
        unlikely = ~likely(prior, self.mass)
        return torch.where(unlikely, shift.amin(-1, keepdim=True), shift)

    def disturbed(self, h: Tensor, prior: Tensor, share: float = 1.0) -> Tensor:
        """Return log-probabilities [R, S, C] with as much of the tilt as `share` times the budget
        allows.
        """
        return within(prior, self.tilt(h, prior), share * self.radius)

    def oddness(self, latent: Latent) -> Tensor:
        """Return how unlike the data latents are, [R]: the mean squared whitened feature; 1 on
        average over the data.
        """
        return ((latent.features - self.centre) @ self.whiten).square().mean(-1)

    def learn_data(self, features: Tensor) -> None:
        """Set the Gaussian that `oddness` measures by, from features of the data [N, F]."""
        self.centre.copy_(features.mean(0))
        covariance = torch.cov(features.T.double())
        size = len(covariance)
        level = covariance.diagonal().mean()
        covariance = (1 - SHRINK) * covariance + SHRINK * level * torch.eye(size).double()
        inverse = torch.linalg.inv(covariance)
        self.whiten.copy_(torch.linalg.cholesky(inverse).float())


class DisturbedModel:
    """A world model whose imagined steps the adversary disturbs; its heads are as they were.
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
        found = Latent(h, rssm.sample(self.adversary.disturbed(h, prior, self.share), draws))
        odd = self.adversary.oddness(found) > self.adversary.threshold
        undisturbed = rssm.sample(prior, draws)
        return Latent(h, torch.where(odd.unsqueeze(-1), undisturbed, found.z))


def likely(prior: Tensor, mass: float) -> Tensor:
    """Return which classes belong to the smallest set with a probability of `mass`: bool [..., C]
    for log-probabilities [..., C].
    """
    probs, order = prior.exp().sort(dim=-1, descending=True)
    before = probs.cumsum(-1) - probs
    return torch.zeros_like(prior, dtype=torch.bool).scatter(-1, order, before < mass)


def divergence(left: Tensor, right: Tensor) -> Tensor:
    """Return KL[left || right] as a mean over variables, [...], of log-probabilities [..., S,
    C].
    """
    return (left.exp() * (left - right)).sum(-1).mean(-1)


def within(prior: Tensor, tilt: Tensor, radius: Tensor) -> Tensor:
    """Return log-probabilities [R, S, C] of the prior with the largest share of a tilt [R, S, C]
    whose divergence is at most the radius.

    The divergence grows with the share, so that bisection finds it; the share carries no gradient.
    At a radius of 0 the prior comes back as it was.
    """
    with torch.no_grad():
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
