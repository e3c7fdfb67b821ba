"""An update of the world model beside those of others at the same sizes, on the same core, by
turns.

`WASP_BASE`: a checkout of an earlier commit; `WASP_DREAMER`: one of
github.com/NM512/dreamerv3-torch. Without them there is nothing to compare.
"""

import os
import statistics

import pytest

from tests.benchmarks.turns import HERE, asked, running

ROUNDS = 8
OTHERS = {"WASP_BASE": "wasp", "WASP_DREAMER": "dreamer"}


@pytest.mark.parametrize("variable", OTHERS)
def test_world_model_update(benchmark, variable):
    """CPU time of one update, ours and theirs by turns: the median of the ratios, and the ratio
    of the minima.
    """
    checkout = os.environ.get(variable)
    if not checkout:
        pytest.skip(f"{variable} names no checkout to compare with")
    pairs: list[tuple[float, float]] = []
    with running(("updates.py", "wasp", HERE), ("updates.py", OTHERS[variable], checkout)) as (
        ours,
        theirs,
    ):
        benchmark.pedantic(lambda: pairs.append((asked(ours), asked(theirs))), rounds=ROUNDS)
    assert len(pairs) == ROUNDS
    least = [min(times) for times in zip(*pairs, strict=True)]
    benchmark.extra_info["ms"] = least[0]
    benchmark.extra_info["times_as_fast"] = statistics.median(b / a for a, b in pairs)
    benchmark.extra_info["by_minima"] = least[1] / least[0]
