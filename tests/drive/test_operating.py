"""A person drives with the assistant at its operating point, or is told that it is silent."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from tests.drive.conftest import wanted
from wasp_cli.drive.block import ALONE
from wasp_cli.drive.desk import Desk
from wasp_cli.methods.human import HumanOnly
from wasp_cli.tasks.goal.task import Goal

pytestmark = pytest.mark.slow  # held-out episodes with published models


@pytest.fixture(scope="module", autouse=True)
def short() -> Iterator[None]:
    """Episodes end after 100 decisions."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Goal, "num_steps", 400)
        yield


def test_a_silent_assistant_is_loaded_as_nobody_and_the_terminal_says_so(
    imported: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # None of a correction is executed: the episodes are those of the operators alone.
    settings = (
        "operating_points=chosen",
        "operating.episodes=1",
        "operating.values={saferl: [0.0]}",
    )
    session = wanted(imported, "saferl", settings=settings).prepared()
    ((cell, node),) = session.blocks
    assert node.needs["operating"].axes["knob"]["values"] == [0.0]
    told: list[str] = []
    monkeypatch.setattr("wasp_cli.drive.session.plain", told.append)  # stdout is for --json
    for driven in (cell, replace(cell, method=ALONE)):
        config = node.axes["method_config"] if driven is cell else {}
        block = session.built(Desk(), driven, node, config)
        try:
            assert isinstance(block.assistant, HumanOnly)
        finally:
            block.close()
        # who practises has no assistant that could be silent
        assert len(told) == 1
    assert told[0].startswith("SafeRL-Res is silent on Goal1: ")
