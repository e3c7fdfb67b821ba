"""Of how many episodes an ablation changed nothing."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.report.claims.test_verdict import cell, frame_of
from wasp_cli.report.stats.frame import CellNumbers
from wasp_cli.report.stats.summary import same_episodes
from wasp_cli.report.tables.main import ablation_table


def wasp(costs: list[float], variant: str = "full", seed: int = 0, **more: Any) -> CellNumbers:
    return cell("wasp", costs, seed, variant=variant, **{"mag": [0.1] * len(costs), **more})


def test_equal_in_all_that_happened_and_in_the_same_world() -> None:
    full = wasp([1.0, 2.0, 3.0])
    assert same_episodes([wasp([1.0, 2.0, 3.0], "no-case2")], [full]) == (3, 3)
    assert same_episodes([wasp([1.0, 2.5, 3.0], "no-case2")], [full]) == (2, 3)
    assert same_episodes([wasp([1.0, 2.0, 3.0], "no-case2", mag=[0.1, 0.1, 0.2])], [full]) == (2, 3)
    assert same_episodes([wasp([1.0, 2.0, 3.0], "no-case2", mag=[0.1, np.nan, 0.1])], [full]) == (2, 3)
    assert same_episodes([wasp([1.0, 2.0, 3.0, 4.0], "no-case2")], [full]) == (3, 3)
    assert same_episodes([wasp([1.0, 2.0, 3.0], "no-case2", seed=1)], [full]) == (0, 0)


def test_undefined_twice_is_equal_and_gates_may_differ() -> None:
    full = wasp([1.0, 2.0], mag=[0.1, np.nan], safety_gate=[0.5, 0.5])
    assert same_episodes([wasp([1.0, 2.0], "task-only", mag=[0.1, np.nan], safety_gate=[0.0, 0.0])], [full]) == (2, 2)


def test_worlds_are_matched_in_any_order() -> None:
    full, other = wasp([1.0, 2.0, 3.0]), wasp([3.0, 2.0, 9.0], "no-case2")
    other.episodes["world"][:] = full.episodes["world"][::-1]  # type: ignore[index]
    assert same_episodes([other], [full]) == (2, 3)


@pytest.mark.parametrize(("costs", "note"), [([1.0, 2.0, 7.0], "2 of 3 episodes"), ([5.0, 6.0, 7.0], "")])
def test_the_table_says_it_where_there_are_any(costs: list[float], note: str) -> None:
    columns = {name: [0.0] * 3 for name in ("return", "success", "viol", "int_rate")}
    table = ablation_table(frame_of(wasp([1.0, 2.0, 3.0], **columns), wasp(costs, "no-case2", **columns)))
    assert table is not None
    found = [text for text in table.notes if "the same as with the full method" in text]
    assert [text.partition(" are ")[0] for text in found] == ([f"Goal1, WASP, no Case II recovery: {note}"] if note else [])
