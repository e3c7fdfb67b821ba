"""An update of the world model beside those of others at the same sizes, on the same core, by turns.

`WASP_BASE`: a checkout of an earlier commit; `WASP_DREAMER`: one of github.com/NM512/dreamerv3-torch. Without them there is nothing to
compare.
"""

import os
import statistics
import subprocess
import sys
from pathlib import Path

import pytest

ROUNDS = 8
SCRIPT = Path(__file__).with_name("updates.py")
HERE = SCRIPT.parents[2]
OTHERS = {"WASP_BASE": "wasp", "WASP_DREAMER": "dreamer"}


@pytest.mark.parametrize("variable", OTHERS)
def test_world_model_update(benchmark, variable):
    """CPU time of one update, ours and theirs by turns: the median of the ratios, and the ratio of the minima."""
    checkout = os.environ.get(variable)
    if not checkout:
        pytest.skip(f"{variable} names no checkout to compare with")
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    commands = [[sys.executable, str(SCRIPT), kind, str(place)] for kind, place in (("wasp", HERE), (OTHERS[variable], checkout))]
    both = [subprocess.Popen(each, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment) for each in commands]
    ours, theirs = times = ([], [])
    try:
        for process in both:
            answer(process)  # what comes first warms up

        def turn() -> None:
            for process, found in zip(both, times, strict=True):
                ask(process)
                found.append(answer(process))

        benchmark.pedantic(turn, rounds=ROUNDS)
    finally:
        for process in both:
            process.kill()
            process.communicate()
    assert len(ours) == len(theirs) == ROUNDS
    benchmark.extra_info["ms"] = min(ours)
    benchmark.extra_info["times_as_fast"] = statistics.median(b / a for a, b in zip(ours, theirs, strict=True))
    benchmark.extra_info["by_minima"] = min(theirs) / min(ours)


def ask(process: subprocess.Popen[str]) -> None:
    process.stdin.write("\n")
    process.stdin.flush()


def answer(process: subprocess.Popen[str]) -> float:
    return float(process.stdout.readline())
