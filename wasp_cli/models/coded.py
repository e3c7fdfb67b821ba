"""Latents whose z is given by its classes: a network that reads them looks up rows of its weights
instead of multiplying by zeros.

z is one-hot in each of its S variables, so that W z is a sum of S columns of W: S / Z of the
arithmetic, and the same number up to the order of the sum. For inference alone: nothing here
carries a gradient. Dimension letters: R rows, K steps, D deterministic size, Z flat stochastic
size, S variables, N outputs.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Self
from weakref import WeakKeyDictionary

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from wasp_cli.models.base import Latent

# rows that go through a network at a time, so that the values between its layers stay in a core's
# cache
ROWS = 512


class Coded(Latent):
    """h [..., D], and in the place of z the positions of its ones: int32 [..., S], for each
    variable the index within z.
    """

    flat: int  # Z
    # outputs of networks by their `id`: a policy may be asked twice about the same latent
    answers: dict[int, Tensor]

    @classmethod
    def of(cls, h: Tensor, ones: Tensor, flat: int) -> Self:
        """Return the latent of h [..., D] and the positions of the ones [..., S] in z, which has
        `flat` entries.
        """
        latent = cls(h, ones)
        latent.flat = flat
        latent.answers = {}
        return latent

    def step(self, k: int) -> Coded:
        """Return step k [R, .] of a rollout [K, R, .], as a view."""
        return self.of(self.h[k], self.z[k], self.flat)

    @property
    def features(self) -> Tensor:
        """Join h and the one-hot z: [..., D + Z].

        The tensor has this latent as its attribute `latent`, which a `LatentPolicy` reads in its
        place; it is not to be changed in place.
        """
        size = self.h.shape[-1]
        joined = self.h.new_zeros(*self.h.shape[:-1], size + self.flat)
        joined[..., :size] = self.h
        joined.scatter_(-1, self.z.long() + size, 1.0)
        joined.latent = self  # type: ignore[attr-defined]
        return joined

    def through(self, net: Callable[[Tensor], Tensor]) -> Tensor:
        """Return the outputs [..., N] of a network that begins with a linear layer of features."""
        if not isinstance(net, nn.Sequential) or torch.is_grad_enabled():
            return net(self.features)
        answer = self.answers.get(id(net))
        if answer is None:
            h = self.h.flatten(0, -2).split(ROWS)
            ones = self.z.flatten(0, -2).split(ROWS)
            parts = [_through(net, *rows) for rows in zip(h, ones, strict=True)]
            answer = torch.cat(parts).unflatten(0, self.h.shape[:-1])
            self.answers[id(net)] = answer
        return answer


def _through(net: nn.Sequential, h: Tensor, ones: Tensor) -> Tensor:
    """Return the outputs [R, N] of a network for rows h [R, D] with the ones [R, S] of their z."""
    linear, *rest = net
    assert isinstance(linear, nn.Linear)
    first = first_layer(linear, h.shape[-1])
    x = torch.addmm(first.bias, h, first.h).add_(looked_up(first.z, ones))
    for layer in rest:
        x = in_place(layer, x)
    return x


def in_place(layer: nn.Module, x: Tensor) -> Tensor:
    """Return the outputs of one layer of a network for x [R, N], which may be overwritten; the
    function is called without the overhead of a module.

    Raises:
        TypeError: the layer is no SiLU, LayerNorm or Linear.
    """
    if isinstance(layer, nn.SiLU):
        return F.silu(x, inplace=True)
    if isinstance(layer, nn.LayerNorm):
        return torch.layer_norm(x, layer.normalized_shape, layer.weight, layer.bias, layer.eps)
    if isinstance(layer, nn.Linear):
        return F.linear(x, layer.weight, layer.bias)
    raise TypeError(f"a network of latents has no layer {type(layer).__name__}")


def looked_up(table: Tensor, ones: Tensor) -> Tensor:
    """Return z W [R, N], for W = `table` [Z, N] and a one-hot z whose ones [R, S] are given."""
    rows, variables = ones.shape
    begins = torch.arange(0, rows * variables, variables, dtype=ones.dtype, device=ones.device)
    return torch.embedding_bag(table, ones.flatten(), begins, False, 0, False)[0]


class FirstLayer(NamedTuple):
    """A linear layer of features, split into the parts that read h and z."""

    h: Tensor  # [D, N]
    z: Tensor  # [Z, N]: one row for each class of each variable
    bias: Tensor  # [N]


class Stamp(NamedTuple):
    """What differs once the weights of a layer have changed."""

    tensor: int  # `id` of the weight
    version: int  # number of its changes in place; -1 where torch does not count them
    device: torch.device


class Split(NamedTuple):
    """The parts of a layer, and of which weights they are."""

    stamp: Stamp
    layer: FirstLayer


_SPLITS: WeakKeyDictionary[nn.Linear, Split] = WeakKeyDictionary()


def first_layer(linear: nn.Linear, deter: int) -> FirstLayer:
    """Return the parts of a linear layer of features [., D + Z], where D is `deter`. They are laid
    out anew only when its weights have changed.
    """
    weight = linear.weight
    version = -1 if weight.is_inference() else weight._version
    stamp = Stamp(id(weight), version, weight.device)
    split = _SPLITS.get(linear)
    if split is None or split.stamp != stamp:
        matrix = weight.detach().t()
        layer = FirstLayer(
            matrix[:deter].contiguous(), matrix[deter:].contiguous(), linear.bias.detach()
        )
        split = Split(stamp, layer)
        _SPLITS[linear] = split
    return split.layer
