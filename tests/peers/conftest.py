import os

# Their packages are in the environment of `nox -s peers` alone.
collect_ignore_glob = [] if "WASP_PEERS" in os.environ else ["test_*.py"]
