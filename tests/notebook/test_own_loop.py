"""What docs/own_loop.md shows is run, in its order."""

import contextlib

import gymnasium
import numpy as np
import pytest

import wasp_cli
from tests.test_docs import ROOT, blocks

PAGE = ROOT / "docs" / "own_loop.md"


@pytest.fixture(scope="module")
def shown() -> dict[str, object]:
    """The names that the blocks of the page leave behind, and what they print."""
    printed: list[tuple[object, ...]] = []
    names: dict[str, object] = {"print": lambda *values: printed.append(values)}
    with contextlib.chdir(ROOT):
        for block in blocks(PAGE, "python"):
            exec(block, names)
    return {**names, "printed": printed}


def test_the_loop_and_the_environment_decide(shown):
    (gate, cost, ms), (action, gate_inside, intervened, costs) = shown["printed"]
    assert gate in ("none", "safety", "task")
    assert gate_inside in ("none", "safety", "task")
    assert np.isfinite([cost, ms, costs]).all()
    assert np.abs(action).max() <= 1
    assert isinstance(intervened, bool)


def test_the_node_publishes_once_an_image_has_come(shown):
    sent: list[np.ndarray] = []
    node = shown["Corrector"](sent.append)
    node.on_stick([1.0, 0.0])
    node.on_timer()
    assert sent == []
    robot = gymnasium.make("wasp_cli.tasks.gym:wasp/SafetyPointGoal1-v0", observation="pixels")
    node.on_image(robot.reset(seed=5)[0])
    node.on_timer()
    node.on_timer()
    assert [action.shape for action in sent] == [(2,), (2,)]


def test_the_last_step_is_that_of_an_operator_of_ours(shown):
    assert shown["assistant"].label == "race1 s1 ida"
    assert set(shown["info"]) >= {"executed_action", "command", "gate", "intervened"}


def test_the_loop_of_the_readme_decides():
    (loop,) = [block for block in blocks(ROOT / "README.md", "python") if "load_assistant" in block]
    names: dict[str, object] = {"wasp_cli": wasp_cli}
    with contextlib.chdir(ROOT):
        exec(loop, names)
    assert np.abs(names["decision"].action).max() <= 1
