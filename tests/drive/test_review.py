"""After an episode: the same commands in the same world without the assistant."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.drive.conftest import wanted
from wasp_cli.drive.block import Driven
from wasp_cli.drive.desk import GO, Desk, Held


@pytest.mark.slow
def test_the_second_drive_has_the_same_world_and_the_commands_alone(imported: Path) -> None:
    session = wanted(imported, "wasp", 40.0).prepared()
    desk = Desk()
    desk.come()
    ((cell, node),) = session.blocks
    block = session.built(desk, cell, node, node.axes["method_config"])
    threading.Timer(0.2, desk.ask, (GO,)).start()
    desk.held = Held(frozenset({"ArrowUp", "ArrowLeft"}))
    try:
        driven = block.episode(0, 0, 0, most=60)
    finally:
        block.close()
    assert isinstance(driven, Driven)
    review = block.review(driven)
    assert review["driven"][0]["things"] == review["alone"][0]["things"]
    assert len(review["driven"]) == len(review["alone"]) == 61

    # What was executed, as commands alone, is what was driven: to the last digit.
    numbers = ("robot", "things", "cost", "costly", "goals", "return")
    driven.trajectory = replace(driven.trajectory, a_h=driven.trajectory.a)
    again = block.review(driven)["alone"]
    assert [{name: header[name] for name in numbers} for header in review["driven"]] == again
    assert not np.array_equal([h["robot"] for h in again], [h["robot"] for h in review["alone"]]), "the assistant corrected something"
