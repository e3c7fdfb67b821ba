"""Settings of the whole test suite."""

import atexit
import os
import shutil
import signal
import sys
import tempfile
from contextlib import suppress
from pathlib import Path

import pytest

from wasp_cli.store.packs import unpack

# Before anything imports torch: two OpenMP pools on two cores slow a test down by an order of
# magnitude.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# What plans keep is of this session alone, and leaves nothing in the user's cache folder.
os.environ["XDG_CACHE_HOME"] = tempfile.mkdtemp(prefix="wasp-tests-")
atexit.register(shutil.rmtree, os.environ["XDG_CACHE_HOME"], ignore_errors=True)
# A shell starts what runs in its background with Ctrl-C ignored, and so would the commands be that
# the tests interrupt.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# in a fresh clone its cells lie in packs alone
unpack(Path(__file__).parents[1] / "results" / "published")

with suppress(ImportError):  # the sessions `peers` and `external` of nox have no hypothesis
    from hypothesis import HealthCheck, settings

    # An example may take as long as a busy machine needs.
    settings.register_profile("busy", deadline=None, suppress_health_check=[HealthCheck.too_slow])
    settings.load_profile("busy")


def pytest_fixture_setup():
    """No test depends on what others have drawn before it: neither a fixture nor a test begins
    in another state.
    """
    if torch := sys.modules.get("torch"):
        torch.manual_seed(0)


pytest_runtest_call = pytest_fixture_setup


@pytest.fixture
def results(tmp_path):
    """A results folder that is not there yet."""
    return tmp_path / "results"


@pytest.fixture
def layout(tmp_path):
    """Of a results folder that is ready, and empty."""
    from wasp_cli.store.layout import Layout

    layout = Layout(tmp_path / "results")
    layout.prepare()
    return layout


@pytest.fixture(scope="session")
def artifacts(tmp_path_factory):
    """Tiny untrained ones, by stage kind; tests only read them."""
    from tests.artifacts import tiny_artifacts

    return tiny_artifacts(tmp_path_factory.mktemp("artifacts"))


@pytest.fixture(scope="module")
def parts(artifacts):
    """What assistants are built of."""
    from wasp_cli.learning.assistants import load_parts
    from wasp_cli.learning.configs import ReturnsConfig

    return load_parts(artifacts, ReturnsConfig())
