"""Pictures that belong to an artifact."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from wasp_cli.learning.latents import Latents
from wasp_cli.learning.replay import Replay
from wasp_cli.models.world_model import SafetyWorldModel


@torch.inference_mode()
def reconstruction_sheet(model: SafetyWorldModel, replay: Replay, latents: Latents, path: Path, columns: int = 10) -> None:
    """Rows: true front, decoded front, true rear, decoded rear; columns: steps spread over the held-out episodes, half of them costly."""
    spread = np.linspace(0, len(replay.first) - 1, columns).astype(int)
    costly = np.flatnonzero(replay.cost > 0)
    if len(costly):
        spread[columns // 2 :] = costly[np.linspace(0, len(costly) - 1, columns - columns // 2).astype(int)]
    index = torch.from_numpy(spread)
    true = replay.pixels[spread]  # [K, 6, 64, 64]
    decoded = (model.decode(latents.at(index)).numpy() * 255).astype(np.uint8)
    rows = [np.concatenate([hwc(image[c : c + 3]) for image in source], 1) for c in (0, 3) for source in (true, decoded)]
    sheet = Image.fromarray(np.concatenate(rows, 0))
    sheet.resize((sheet.width * 2, sheet.height * 2), Image.Resampling.NEAREST).save(path)


def hwc(image: NDArray[np.uint8]) -> NDArray[Any]:
    """Channels last: [3, H, W] to [H, W, 3]."""
    return np.ascontiguousarray(image.transpose(1, 2, 0))
