import os

# The physics of these worlds is in the environment of `nox -s external` alone.
collect_ignore_glob = [] if "WASP_EXTERNAL" in os.environ else ["test_*.py"]
