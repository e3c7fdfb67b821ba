"""What the entry points name. No key covers this module: its words may change without running
anything again.
"""

from __future__ import annotations

from wasp_cli.methods.registry import MethodInfo, Signal
from wasp_cli.operators.registry import OperatorInfo
from wasp_cli.stages.registry import StageInfo

CAREFUL = MethodInfo(
    "careful",
    "Careful",
    "wasp_example.assistant:Careful",
    "wasp_example.configs:CarefulConfig",
    needs=("risk",),
    rule="Careful executes the least risky of the command, the expert's action and a stop where "
    "a network expects cost of the command.",
    signal=Signal("risk", "the predicted probability that the command leads to cost", "limit"),
)

RISK = StageInfo(
    "risk", "wasp_example.stage:RiskStage", presets={"smoke": {"updates": 20, "batch": 64}}
)

SLUGGISH = OperatorInfo(
    "sluggish",
    "Sluggish",
    "wasp_example.operator:SluggishOperator",
    0.0,
    1.0,
    "weight of the last command",
)
