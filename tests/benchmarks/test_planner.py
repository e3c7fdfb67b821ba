"""A decision of WASP beside the same floating-point operations as plain matrix products,
measured in the same run.
"""

import os

import pytest
import torch

from tests.benchmarks.decisions import THRESHOLDS, Setup, configs, matrix_rate, products

THREADS = min(2, os.cpu_count() or 1)


@pytest.mark.parametrize("planner", ["paper", "cpu"])
@pytest.mark.parametrize("kind", THRESHOLDS)
def test_decision(benchmark, planner, kind):
    """One episode, all cores of a small machine: the operator is waiting."""
    torch.set_num_threads(THREADS)
    try:
        with torch.inference_mode():
            setup = Setup(*configs(planner), 1)
            decide = setup.decision(kind)
            roof = matrix_rate()
            benchmark.pedantic(decide, rounds=5, warmup_rounds=1)
            flop = products(setup, kind)
    finally:
        torch.set_num_threads(1)
    assert flop > 0
    benchmark.extra_info["gflop"] = flop / 1e9
    benchmark.extra_info["roof_gflop_per_s"] = roof / 1e9
    benchmark.extra_info["time_over_products"] = benchmark.stats.stats.min * roof / flop
