"""What a world model is taught and asked of the privileged vector: the encoder before Eq. 6, the latents along with it.

Reconstruction alone does not tell an encoder where to look: a barrel is a few pixels, and costs an episode. Privileged state is used in
training only, as the expert's labels are; what is trained here stays beside the world model, and no assistant reads it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from wasp_cli.learning.configs import WorldModelConfig
from wasp_cli.learning.sampling import generator
from wasp_cli.learning.shards import Recording
from wasp_cli.models.nets import mlp
from wasp_cli.models.world_model import SafetyWorldModel

Report = Callable[[float, str], None]
CONSTANT = 1e-3
"""Standard deviation below which an entry of the vector counts as constant."""


class Readout(nn.Module):
    """A two-layer head that tells the standardised privileged vector from features."""

    mean: Tensor
    std: Tensor

    def __init__(self, inputs: int, hidden: int, outputs: int) -> None:
        super().__init__()
        self.net = mlp(inputs, (hidden, hidden), outputs)
        self.register_buffer("mean", torch.zeros(outputs))
        self.register_buffer("std", torch.ones(outputs))

    def standardise(self, privileged: NDArray[np.float32]) -> None:
        """Take mean and standard deviation from vectors [N, P]; constant entries are left as they are."""
        mean, std = privileged.mean(0), privileged.std(0)
        self.mean.copy_(torch.from_numpy(mean))
        self.std.copy_(torch.from_numpy(np.where(std > CONSTANT, std, 1.0).astype(np.float32)))

    def errors(self, features: Tensor, privileged: Tensor) -> Tensor:
        """Return the squared errors [...] of features [..., F] for vectors [..., P], summed over the standardised vector."""
        wanted = (privileged - self.mean) / self.std
        return (self.net(features).float() - wanted).square().sum(-1)  # type: ignore[no-any-return]


def new_readout(model: SafetyWorldModel, recording: Recording, rows: NDArray[np.int64], config: WorldModelConfig) -> Readout:
    """Build an untrained readout of the latents, on the model's device, standardised by those rows [K] of a recording."""
    readout = Readout(model.feature_size, config.head, recording.privileged.shape[1])
    readout.standardise(recording.privileged[rows])
    return readout.to(model.mean_image.device)


def teach_encoder(
    model: SafetyWorldModel, recording: Recording, rows: NDArray[np.int64], config: WorldModelConfig, seed: int, report: Report
) -> list[float]:
    """Train the encoder on single images to tell the privileged vector, before Eq. 6 trains the whole model.

    Args:
        model: its encoder is trained in place.
        recording: pixels and privileged of the whole dataset.
        rows: those of it that may be learned from.
        config: updates, batch, learning rate and shift.
        seed: of the batches and the head's first weights.
        report: called every 20 updates.

    Returns:
        The mean squared error per entry of the standardised vector, a value per 20 updates.
    """
    device = model.mean_image.device
    torch.manual_seed(seed)
    readout = Readout(model.encoder.size, config.taught_head, recording.privileged.shape[1])
    readout.standardise(recording.privileged[rows])
    readout.to(device)
    learned = [*model.encoder.parameters(), *readout.parameters()]
    optimizer = torch.optim.Adam(learned, lr=config.taught_rate, fused=True)
    source = generator(seed, device)
    places = torch.from_numpy(rows)
    pixels, privileged = torch.from_numpy(recording.pixels), torch.from_numpy(recording.privileged)
    curve: list[float] = []
    for update in range(config.taught):
        for group in optimizer.param_groups:
            # Constant for the first half, then down to a tenth.
            group["lr"] = config.taught_rate * min(1.0, 1.9 - 1.8 * update / config.taught)
        index = places[torch.randint(len(places), (config.taught_batch,), generator=source, device=device).cpu()]
        images = shifted_images(pixels[index].to(device), config.taught_shift, source)
        loss = readout.errors(model.encoder(images, model.mean_image), privileged[index].to(device)).mean()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        if update % 20 == 0 or update == config.taught - 1:
            curve.append(float(loss.detach()) / privileged.shape[1])
            report((update + 1) / config.taught, f"teaching the encoder, update {update + 1}/{config.taught}, error {curve[-1]:.2f}")
    return curve


def shifted_images(pixels: Tensor, most: int, source: torch.Generator) -> Tensor:
    """Shift every image of [B, C, 64, 64] by up to `most` pixels in both directions, its border repeated."""
    if not most:
        return pixels
    batch, height, width = len(pixels), pixels.shape[-2], pixels.shape[-1]
    moved = torch.randint(-most, most + 1, (2, batch, 1), generator=source, device=pixels.device)
    down = (torch.arange(height, device=pixels.device) + moved[0]).clamp(0, height - 1)  # [B, H]
    right = (torch.arange(width, device=pixels.device) + moved[1]).clamp(0, width - 1)
    each = torch.arange(batch, device=pixels.device).view(-1, 1, 1)
    return pixels.permute(0, 2, 3, 1)[each, down.unsqueeze(2), right.unsqueeze(1)].permute(0, 3, 1, 2)
