import random
from itertools import count

import pytest
from hypothesis import given
from hypothesis import strategies as st

from wasp_cli.plan.node import Node
from wasp_cli.plan.schedule import Schedule, simulated

NUMBER = count()


def node(*needs: Node, kind: str = "expert", sort: str = "") -> Node:
    key = f"{next(NUMBER):08d}"
    return Node(kind, "goal1", 0, {}, {}, {}, {each.key: each for each in needs}, (), key, key, sort or key)


def equal(*nodes: Node) -> dict[str, float]:
    return {each.key: 1.0 for each in nodes}


def test_what_the_longest_path_begins_with_comes_first():
    short, long = node(), node()
    middle = node(long)
    last = node(middle)
    alone = node()
    lasting = {short.key: 1.0, long.key: 1.0, middle.key: 1.0, last.key: 5.0, alone.key: 6.5}
    schedule = Schedule([short, long, middle, last, alone], lasting)
    assert [schedule.pop() for _ in range(len(schedule))] == [long, alone, short]
    schedule.ended(long)
    assert [schedule.pop()] == [middle]


def test_a_node_waits_for_all_that_it_needs_and_for_nothing_else():
    computed = node()
    a, b = node(computed), node()
    both = node(a, b)
    schedule = Schedule([a, b, both], equal(a, b, both))  # what is computed is not among them
    taken = {schedule.pop(), schedule.pop()}
    assert taken == {a, b}
    schedule.ended(b)
    assert not len(schedule)
    schedule.put(a)  # it runs again
    assert schedule.pop() is a
    schedule.ended(a)
    assert schedule.pop() is both
    schedule.ended(both)
    assert not len(schedule)


def test_a_failure_takes_its_dependents_along_each_once_and_no_other():
    bad, good = node(), node()
    child = node(bad)
    grandchild = node(child, bad, good)
    other = node(good)
    schedule = Schedule([bad, good, child, grandchild, other], equal(bad, good, child, grandchild, other))
    assert schedule.failed(bad) == [child, grandchild]
    schedule.ended(good)
    ready = [schedule.pop() for _ in range(len(schedule))]
    assert grandchild not in ready
    assert other in ready
    assert schedule.failed(good) == [other]


@given(st.integers(1, 12), st.integers(1, 4), st.integers(0, 2**31))
def test_a_simulation_keeps_to_the_bounds_of_every_schedule(size, workers, seed):
    chance = random.Random(seed)
    nodes: list[Node] = []
    for _ in range(size):
        nodes.append(node(*chance.sample(nodes, chance.randint(0, min(len(nodes), 2)))))
    lasting = {each.key: chance.choice([0.5, 1.0, 3.0]) for each in nodes}
    ends: dict[str, float] = {}
    for each in nodes:
        ends[each.key] = lasting[each.key] + max((ends[needed.key] for needed in each.needs.values()), default=0.0)
    work, longest = sum(lasting.values()), max(ends.values())
    total, most = simulated(nodes, lasting, workers)
    assert max(work / workers, longest) - 1e-9 <= total <= work / workers + longest + 1e-9  # Graham's bound for lists
    assert most <= workers
    assert simulated(nodes, lasting, None)[0] == pytest.approx(longest)
    assert simulated(nodes, lasting, 1)[0] == pytest.approx(work)
