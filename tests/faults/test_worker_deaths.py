"""Workers that are killed, as by the kernel when memory runs out."""

import pytest

from tests.run.harness import data_of, run
from wasp_cli.run.pool import LokyPool
from wasp_cli.run.worker import KILLED


@pytest.mark.parametrize("jobs", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_a_node_that_kills_its_worker_is_named_and_the_others_finish(jobs, fakes, small_spec, tmp_path):
    fakes.set(behave={"goal1 s0 evaluate human {} noisy": "kill"}, seconds=0.05)
    pool = LokyPool(jobs)
    try:
        summary = run(small_spec, tmp_path / "results", pool)
    finally:
        pool.close(kill=True)
    assert [failure.node.label for failure in summary.failed] == ["goal1 s0 human noisy=0.2"]
    assert summary.failed[0].result.message.startswith(f"{KILLED}; it last held ")
    assert not summary.blocked
    ran = fakes.executions()
    # In flight at the death: the killer and at most one other. Nothing else runs twice.
    assert len(ran) - len(set(ran)) <= jobs
    fakes.set()
    again = run(small_spec, tmp_path / "results")
    assert (again.done, again.complete) == (1, True)


def test_a_worker_killed_by_chance_costs_a_repetition_and_no_failure(fakes, small_spec, tmp_path):
    run(small_spec, tmp_path / "calm")
    fakes.set(behave={"goal1 s0 world_model": "kill once"})
    pool = LokyPool(2)
    try:
        summary = run(small_spec, tmp_path / "stormy", pool)
    finally:
        pool.close(kill=True)
    assert summary.complete
    assert data_of(tmp_path / "stormy") == data_of(tmp_path / "calm")
