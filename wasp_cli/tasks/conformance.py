"""`python -m wasp_cli.tasks.conformance FOLDER`: hold the tasks against recordings of the reference package.

Every `.npz` in the folder is checked; one line per file and quantity tells the worst error and the tolerance. The exit code is 1 when a
quantity is out of tolerance or nothing could be checked, 2 on wrong usage. Recordings of tasks that are not implemented are skipped.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from wasp_cli.tasks import goal1_conformance
from wasp_cli.tasks.comparison import Check, Recording


def checks_of(recording: Recording) -> Callable[[Recording], list[Check]] | None:
    """The function that checks such a recording, or None when its task is not implemented."""
    if "point_traj" in recording:
        return goal1_conformance.check_point_dynamics
    task = json.loads(str(recording["meta"]))["task"] if "meta" in recording else ""
    return {"SafetyPointGoal1-v0": goal1_conformance.check_point_goal}.get(task)


def main(arguments: Sequence[str]) -> int:
    """Check a folder and print the report; returns the exit code."""
    if len(arguments) != 1 or not Path(arguments[0]).is_dir():
        print("usage: python -m wasp_cli.tasks.conformance FOLDER", file=sys.stderr)
        return 2
    failed = done = 0
    for path in sorted(Path(arguments[0]).glob("*.npz")):
        with np.load(path, allow_pickle=False) as archive:
            recording = {name: archive[name] for name in archive.files}
        run = checks_of(recording)
        if run is None:
            print(f"{path.name:28s} skipped: its task is not implemented")
            continue
        for check in run(recording):
            verdict = "ok" if check.ok else "FAILED"
            line = f"{check.quantity:28s} worst {check.worst:9.2e}  tolerance {check.tolerance:7.0e}  of {check.compared:6d}  {verdict}"
            print(f"{path.name:28s} {line}")
            failed += not check.ok
            done += 1
    print(f"{done - failed} of {done} quantities within tolerance")
    return 1 if failed or not done else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
