"""The privileged vector in the training of a world model: the encoder is taught to read it from
single images, and a head on the latents to predict it. No assistant reads it.

Reconstruction alone does not show an encoder where to look: a barrel is a few pixels, and costs an
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
"""Order and sign [P] of a mirrored vector, see `tasks.privileged_layout`. A sign of 0 marks an
entry whose mirrored value is not known.
"""


class Readout(nn.Module):
    """A two-layer head that predicts the standardised privileged vector [P] from features [F]."""

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
        mean = privileged.mean(0)
        std = privileged.std(0)
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
            mirrored: [B] bool, what was seen is mirrored.
            mirror: what a mirrored vector is; None: no entry of one is known.
        """
        # -- the vectors of mirrored rows; `weight` is 0 for entries that are not known
        is_mirrored = mirrored.view(-1, *[1] * (privileged.dim() - 1))
        sign = torch.zeros_like(self.mean)
        if mirror is not None:
            order = torch.from_numpy(mirror[0]).to(privileged.device)
            sign = torch.from_numpy(mirror[1]).to(privileged.device)
            privileged = torch.where(is_mirrored, privileged[..., order] * sign, privileged)
        weight = torch.where(is_mirrored, (sign != 0).to(privileged.dtype), 1.0)

        # -- error
        errors = (self.net(features).float() - (privileged - self.mean) / self.std).square()
        return (errors * weight).sum(-1).mean()  # type: ignore[no-any-return]


def untaught(config: WorldModelConfig, recording: Recording) -> dict[str, Any]:
    """Return the settings that replace those of `config` for a model that sees vectors.

    Its encoder is not taught, because it has nothing to search for in a vector. Where assistants
    see what the expert sees, there is no loss on the privileged vector either: the decoder already
    reconstructs it.
    """
    settings: dict[str, Any] = {"taught": 0}
    if np.array_equal(recording.state, recording.privileged):
        settings["privileged"] = 0.0
    return settings


def new_readout(
    model: SafetyWorldModel, recording: Recording, rows: NDArray[np.int64], config: WorldModelConfig
) -> Readout:
    """Build an untrained readout of the latents on the model's device, standardised by `rows` [K]
    of the recording.
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
    """Train the encoder to predict the privileged vector from single images, before Eq. 6 trains
    the whole model. An encoder of vectors is not taught (see `untaught`).

    Args:
        model: its encoder is trained in place.
        recording: pixels and privileged vectors of the whole dataset, N rows.
        rows: [K] the rows that may be learned from.
        config: updates, batch and rate of the teaching.
        seed: of the weights of the readout and of all draws.
        report: called every 20 updates with the share that is done and a text.
        mirror: what a mirrored vector is; with it half of the images are mirrored.

    Returns:
        The mean squared error per entry of the standardised vector, a value per 20 updates.
    """
    # -- a readout of its own, which is thrown away afterwards
    device = model.device
    torch.manual_seed(seed)
    readout = Readout(model.embedding_size, config.taught_head, recording.privileged.shape[1])
    readout.standardise(recording.privileged[rows])
    readout.to(device)
    parameters = [*model.encoder.parameters(), *readout.parameters()]
    optimizer = torch.optim.Adam(parameters, lr=config.taught_rate, fused=True)

    # -- data
    source = generator(seed, device)
    allowed = torch.from_numpy(rows)
    pixels = torch.from_numpy(recording.pixels)
    privileged = torch.from_numpy(recording.privileged)
    mirror_share = 0.5 if mirror is not None else 0.0
    curve: list[float] = []
    for update in range(config.taught):
        # -- anneal the rate: constant for the first half, then down to a tenth
        for group in optimizer.param_groups:
            group["lr"] = config.taught_rate * min(1.0, 1.9 - 1.8 * update / config.taught)

        # -- sample images
        places = torch.randint(
            len(allowed), (config.taught_batch,), generator=source, device=device
        )
        index = allowed[places.cpu()]
        mirrored = torch.rand(len(index), generator=source, device=device) < mirror_share
        images = in_mirror(pixels.index_select(0, index).to(device), mirrored)

        # -- update
        loss = readout.loss(model.encoded(images), privileged[index].to(device), mirrored, mirror)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()

        # -- curve
        if update % 20 == 0 or update == config.taught - 1:
            curve.append(float(loss.detach()) / privileged.shape[1])
            report(
                (update + 1) / config.taught,
                f"teaching the encoder, update {update + 1}/{config.taught}, error {curve[-1]:.2f}",
            )
    return curve
