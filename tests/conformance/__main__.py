"""`python -m tests.conformance FOLDER`: hold the tasks against recordings of the reference package.

Every `.npz` in the folder is checked; one line per file and quantity tells the worst error and the
tolerance. The exit code is 1 when a quantity is out of tolerance or nothing could be checked, 2 on
wrong usage. Recordings of other tasks are skipped.
"""

import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from tests.conformance.car import XY, CarTask, check_car_dynamics, check_car_episode
from tests.conformance.comparison import Check, Recording
from tests.conformance.point import check_point_dynamics, check_point_goal
from wasp_cli.tasks.formula.model import build_model as build_formula
from wasp_cli.tasks.formula.task import Formula
from wasp_cli.tasks.formula.track import SIDES as FORMULA_SIDES
from wasp_cli.tasks.race.model import build_model as build_race
from wasp_cli.tasks.race.task import HAZARD_RADIUS, Race
from wasp_cli.tasks.race.task import SIDES as RACE_SIDES

_RACE = CarTask("car", XY, Race, build_race, RACE_SIDES, accuracy=0.01, hazard_radius=HAZARD_RADIUS)
# Under RK4 the two MuJoCo versions part when a contact begins within a step: one in seventy
# recorded steps, by 0.08 mm.
_FORMULA = CarTask("car_rk4", 1e-3, Formula, build_formula, FORMULA_SIDES, accuracy=0.08)
_EPISODES: dict[str, Callable[[Recording], list[Check]]] = {
    "SafetyPointGoal1-v0": check_point_goal,
    "SafetyCarRace1-v0": lambda recording: check_car_episode(recording, _RACE),
    "SafetyCarFormulaOne1-v0": lambda recording: check_car_episode(recording, _FORMULA),
}


def checks_of(recording: Recording) -> Callable[[Recording], list[Check]] | None:
    """Return the function that checks such a recording, or None when its task is not one of
    ours.
    """
    if any(f"{prefix}_traj" in recording for prefix in ("point", "car", "car_rk4")):
        return _dynamics
    task = json.loads(str(recording["meta"])).get("task", "") if "meta" in recording else ""
    return _EPISODES.get(task)


def _dynamics(recording: Recording) -> list[Check]:
    checks = check_point_dynamics(recording) if "point_traj" in recording else []
    for task in (_RACE, _FORMULA):
        checks += check_car_dynamics(recording, task) if f"{task.prefix}_traj" in recording else []
    return checks


def main(arguments: Sequence[str]) -> int:
    """Check a folder and print the report; returns the exit code."""
    if len(arguments) != 1 or not Path(arguments[0]).is_dir():
        print("usage: python -m tests.conformance FOLDER", file=sys.stderr)
        return 2
    failed = done = 0
    for path in sorted(Path(arguments[0]).glob("*.npz")):
        with np.load(path, allow_pickle=False) as archive:
            recording = {name: archive[name] for name in archive.files}
        run = checks_of(recording)
        if run is None:
            print(
                f"{path.name:28s} skipped: there is no check for recordings of this task",
                flush=True,
            )
            continue
        for check in run(recording):
            verdict = "ok" if check.ok else "FAILED"
            line = (
                f"{check.quantity:39s} worst {check.worst:9.2e}  tolerance "
                f"{check.tolerance:7.1e}  of {check.compared:6d}  {verdict}"
            )
            print(f"{path.name:28s} {line}", flush=True)
            failed += not check.ok
            done += 1
    print(f"{done} quantities compared, {failed} out of tolerance")
    return 1 if failed or not done else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
