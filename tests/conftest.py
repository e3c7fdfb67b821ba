"""Settings of the whole test suite."""

import os
import signal
from contextlib import suppress

# Before anything imports torch: two OpenMP pools on two cores slow a test down by an order of magnitude.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# A shell starts what runs in its background with Ctrl-C ignored, and so would the commands be that the tests interrupt.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

with suppress(ImportError):  # the sessions `peers` and `external` of nox have no hypothesis
    from hypothesis import HealthCheck, settings

    # An example may take as long as a busy machine needs.
    settings.register_profile("busy", deadline=None, suppress_health_check=[HealthCheck.too_slow])
    settings.load_profile("busy")
