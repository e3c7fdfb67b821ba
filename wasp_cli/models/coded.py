"""Latents whose z is known by its classes: a network that reads them looks up rows of its weights
instead of multiplying by zeros.

z is one-hot in each of its S variables, so that W z is a sum of S columns of W: S / Z of the
arithmetic, and the same number up to the order of the sum. For inference alone: nothing here
carries a gradient. Dimension letters: R rows, D deterministic size, Z flat stochastic size, S
variables, N outputs.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Self
from weakref import WeakKeyDictionary

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from wasp_cli.models.base import Latent

# rows that go through a network at a time: what lies between its layers stays in a core's cache
ROWS = 512


class Coded(Latent):
    """h [..., D], and in the place of z the position of the one of each variable within z:
    int32 [..., S].
    """

    flat: int  # Z
    # what networks have answered, by their identity: a policy may be asked twice about the same
    # latent
    known: dict[int, Tensor]

    @classmethod
    def of(cls, h: Tensor, ones: Tensor, flat: int) -> Self:
        """Make a latent of h [..., D] and the positions of the ones [..., S] in z, which has
        `flat` entries.
        """
        made = cls(h, ones)
        made.flat, made.known = flat, {}
        return made

    def step(self, k: int) -> Coded:
        """Return step k [R, .] of a rollout [K, R, .]: a view."""
        return self.of(self.h[k], self.z[k], self.flat)

    @property
    def features(self) -> Tensor:
        """Join h and the one-hot z: [..., D + Z]. A `LatentPolicy` sees which latent they are
        of; they are not to be changed in place.
        """
        size = self.h.shape[-1]
        joined = self.h.new_zeros(*self.h.shape[:-1], size + self.flat)
        joined[..., :size] = self.h
        joined.scatter_(-1, self.z.long() + size, 1.0)
        joined.latent = self  # type: ignore[attr-defined]
        return joined

    def through(self, net: Callable[[Tensor], Tensor]) -> Tensor:
        """Return what a network that begins with a linear layer of features says: [..., N]."""
        if not isinstance(net, nn.Sequential) or torch.is_grad_enabled():
            return net(self.features)
        if (answer := self.known.get(id(net))) is None:
            h, ones = self.h.flatten(0, -2), self.z.flatten(0, -2)
            parts = [
                _through(net, *rows) for rows in zip(h.split(ROWS), ones.split(ROWS), strict=True)
            ]
            answer = self.known[id(net)] = torch.cat(parts).unflatten(0, self.h.shape[:-1])
        return answer


def _through(net: nn.Sequential, h: Tensor, ones: Tensor) -> Tensor:
    """Run rows h [R, D] with the ones [R, S] of their z through a network."""
    linear, *rest = net
    assert isinstance(linear, nn.Linear)
    first = first_layer(linear, h.shape[-1])
    x = torch.addmm(first.bias, h, first.h).add_(looked_up(first.z, ones))
    for layer in rest:
        x = in_place(layer, x)
    return x


def in_place(layer: nn.Module, x: Tensor) -> Tensor:
    """Return what one layer of a network says of x [R, N], which may be overwritten; without
    the calls around a module.
    """
    if isinstance(layer, nn.SiLU):
        return F.silu(x, inplace=True)
    if isinstance(layer, nn.LayerNorm):
        return torch.layer_norm(x, layer.normalized_shape, layer.weight, layer.bias, layer.eps)
    if isinstance(layer, nn.Linear):
        return F.linear(x, layer.weight, layer.bias)
    raise TypeError(f"a network of latents has no layer {type(layer).__name__}")


def looked_up(table: Tensor, ones: Tensor) -> Tensor:
    """Return z W of one-hot z with ones [R, S], for W = `table` [Z, N]: [R, N]."""
    rows, variables = ones.shape
    begins = torch.arange(0, rows * variables, variables, dtype=ones.dtype, device=ones.device)
    return torch.embedding_bag(table, ones.flatten(), begins, False, 0, False)[0]


class FirstLayer(NamedTuple):
    """A linear layer of features as it is read here."""

    h: Tensor  # [D, N]
    z: Tensor  # [Z, N]: one row for each class of each variable
    bias: Tensor  # [N]


_LAYERS: WeakKeyDictionary[nn.Linear, tuple[tuple[int, int, torch.device], FirstLayer]] = (
    WeakKeyDictionary()
)


def first_layer(linear: nn.Linear, deter: int) -> FirstLayer:
    """Return the parts of a linear layer of features [., deter + Z], laid out anew only when
    its weights have changed.
    """
    weight = linear.weight
    stamp = (id(weight), -1 if weight.is_inference() else weight._version, weight.device)
    held = _LAYERS.get(linear)
    if held is None or held[0] != stamp:
        matrix = weight.detach().t()
        held = (
            stamp,
            FirstLayer(
                matrix[:deter].contiguous(), matrix[deter:].contiguous(), linear.bias.detach()
            ),
        )
        _LAYERS[linear] = held
    return held[1]
