"""Worker processes and the signals that a terminal sends to the whole group."""

import os
import signal
import subprocess
import sys

from wasp_cli.run.job import SIGNALS
from wasp_cli.run.pool import _signals_wait

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
