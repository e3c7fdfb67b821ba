"""The environments in the hands of others' checkers, collectors and trainers, which `nox -s
peers` installs.
"""

WORLDS = (
    "PointGoal1",
    "PointGoal0",
    "PointGoal2",
    "CarRace1",
    "CarRace0",
    "CarFormulaOne1",
    "CarFormulaOne0",
)
IDS = [f"wasp/Safety{world}-v0" for world in WORLDS]
