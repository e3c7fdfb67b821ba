"""Settings of the whole test suite."""

from __future__ import annotations

import os
import signal

# Before anything imports torch: two OpenMP pools on two cores slow a test down by an order of magnitude.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# A shell starts what runs in its background with Ctrl-C ignored, and so would the commands be that the tests interrupt.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
