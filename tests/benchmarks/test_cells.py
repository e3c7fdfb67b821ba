"""Decisions of ten episodes side by side, as a cell makes them, beside the same ones by the world model's own steps, in turn."""

import time
from collections.abc import Callable
from typing import Any

import pytest
import torch

from tests.benchmarks.decisions import THRESHOLDS, Setup, configs
from wasp_cli.memory import keep_memory

EPISODES, PAIRS = 10, 3


@pytest.mark.parametrize("kind", [kind for kind in THRESHOLDS if kind != "gate"])
def test_decisions_of_a_cell(benchmark, kind):
    """One core; `peer_over_this` is the time of every one-hot row as a product over that of rows that are looked up."""
    keep_memory()
    torch.set_num_threads(1)
    with torch.inference_mode():
        setup = Setup(*configs("cpu"), EPISODES)
        packed, plain = setup.decision(kind), setup.decision(kind, reference=True)
        packed(), plain()
        peers = []

        def in_turn() -> None:
            peers.append(seconds(plain))

        benchmark.pedantic(packed, setup=in_turn, rounds=PAIRS)
    assert len(peers) == PAIRS
    benchmark.extra_info["decisions_per_s"] = EPISODES / benchmark.stats.stats.min
    benchmark.extra_info["peer_over_this"] = min(peers) / benchmark.stats.stats.min


def seconds(work: Callable[[], Any]) -> float:
    begun = time.perf_counter()
    work()
    return time.perf_counter() - begun
