"""Training sequences of a recorded dataset, and the latents from which they go on."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wasp_cli.errors import TrainingError
from wasp_cli.learning.sampling import gumbel
from wasp_cli.learning.shards import Recording
from wasp_cli.models.base import Latent
from wasp_cli.models.world_model import Ahead, Batch


class Window(NamedTuple):
    """B sequences of T steps, and the rows of the dataset that they are made of."""

    batch: Batch
    rows: Tensor  # [B, T] rows of the recording
    places: Tensor  # [B, T] positions of these rows among the rows that may be learned from
    mirrored: Tensor  # [B] bool, left and right are exchanged
    memory: Tensor  # [B, T] cells of a `Context`; a row and its mirror image have one each


class Windows:
    """Random sequences of the rows of a recording that may be learned from.

    A share of the sequences contains a costly step. With a `mirror` (see `TaskInfo`) half of the
    sequences are mirrored; this is for images only, because the mirror image of a vector is not
    known. All data lies on `device`, the uint8 images included, so that a batch is one gather. On
    the CPU it is the memory of the recording itself.
    """

    def __init__(
        self,
        recording: Recording,
        rows: NDArray[np.int64],
        length: int,
        cost_share: float,
        device: torch.device | None = None,
        mirror: NDArray[np.float32] | None = None,
    ) -> None:
        """Move the data to the device.

        Args:
            recording: the whole dataset, N rows.
            rows: [K] the rows that may be learned from.
            length: T, steps of a sequence.
            cost_share: share of the sequences that contain a costly step.
            device: where the data lies; None is the CPU.
            mirror: [A, A] what an action becomes in a mirror; None: no sequence is mirrored.

        Raises:
            TrainingError: the rows are fewer than one sequence.
        """
        self.length = length
        self._share = cost_share
        self._starts = len(rows) - length + 1
        if self._starts < 1:
            raise TrainingError(
                f"the dataset has {len(rows)} rows, fewer than one sequence of {length}",
                "collect more steps",
            )
        target = torch.device("cpu") if device is None else device

        def moved(values: NDArray[Any]) -> Tensor:
            return torch.from_numpy(values).to(target)

        self._mirror = None if mirror is None else moved(mirror)
        self._rows = moved(rows)
        self._costly = moved(np.flatnonzero(recording.cost[rows] > 0))
        self._seen = moved(recording.seen)
        self._action = moved(recording.action)
        self._reward = moved(recording.reward)
        self._cost = moved(recording.cost)
        self._terminal = moved(recording.terminal)
        self._first = moved(recording.first)

    def sample(self, batch: int, source: torch.Generator) -> Window:
        """Draw B sequences. A sequence may run over the end of an episode into the next one, which
        `first` marks.
        """
        # -- starts [B]; the first ones such that the sequence contains a costly step
        device = self._rows.device
        start = torch.randint(self._starts, (batch,), generator=source, device=device)
        costly = round(self._share * batch)
        if costly and len(self._costly):
            choice = torch.randint(len(self._costly), (costly,), generator=source, device=device)
            back = torch.randint(self.length, (costly,), generator=source, device=device)
            start[:costly] = (self._costly[choice] - back).clamp(0, self._starts - 1)

        # -- gather
        places = start[:, None] + torch.arange(self.length, device=device)  # [B, T]
        rows = self._rows[places]
        sequences = Batch(
            _at(self._seen, rows),
            _at(self._action, rows),
            _at(self._reward, rows),
            _at(self._cost, rows),
            _at(self._terminal, rows),
            _at(self._first, rows),
        )

        # -- mirror half of them
        mirrored = torch.zeros(batch, dtype=torch.bool, device=device)
        if self._mirror is not None:
            mirrored = torch.rand(batch, generator=source, device=device) < 0.5
            sequences = sequences._replace(
                seen=in_mirror(sequences.seen, mirrored),
                action=self._mirrored_actions(sequences.action, mirrored),
            )
        memory = rows + len(self._first) * mirrored.unsqueeze(1)
        return Window(sequences, rows, places, mirrored, memory)

    def ahead(
        self,
        window: Window,
        starts: int,
        horizon: int,
        images: int,
        noise: int,
        source: torch.Generator,
    ) -> Ahead:
        """Return what followed random steps of a batch, in the window or behind it.

        Args:
            window: B sequences of T steps.
            starts: N, steps of the batch from which is imagined.
            horizon: K, imagined steps.
            images: M, starts for which one observation is looked up; N at most.
            noise: Gumbel variables per imagined step.
            source: of all draws.
        """
        # -- starts [N], and for the first M of them the imagined step whose observation is shown
        device = self._rows.device
        batch, length = window.rows.shape
        row = torch.randint(batch, (starts,), generator=source, device=device)
        step = torch.randint(length, (starts,), generator=source, device=device)
        images = min(images, starts)
        shown = torch.randint(horizon, (images,), generator=source, device=device)

        # -- the rows [N, K] that followed, and which of them belong to the same episode
        places = window.places[row, step][:, None] + 1 + torch.arange(horizon, device=device)
        rows = self._rows[places.clamp(max=len(self._rows) - 1)]
        over = (places >= len(self._rows)).to(self._first.dtype)
        within = (1.0 - torch.maximum(self._first[rows], over)).cumprod(1)

        # -- what was seen and done there, mirrored like its sequence
        seen = _at(self._seen, rows[torch.arange(images, device=device), shown])
        action = self._action[rows]
        if self._mirror is not None:
            mirrored = window.mirrored[row]
            seen = in_mirror(seen, mirrored[:images])
            action = self._mirrored_actions(action, mirrored)
        draws = gumbel((horizon, starts, noise), source)
        return Ahead(
            row, step, action, self._reward[rows], self._cost[rows], within, shown, seen, draws
        )

    def _mirrored_actions(self, action: Tensor, mirrored: Tensor) -> Tensor:
        """Return actions [B, T, A] with those of mirrored sequences [B] as their mirror images."""
        assert self._mirror is not None
        return torch.where(mirrored[:, None, None], action @ self._mirror.T, action)


def _at(values: Tensor, rows: Tensor) -> Tensor:
    """Return `values[rows]`; faster, because whole rows are copied."""
    gathered: Tensor = values.index_select(0, rows.flatten()).unflatten(0, rows.shape)
    return gathered


def in_mirror(pixels: Tensor, mirrored: Tensor) -> Tensor:
    """Exchange left and right in some [B] of the images [B, ..., width]; on the CPU in place."""
    # Whole images are copied, in a sixth of the time of `torch.where`.
    if pixels.device.type == "cpu":
        for row in mirrored.nonzero().flatten().tolist():
            pixels[row] = pixels[row].flip(-1)
        return pixels
    return torch.where(mirrored.view(-1, *[1] * (pixels.dim() - 1)), pixels.flip(-1), pixels)


class Context:
    """The latent that training last inferred at every row of a recording. A sequence that begins
    within an episode goes on from the latent of the row before it.

    Without it a sequence that begins inside a hazard could not know of the hazard, because the
    camera does not see the ground below the robot. A latent is as old as the last visit of its row;
    no gradient flows into it.
    """

    def __init__(
        self, rows: int, deter: int, variables: int, device: torch.device | None = None
    ) -> None:
        self.h = torch.zeros(rows, deter, dtype=torch.float16, device=device)
        self.z = torch.zeros(rows, variables, dtype=torch.uint8, device=device)
        self.known = torch.zeros(rows, dtype=torch.bool, device=device)

    def enter(self, window: Window, classes: int) -> tuple[Batch, Latent]:
        """Return the batch and the latents [B, .] before its first step. Where no latent is known
        yet, `first` is set in the batch: the sequence counts as the beginning of an episode.
        """
        before = (window.memory[:, 0] - 1).clamp(min=0)
        first = window.batch.first.clone()
        first[:, 0] = torch.where(self.known[before], first[:, 0], 1.0)
        z = torch.nn.functional.one_hot(self.z[before].long(), classes).to(torch.float32)
        return window.batch._replace(first=first), Latent(self.h[before].float(), z.flatten(-2))

    def keep(self, window: Window, latent: Latent) -> None:
        """Remember the latents [B, T, .] of a batch."""
        variables = self.z.shape[1]
        self.h[window.memory] = latent.h.detach().to(torch.float16)
        self.z[window.memory] = (
            latent.z.detach().unflatten(-1, (variables, -1)).argmax(-1).to(torch.uint8)
        )
        self.known[window.memory] = True

    def tensors(self) -> dict[str, Tensor]:
        """Return the state for a checkpoint; `load` takes them back."""
        return {"h": self.h, "z": self.z, "known": self.known.to(torch.uint8)}

    def load(self, tensors: dict[str, Tensor]) -> None:
        """Take back what `tensors` gave."""
        self.h.copy_(tensors["h"])
        self.z.copy_(tensors["z"])
        self.known.copy_(tensors["known"].bool())
