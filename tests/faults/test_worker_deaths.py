"""Workers that are killed, as by the kernel when memory runs out."""

import pytest

from tests.run.harness import as_undisturbed, run
from wasp_cli.run.pool import LokyPool
from wasp_cli.run.worker import KILLED


@pytest.mark.parametrize("jobs", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_who_kills_its_worker_is_named_and_who_is_killed_by_chance_is_repeated(jobs, fakes, small_spec, tmp_path):
    fakes.set(behave={"goal1 s0 evaluate human {} noisy": "kill", "goal1 s0 world_model": "kill once"}, seconds=0.05)
    pool = LokyPool(jobs)
    try:
        summary = run(small_spec, tmp_path / "results", pool)
    finally:
        pool.close(kill=True)
    assert [node.label for node, _ in summary.failed] == ["goal1 s0 human noisy=0.2"]
    assert summary.failed[0][1].message.startswith(f"{KILLED}; it last held ")
    assert not summary.blocked
    ran = fakes.executions()
    # In flight at a death: the victim and at most one other. Nothing else runs twice.
    assert len(ran) - len(set(ran)) <= 2 * jobs
    fakes.set()
    again = run(small_spec, tmp_path / "results")
    assert (again.done, again.complete) == (1, True)
    assert as_undisturbed(small_spec, tmp_path / "results")
