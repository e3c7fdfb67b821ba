"""See `kill_storm`. WASP_KILLS says how many kills, WASP_KILLS_SEED which."""

import os
import subprocess
import sys

import pytest

from tests.run.harness import ROOT


def storm(kills: str, seed: str) -> str:
    # A process of its own: it forks, which one that has computed with threads must not.
    command = [sys.executable, "-m", "tests.faults.kill_storm", "--kills", kills, "--seed", seed]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, env={**os.environ, "OMP_NUM_THREADS": "1"})
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
def test_kills_at_random_instants_lose_nothing():
    told = storm(os.environ.get("WASP_KILLS", "300"), os.environ.get("WASP_KILLS_SEED", "1"))
    print(told)
    assert told.endswith("nothing was lost\n")
