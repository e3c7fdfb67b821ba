"""Arguments of a registration are in the key: two that differ have different texts, or are
refused.
"""

import dataclasses
import functools
import threading
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.tasks.lights import Lights, registered
from wasp_cli.errors import TaskError
from wasp_cli.tasks.foreign.registration import argument_text
from wasp_cli.tasks.registry import TASKS


class Plain:
    """An object as people write them: without __eq__ and __repr__."""

    def __init__(self, **values: Any) -> None:
        self.__dict__.update(values)


@dataclasses.dataclass(repr=False)
class Track:
    points: np.ndarray
    name: str = "track"


class Slotted:
    __slots__ = ("price",)

    def __init__(self, price: float) -> None:
        self.price = price


def scaled(factor: float) -> Any:
    return lambda reward: reward * factor


LARGE = np.zeros(5000)
OTHER = LARGE.copy()
OTHER[2500] = 1.0  # NumPy's own text of both is the same

DIFFERENT: list[tuple[Any, Any]] = [
    (LARGE, OTHER),
    (LARGE.reshape(50, 100), LARGE.reshape(100, 50)),
    (LARGE, LARGE.astype(np.float32)),
    (Plain(price=0.0), Plain(price=10.0)),
    (Plain(table=LARGE), Plain(table=OTHER)),
    (Plain(inner=Plain(x=1)), Plain(inner=Plain(x=2))),
    (Track(LARGE), Track(OTHER)),
    (Slotted(1.0), Slotted(2.0)),
    ({"track": LARGE}, {"track": OTHER}),
    ([LARGE], [OTHER]),
    ({1, 2}, {1, 3}),
    (deque([1]), deque([2])),
    (Path("a"), Path("b")),
    (functools.partial(max, 1), functools.partial(max, 2)),
    (scaled(1.0), scaled(2.0)),
    (np.random.default_rng(1), np.random.default_rng(2)),
    (0.1, 0.1 + 1e-17 * 2),
    (1, True),
    ("1", 1),
    (np.array([{"a": 1}], object), np.array([{"a": 2}], object)),
]


@pytest.mark.parametrize(("one", "other"), DIFFERENT)
def test_what_differs_has_another_text(one, other):
    if isinstance(one, float) and one == other:
        pytest.fail("the case compares a number with itself")
    assert argument_text("x", one) != argument_text("x", other)


def test_what_is_equal_has_the_same_text():
    for make in (
        lambda: Plain(price=1.0, table=np.arange(3000)),
        lambda: Track(np.arange(9)),
        lambda: Slotted(1.0),
        lambda: {"b": {3, 1, 2}, "a": [LARGE.copy()]},
        lambda: scaled(2.0),
        lambda: functools.partial(max, 1),
        lambda: np.random.default_rng(1),
    ):
        assert argument_text("x", make()) == argument_text("x", make())


@given(st.recursive(st.integers() | st.text() | st.booleans() | st.none(), st.lists, max_leaves=8))
def test_small_plain_values_are_shown_as_they_are_written(value):
    assert argument_text("x", value) == repr(value)


@pytest.mark.parametrize(
    "value", [threading.Lock(), (number for number in (1, 2)), Plain(lock=threading.Lock())]
)
def test_what_cannot_be_told_apart_is_refused_with_a_remedy(value):
    with pytest.raises(TaskError) as caught:
        argument_text("table", value)
    assert "'table'" in caught.value.message
    assert "assets" in str(caught.value.hint)


def test_an_object_that_holds_itself_is_refused():
    knot = Plain()
    knot.knot = knot
    with pytest.raises(TaskError, match="holds itself"):
        argument_text("x", knot)


class Priced(Lights):
    def __init__(self, table: Any = None) -> None:
        self.table = table


def test_a_task_is_another_one_with_another_argument_or_another_entry_point():
    def of(**options: Any) -> str:
        return TASKS[registered(Priced, **options)].facts()["registered"]

    assert of(kwargs={"table": LARGE}) != of(kwargs={"table": OTHER})
    assert of(kwargs={"table": Plain(a=1)}) == of(kwargs={"table": Plain(a=1)})
    points = [functools.partial(Priced, table) for table in (LARGE, OTHER)]
    one, other = (TASKS[registered(point)].facts()["registered"] for point in points)
    assert one != other
    with pytest.raises(TaskError, match="cannot be told apart"):
        of(kwargs={"table": threading.Lock()})
