"""What the pool of a dask scheduler makes of its client, which stands here for the scheduler: lost tasks, its end, its workers."""

from collections.abc import Callable
from concurrent.futures import Future
from types import SimpleNamespace
from typing import Any

import distributed
import pytest

from wasp_cli.errors import UsageError, WaspError
from wasp_cli.run import pool as pools
from wasp_cli.run.job import NodeJob, NodeResult
from wasp_cli.run.pool import DaskPool, WorkersDied

JOB: Any = SimpleNamespace(run_id="run", key="key")
DONE = NodeResult("key", "done", 1.0)


class Task:
    """A task of the scheduler."""

    def __init__(self) -> None:
        self.status = "pending"
        self.error: BaseException | None = None

    def add_done_callback(self, told: Callable[..., None]) -> None:
        self.told = told

    def end(self, status: str, error: BaseException | None = None) -> None:
        self.status, self.error = status, error
        self.told(self)

    def exception(self) -> BaseException | None:
        return self.error

    def result(self) -> NodeResult:
        return DONE


class Client:
    """A client whose scheduler does what a test says."""

    def __init__(self, *_: object, **__: object) -> None:
        self.status, self.workers, self.task = "running", {"one": 1}, Task()

    def nthreads(self) -> dict[str, int]:
        return self.workers

    def submit(self, execute: object, job: NodeJob, **_: object) -> Task:
        return self.task

    def close(self, **_: object) -> None:
        self.status = "closed"


@pytest.fixture
def pool(monkeypatch) -> Any:
    monkeypatch.setattr(distributed, "Client", Client)
    monkeypatch.setattr(pools, "POLL_SECONDS", 0.01)
    monkeypatch.setattr(pools, "COUNT_SECONDS", 0.02, raising=False)
    pool = DaskPool("tcp://somewhere:1")
    yield pool
    pool.close()


def error_of(found: Future[NodeResult]) -> BaseException | None:
    return found.exception(timeout=300)


@pytest.mark.parametrize("status", ["lost", "cancelled", "pending"])
def test_a_task_that_did_not_finish_is_no_result(status, pool):
    """Its artifact may not be there; nothing that the client says of it counts."""
    found = pool.submit(JOB)
    pool._client.task.end(status)
    error = error_of(found)
    assert isinstance(error, WaspError)
    assert error.message == f"the dask scheduler is lost ({status})"
    assert error.hint == "start it again, then run again: finished nodes are kept"


def test_a_task_whose_workers_were_killed_is_told_from_one_that_raised(pool):
    found = pool.submit(JOB)
    pool._client.task.end("error", distributed.KilledWorker("key", SimpleNamespace(address="one"), 3))
    assert isinstance(error_of(found), WorkersDied)
    other = pool.submit(JOB)
    pool._client.task.end("error", ValueError("no module"))
    error = error_of(other)
    assert isinstance(error, WaspError)
    assert "ValueError: no module" in error.message


@pytest.mark.parametrize("status", ["closed", "closing"])
def test_what_is_pending_is_given_up_when_the_scheduler_is_gone(status, pool):
    """No callback comes: the watcher alone ends the wait."""
    first, second = pool.submit(JOB), pool.submit(JOB)
    pool._client.status = status
    for found in (first, second):
        error = error_of(found)
        assert isinstance(error, WaspError)
        assert error.message == f"the dask scheduler is lost ({status})"
    pool._client.task.end("finished")  # too late, and no error
    assert isinstance(error_of(second), WaspError)


def test_workers_with_several_threads_are_refused(pool, monkeypatch):
    monkeypatch.setattr(Client, "nthreads", lambda self: {"one": 1, "two": 2})
    with pytest.raises(UsageError) as refused:
        DaskPool("tcp://somewhere:1")
    assert refused.value.hint == "start it with --nthreads 1"
