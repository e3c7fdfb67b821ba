"""What a world model is taught and asked of the privileged vector, in training only: no assistant
reads it.

Reconstruction alone does not tell an encoder where to look: a barrel is a few pixels, and costs an
episode.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from wasp_cli.learning.configs.world import WorldModelConfig
from wasp_cli.learning.sampling import generator
from wasp_cli.learning.shards import Recording
from wasp_cli.learning.windows import in_mirror
from wasp_cli.models.nets import mlp
from wasp_cli.models.world_model import SafetyWorldModel

Report = Callable[[float, str], None]
CONSTANT = 1e-3  # standard deviation below which an entry of the vector counts as constant


Mirror = tuple[NDArray[np.int64], NDArray[np.float32]]
"""Order and sign [P] of a mirrored vector, see `tasks.privileged_layout`; a sign of 0 marks an
entry that is not known.
"""


class Readout(nn.Module):
    """A two-layer head that tells the standardised privileged vector [P] from features [F]."""

    mean: Tensor
    std: Tensor

    def __init__(self, inputs: int, hidden: int, outputs: int) -> None:
        super().__init__()
        self.net = mlp(inputs, (hidden, hidden), outputs)
        self.register_buffer("mean", torch.zeros(outputs))
        self.register_buffer("std", torch.ones(outputs))

    def standardise(self, privileged: NDArray[np.float32]) -> None:
        """Take mean and standard deviation from vectors [N, P]; constant entries are left as
        they are.
        """
        mean, std = privileged.mean(0), privileged.std(0)
        self.mean.copy_(torch.from_numpy(mean))
        self.std.copy_(torch.from_numpy(np.where(std > CONSTANT, std, 1.0).astype(np.float32)))

    def loss(
        self, features: Tensor, privileged: Tensor, mirrored: Tensor, mirror: Mirror | None
    ) -> Tensor:
        """Return the squared error, summed over the known entries of the standardised vector, as a
        mean over the rows.

        Args:
            features: [B, ..., F] of what was seen.
            privileged: [B, ..., P] recorded with it.
            mirrored: [B] where it was seen in a mirror.
            mirror: what a vector is there; None: nothing is known of it.
        """
        turned = mirrored.view(-1, *[1] * (privileged.dim() - 1))
        sign = torch.zeros_like(self.mean)
        if mirror is not None:
            order, sign = (torch.from_numpy(each).to(privileged.device) for each in mirror)
            privileged = torch.where(turned, privileged[..., order] * sign, privileged)
        known = torch.where(turned, (sign != 0).to(privileged.dtype), 1.0)
        errors = (self.net(features).float() - (privileged - self.mean) / self.std).square()
        return (errors * known).sum(-1).mean()  # type: ignore[no-any-return]


def untaught(config: WorldModelConfig, recording: Recording) -> dict[str, Any]:
    """Return the settings that a model of vectors has instead of those of `config`.

    Its encoder has nothing to search for in a vector, so it is not taught; and where assistants see
    what the expert sees, the decoder tells the privileged vector already.
    """
    changed: dict[str, Any] = {"taught": 0}
    if np.array_equal(recording.state, recording.privileged):
        changed["privileged"] = 0.0
    return changed


def new_readout(
    model: SafetyWorldModel, recording: Recording, rows: NDArray[np.int64], config: WorldModelConfig
) -> Readout:
    """Build an untrained readout of the latents, on the model's device, standardised by those
    rows [K] of a recording.
    """
    readout = Readout(model.feature_size, config.head, recording.privileged.shape[1])
    readout.standardise(recording.privileged[rows])
    return readout.to(model.device)


def teach_encoder(
    model: SafetyWorldModel,
    recording: Recording,
    rows: NDArray[np.int64],
    config: WorldModelConfig,
    seed: int,
    report: Report,
    *,
    mirror: Mirror | None = None,
) -> list[float]:
    """Train the encoder on single images to tell the privileged vector, before Eq. 6 trains the
    whole model. An encoder of vectors needs no such teaching.

    Args:
        model: its encoder is trained in place.
        recording: pixels and privileged of the whole dataset [N].
        rows: [K] those of it that may be learned from.
        mirror: where given, half of the images are seen in a mirror.

    Returns:
        The mean squared error per entry of the standardised vector, a value per 20 updates.
    """
    device = model.device
    torch.manual_seed(seed)
    readout = Readout(model.embedding_size, config.taught_head, recording.privileged.shape[1])
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
        index = places[
            torch.randint(
                len(places), (config.taught_batch,), generator=source, device=device
            ).cpu()
        ]
        mirrored = torch.rand(len(index), generator=source, device=device) < (
            0.5 if mirror is not None else 0.0
        )
        images = in_mirror(pixels.index_select(0, index).to(device), mirrored)
        loss = readout.loss(model.encoded(images), privileged[index].to(device), mirrored, mirror)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        if update % 20 == 0 or update == config.taught - 1:
            curve.append(float(loss.detach()) / privileged.shape[1])
            report(
                (update + 1) / config.taught,
                f"teaching the encoder, update {update + 1}/{config.taught}, error {curve[-1]:.2f}",
            )
    return curve
