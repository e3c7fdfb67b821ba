"""One node in a worker, and worker processes under the signals that a terminal sends to the whole group."""

import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from tests.run.fake_stages import Fake
from tests.run.harness import prepared
from wasp_cli.run import worker
from wasp_cli.run.job import SIGNALS, NodeJob, forget
from wasp_cli.run.pool import _signals_wait
from wasp_cli.run.record import new_run
from wasp_cli.run.runner import job_of
from wasp_cli.run.worker import execute
from wasp_cli.store.artifact import exists
from wasp_cli.store.layout import Layout


@pytest.fixture
def job(fakes, small_spec, tmp_path) -> NodeJob:
    loaded, layout, plan = prepared(small_spec, tmp_path / "results")
    run_id = new_run(layout, loaded, plan)
    layout.journal(run_id).touch()  # by which a worker sees that it is in the right folder
    return job_of(layout, run_id, plan.to_run()[0])


def test_what_c_libraries_print_goes_to_the_log(job, capfd, monkeypatch):
    monkeypatch.setattr(Fake, "run", lambda self, job: {"written": os.write(1, b"one") + os.write(2, b"two")})
    result = execute(job)
    assert result.summary == {"written": 6}
    begun, ended = Path(result.log).read_text(encoding="utf-8").splitlines()
    assert begun.startswith(f"{job.label}: begun 20")
    assert ended.startswith(f"onetwo{job.label}: done in "), "a log says when the node began and ended, also where nothing is printed"
    os.write(1, b"restored")
    assert capfd.readouterr() == ("restored", "")


def test_a_result_of_changed_source_is_not_published(job):
    result = execute(replace(job, sources={**job.sources, "wasp_cli.config": "0" * 12}))
    assert result.state == "failed"
    assert result.message == "the source changed during the run: wasp_cli.config"
    assert not exists(Layout(Path(job.root)), job.kind, job.key)


def test_numbers_of_numpy_and_nested_ones_become_plain():
    import numpy as np

    summary = {"a": np.float32(0.5), "b": [np.int64(2), float("inf")], "c": {"d": True}}
    assert worker.finite(summary) == {"a": 0.5, "b": [2, None], "c": {"d": True}}


def test_an_order_that_cannot_even_start_fails_without_raising(job, tmp_path):
    (tmp_path / "file").write_text("")
    assert execute(replace(job, root=str(tmp_path / "file"))).state == "unseen"
    log = Layout(Path(job.root)).log(job.run_id, job.label, job.key)
    log.mkdir()
    result = execute(job)
    assert result.state == "failed"
    assert "IsADirectoryError" in result.message


def test_a_half_written_heartbeat_goes_with_the_whole_one(tmp_path):
    """A process can be killed between writing the next heartbeat and giving it its name."""
    ours, partial, other = (tmp_path / name for name in ("f077.json", ".f077.json-8848987e", ".f078.json-8848987e"))
    for path in (ours, partial, other):
        path.write_text("{}", encoding="utf-8")
    forget(ours)
    forget(ours)
    assert sorted(tmp_path.iterdir()) == [other]


MASK = "import signal; print(sorted(signal.pthread_sigmask(signal.SIG_BLOCK, [])))"


def test_a_process_that_has_just_started_is_not_ended_by_ctrl_c():
    with _signals_wait():
        process = subprocess.Popen([sys.executable, "-c", MASK], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert not set(SIGNALS) & signal.pthread_sigmask(signal.SIG_BLOCK, [])
    process.send_signal(signal.SIGINT)
    out, errors = process.communicate(timeout=600)
    assert (process.returncode, errors) == (0, "")
    assert all(number.name in out for number in SIGNALS)


def test_a_worker_that_is_ready_has_no_signals_waiting():
    code = f"from wasp_cli.run.pool import start_worker; start_worker({os.getpid()}); {MASK}"
    with _signals_wait():
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600, check=True)
    assert done.stdout.strip() == "[]"
