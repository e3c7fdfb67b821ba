"""The grid through a ray cluster on this machine; ray is large, so it is installed and run by
the nox session `ray` alone.
"""

import os
import subprocess
import sys
from collections.abc import Iterator

import pytest

from tests.run.harness import ROOT, as_undisturbed, wasp

pytest.importorskip("ray")
pytestmark = pytest.mark.slow

PORT = 6397


@pytest.fixture
def cluster(fakes) -> Iterator[str]:
    """A head with two CPUs, as `ray start` makes one."""
    ray = [sys.executable, "-m", "ray.scripts.scripts"]
    environment = {
        **os.environ,
        "PYTHONPATH": str(ROOT),
        "OMP_NUM_THREADS": "1",
        "RAY_DISABLE_IMPORT_WARNING": "1",
    }
    options = [
        "--head",
        "--num-cpus",
        "2",
        "--port",
        str(PORT),
        "--include-dashboard",
        "false",
        "--disable-usage-stats",
    ]
    subprocess.run(
        [*ray, "start", *options],
        env=environment,
        cwd=ROOT,
        check=True,
        capture_output=True,
        timeout=600,
    )
    yield f"127.0.0.1:{PORT}"
    subprocess.run([*ray, "stop", "--force"], check=True, capture_output=True, timeout=600)


def test_a_grid_through_ray_has_the_same_bytes(fakes, small_spec, cluster, results):
    done = wasp(
        "run", small_spec, "--results", results, "--backend", "ray", "--scheduler", cluster, code=0
    )
    assert "18 computed, 0 computed before" in done.stderr
    assert as_undisturbed(small_spec, results)
    assert not list(results.glob("runs/*/outcomes/*"))
