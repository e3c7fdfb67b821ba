"""Building blocks of every network: layers, encoder, decoder. B rows, F features."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

CHANNELS = 6  # front RGB and rear RGB


def mlp(inputs: int, hidden: Sequence[int], outputs: int, *, zero: bool = False) -> nn.Sequential:
    """Build linear layers with LayerNorm and SiLU between them; `zero` starts the last layer at
    zero.
    """
    layers: list[nn.Module] = []
    width = inputs
    for size in hidden:
        layers += [nn.Linear(width, size), nn.LayerNorm(size), nn.SiLU()]
        width = size
    last = nn.Linear(width, outputs)
    if zero:
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
    return nn.Sequential(*layers, last)


def centred(pixels: Tensor, mean: Tensor, white: float = 1.0) -> Tensor:
    """Convert uint8 images [B, 6, 64, 64] to [0, white] minus `white` times a mean image [6,
    64, 64] in [0, 1]; channels last in memory.
    """
    # For speed, bytes become channels-last before they become floats, and everything afterwards
    # happens in place.
    images = pixels.contiguous(memory_format=torch.channels_last).to(mean.dtype, copy=True)
    if white != 255.0:
        images.mul_(white / 255.0)
    return images.sub_((mean * white).unsqueeze(0).contiguous(memory_format=torch.channels_last))


def _channels_last(images: Tensor) -> Tensor:
    return images.contiguous(memory_format=torch.channels_last)


class Encoder(nn.Module):
    """Images uint8 [B, 6, 64, 64] minus a mean image to embeddings [B, 128 * depth]: four
    convolutions 4x4, stride 2.
    """

    def __init__(self, depth: int) -> None:
        """Build convolutions of depth, 2 depth, 4 depth and 8 depth channels."""
        super().__init__()
        sizes = [CHANNELS, depth, 2 * depth, 4 * depth, 8 * depth]
        self.layers = nn.ModuleList(nn.Conv2d(a, b, 4, 2, 1) for a, b in pairwise(sizes))
        self.size = 8 * depth * 16

    def forward(self, pixels: Tensor, mean: Tensor) -> Tensor:
        """Return the embeddings of `pixels` / 255 - `mean`, where `mean` [6, 64, 64] is in
        [0, 1].
        """
        first, *rest = self.layers
        assert isinstance(first, nn.Conv2d)
        # To subtract the convolution of the mean image instead would cost a sum over the batch in
        # the backward pass.
        x = F.silu(F.conv2d(centred(pixels, mean, 255.0), first.weight / 255.0, first.bias, 2, 1))
        for layer in rest:
            x = F.silu(layer(x))
        # The backward pass undoes the flattening channels-first, and one such gradient makes all
        # further ones twice as slow.
        if x.requires_grad:
            x.register_hook(_channels_last)
        return x.flatten(1)


class Decoder(nn.Module):
    """Features [B, F] to images [B, 6, 64, 64] minus the mean image of the dataset."""

    def __init__(self, features: int, depth: int) -> None:
        """Build transposed convolutions from 8 depth channels back to those of an image."""
        super().__init__()
        sizes = [8 * depth, 4 * depth, 2 * depth, depth, CHANNELS]
        self.depth = depth
        self.inputs = nn.Linear(features, 8 * depth * 16)
        self.layers = nn.ModuleList(nn.ConvTranspose2d(a, b, 4, 2, 1) for a, b in pairwise(sizes))

    def forward(self, features: Tensor) -> Tensor:
        """Return images [B, 6, 64, 64] minus the mean image, for features [B, F]."""
        x = self.inputs(features).view(-1, 8 * self.depth, 4, 4)
        x = x.contiguous(memory_format=torch.channels_last)
        for i, layer in enumerate(self.layers):
            if i > 0:
                x = F.silu(x)
            x = layer(x)
        images: Tensor = x
        return images
