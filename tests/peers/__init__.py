"""The environments in the hands of others' checkers, collectors and trainers, which `nox -s peers` installs."""

IDS = [
    "wasp/SafetyPointGoal1-v0",
    "wasp/SafetyPointGoal0-v0",
    "wasp/SafetyPointGoal2-v0",
    "wasp/SafetyCarRace1-v0",
    "wasp/SafetyCarRace0-v0",
    "wasp/SafetyCarFormulaOne1-v0",
    "wasp/SafetyCarFormulaOne0-v0",
]
