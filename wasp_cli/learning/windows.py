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
    """B sequences of T steps, and which rows of the dataset they are."""

    batch: Batch
    rows: Tensor  # [B, T] rows of the recording
    places: Tensor  # [B, T] the same as places among the rows that may be learned from
    mirrored: Tensor  # [B] bool: left and right are exchanged
    memory: Tensor  # [B, T] where a `Context` remembers them: a row and its mirror image are two


class Windows:
    """Random sequences of those rows of a recording that may be learned from; a share of them
    contains a costly step.

    Where the task has a `mirror` (see `TaskInfo`), half of them are seen in it, with what follows:
    images alone, since nothing says what a vector is in a mirror.
    Everything lies on `device` (uint8 images included), so that a batch is one gather. On the CPU
    the recording's own memory is used.
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
        self.length, self._share = length, cost_share
        self._starts = len(rows) - length + 1
        if self._starts < 1:
            raise TrainingError(
                f"the dataset has {len(rows)} rows, fewer than one sequence of {length}",
                "collect more steps",
            )
        place = torch.device("cpu") if device is None else device

        def there(values: NDArray[Any]) -> Tensor:
            return torch.from_numpy(values).to(place)

        self._mirror = None if mirror is None else there(mirror)
        self._rows = there(rows)
        self._costly = there(np.flatnonzero(recording.cost[rows] > 0))
        self._seen = there(recording.seen)
        self._action = there(recording.action)
        self._reward, self._cost, self._terminal, self._first = map(
            there, (recording.reward, recording.cost, recording.terminal, recording.first)
        )

    def sample(self, batch: int, source: torch.Generator) -> Window:
        """Draw B sequences; episodes may change within one (`first` marks it)."""
        device = self._rows.device
        start = torch.randint(self._starts, (batch,), generator=source, device=device)
        wanted = round(self._share * batch)
        if wanted and len(self._costly):
            picked = self._costly[
                torch.randint(len(self._costly), (wanted,), generator=source, device=device)
            ]
            back = torch.randint(self.length, (wanted,), generator=source, device=device)
            start[:wanted] = (picked - back).clamp(0, self._starts - 1)
        places = start[:, None] + torch.arange(self.length, device=device)  # [B, T]
        rows = self._rows[places]
        fields = (self._seen, self._action, self._reward, self._cost, self._terminal, self._first)
        found = Batch(*(_at(values, rows) for values in fields))
        mirrored = torch.zeros(batch, dtype=torch.bool, device=device)
        if self._mirror is not None:
            mirrored = torch.rand(batch, generator=source, device=device) < 0.5
            found = found._replace(
                seen=in_mirror(found.seen, mirrored),
                action=self._turned(found.action, mirrored),
            )
        return Window(
            found, rows, places, mirrored, rows + len(self._first) * mirrored.unsqueeze(1)
        )

    def ahead(
        self,
        window: Window,
        starts: int,
        horizon: int,
        images: int,
        noise: int,
        source: torch.Generator,
    ) -> Ahead:
        """Return what followed random steps of a batch, in the window or behind it: only `images`
        of what was seen then is looked up.

        Args:
            window: B sequences of T steps.
            starts: N of them.
            images: M of the starts, N at most.
            noise: Gumbel variables per imagined step.
        """
        device, (batch, length) = self._rows.device, window.rows.shape
        row = torch.randint(batch, (starts,), generator=source, device=device)
        step = torch.randint(length, (starts,), generator=source, device=device)
        images = min(images, starts)
        shown = torch.randint(horizon, (images,), generator=source, device=device)
        # [N, K]
        places = window.places[row, step][:, None] + 1 + torch.arange(horizon, device=device)
        rows = self._rows[places.clamp(max=len(self._rows) - 1)]
        over = (places >= len(self._rows)).to(self._first.dtype)
        within = (1.0 - torch.maximum(self._first[rows], over)).cumprod(1)
        seen = _at(self._seen, rows[torch.arange(images, device=device), shown])
        action = self._action[rows]
        if self._mirror is not None:
            mirrored = window.mirrored[row]
            seen, action = in_mirror(seen, mirrored[:images]), self._turned(action, mirrored)
        draws = gumbel((horizon, starts, noise), source)
        return Ahead(
            row, step, action, self._reward[rows], self._cost[rows], within, shown, seen, draws
        )

    def _turned(self, action: Tensor, mirrored: Tensor) -> Tensor:
        """Actions [B, T, A], those of mirrored sequences [B] as their mirror images."""
        assert self._mirror is not None
        return torch.where(mirrored[:, None, None], action @ self._mirror.T, action)


def _at(values: Tensor, rows: Tensor) -> Tensor:
    """`values[rows]`, rows copied whole."""
    found: Tensor = values.index_select(0, rows.flatten()).unflatten(0, rows.shape)
    return found


def in_mirror(pixels: Tensor, mirrored: Tensor) -> Tensor:
    """Turn over some [B] of the images [B, ..., width], on the CPU in place."""
    # whole images are copied, a sixth of the time of a choice by pixel
    if pixels.device.type == "cpu":
        for row in mirrored.nonzero().flatten().tolist():
            pixels[row] = pixels[row].flip(-1)
        return pixels
    return torch.where(mirrored.view(-1, *[1] * (pixels.dim() - 1)), pixels.flip(-1), pixels)


class Context:
    """What training last inferred at every row of a recording: a sequence that begins within an
    episode goes on from there.

    Without it a sequence that begins inside a hazard could not know of it, because the camera does
    not see the ground below the robot. The latents are as old as the last visit of their row; no
    gradient flows into them.
    """

    def __init__(
        self, rows: int, deter: int, variables: int, device: torch.device | None = None
    ) -> None:
        self.h = torch.zeros(rows, deter, dtype=torch.float16, device=device)
        self.z = torch.zeros(rows, variables, dtype=torch.uint8, device=device)
        self.known = torch.zeros(rows, dtype=torch.bool, device=device)

    def enter(self, window: Window, classes: int) -> tuple[Batch, Latent]:
        """Return the batch with `first` set where nothing is known of what came before, and the
        latents [B, .] before its first step.
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
