"""The picture of an episode: which moments it shows."""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from PIL import Image

from wasp_cli.errors import UsageError
from wasp_cli.tasks import sheet
from wasp_cli.tasks.sheet import GAP, MOMENT, MOMENTS, draw_sheet


class Clock(gymnasium.Env[Any, Any]):
    """Shows its clock as a colour, and ends early."""

    metadata = {"render_modes": [], "render_fps": 25}
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,))
    observation_space = gymnasium.spaces.Box(0, 255, (64, 64, 3), np.uint8)
    ends_at = 10**9

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.clock = 0
        return self.seen(), {}

    def seen(self):
        return np.full((64, 64, 3), 1 + self.clock // 4 % 250, np.uint8)

    def step(self, action):
        self.clock += 1
        return self.seen(), 0.0, self.clock >= self.ends_at, False, {"cost": 0.0}


class Short(Clock):
    ends_at = 4 * 29


gymnasium.register("SheetClock-v0", entry_point=Clock, max_episode_steps=4 * 40)
gymnasium.register("SheetShort-v0", entry_point=Short, max_episode_steps=4 * 1000)
gymnasium.register("SheetLong-v0", entry_point=Clock, max_episode_steps=4 * 240)


def read(path: Path) -> np.ndarray[Any, Any]:
    return np.asarray(Image.open(path).convert("RGB"))


def decisions(path: Path) -> list[int]:
    """The clocks of a strip, in decision steps."""
    picture = read(path)
    row = picture.shape[0] - 2 * sheet.CAPTION - MOMENT // 2
    columns = [GAP + column * (MOMENT + GAP // 2) + MOMENT // 2 for column in range(MOMENTS)]
    return [int(picture[row, x, 0]) - 1 for x in columns if x < picture.shape[1] and picture[row, x, 0] != 255]


@pytest.mark.parametrize(
    ("task", "steps", "expected"),
    [
        ("SheetClock-v0", 14, [0, 2, 4, 6, 8, 10, 12, 14]),
        ("SheetClock-v0", 3, [0, 1, 2, 3]),
        ("SheetClock-v0", 100_000, [0, 6, 11, 17, 23, 29, 34, 40]),
        ("SheetShort-v0", 1000, [0, 4, 8, 12, 17, 21, 25, 29]),
    ],
    ids=["as asked", "few", "no longer than an episode", "an early end"],
)
def test_the_moments_are_spread_over_what_was_driven(task, steps, expected, tmp_path):
    assert decisions(draw_sheet(task, 0, steps, tmp_path / "a.png")) == expected


def test_the_folder_is_looked_for_before_anything_is_driven(tmp_path, monkeypatch):
    monkeypatch.setattr(sheet, "make_task", lambda *_, **__: pytest.fail("driven"))
    with pytest.raises(UsageError) as caught:
        draw_sheet("goal1", 0, 3, tmp_path / "missing" / "x.png")
    assert caught.value.hint == f"create the folder '{tmp_path / 'missing'}'"
