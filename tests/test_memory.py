"""Freed memory stays with the process."""

import platform
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

COUNT = """\
import resource
import torch
from tests.benchmarks.decisions import Setup, configs
from wasp_cli.run.worker import keep_memory

def faults():
    decide()
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt

assert keep_memory()
with torch.inference_mode():
    decide = Setup(*configs("paper"), 1).decision("safety")
    faults()
    before = faults()
    print(faults() - before)
"""


@pytest.mark.slow
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="mallopt is glibc's")
def test_a_decision_gets_almost_no_new_pages():
    done = subprocess.run([sys.executable, "-c", COUNT], capture_output=True, text=True, timeout=600, check=True, cwd=ROOT)
    assert int(done.stdout) < 3000  # 30,000 to 40,000 without it
