"""Settings of the whole test suite."""

from __future__ import annotations

import os

# Before anything imports torch: two OpenMP pools on two cores slow a test down by an order of magnitude.
os.environ.setdefault("OMP_NUM_THREADS", "1")
