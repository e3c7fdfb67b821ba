"""The cameras beside those of an earlier checkout, by turns. `WASP_BASE` names that checkout."""

import os
import statistics
from typing import Any

import pytest

from tests.benchmarks.turns import HERE, asked, running

ROUNDS = 8
LEAST = 1.15  # times as fast as the checkout in which each row was drawn for itself, at 8 and more side by side


@pytest.mark.skipif("WASP_BASE" not in os.environ, reason="WASP_BASE names no checkout to compare with")
@pytest.mark.parametrize("batch", [1, 8, 16, 30])
@pytest.mark.parametrize("task", ["goal1", "race1", "formula1"])
def test_images(benchmark, task, batch):
    """CPU time of a pair of images: the median of the ratios. The images themselves are the same."""
    pairs: list[tuple[dict[str, Any], dict[str, Any]]] = []
    with running(*(("images.py", place, task, batch) for place in (HERE, os.environ["WASP_BASE"]))) as (ours, theirs):
        benchmark.pedantic(lambda: pairs.append((asked(ours), asked(theirs))), rounds=ROUNDS)
    ratio = statistics.median(b["ms"] / a["ms"] for a, b in pairs)
    benchmark.extra_info.update(ms=min(a["ms"] for a, _ in pairs), times_as_fast=ratio)
    assert all(a["images"] == b["images"] for a, b in pairs)
    if batch >= 8:
        assert ratio > LEAST
