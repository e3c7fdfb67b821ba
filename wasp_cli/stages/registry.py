"""The stages by kind, with what planning and running need to know of each. To add one, write its
module and a line here or an entry point in `wasp.stages`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from wasp_cli.registry import Registry

Unit = Literal["chain", "method", "operator", "person", "cell"]
"""What one node of a stage belongs to: a training chain (task and seed), a method, an operator, a
person, or a cell of the grid.
"""


@dataclass(frozen=True)
class StageInfo:
    """A node kind. Its class says what it reads (`needs`) and which settings it shares; the
    contract is `stages.base.Stage`.
    """

    name: str
    """The kind: the name of its section in a spec and of its folder in the store, and the name in
    the `needs` of stages and methods.
    """
    target: str  # import string of its class (light to import: heavy imports are inside `run`)
    unit: Unit = "chain"
    """What makes a run compute it. `chain`: a method or another stage needs it, or a spec lists it
    under `stages`. The others are used by this package alone. `method`: a method is listed.
    `operator`: a severity is `auto`. `cell`: a cell whose method may intervene. `person`: nothing,
    because a command makes it from what a person drove, and a run only reads it.
    """
    by_default: bool = False
    """Whether a spec that lists no `stages` trains it, although no method needs it."""
    weight: int = 10
    """Where no time was measured, nodes of heavier stages start first, so that a run does not end
    with a single busy worker.
    """
    reads_images: bool = True
    """Whether it, or what it drives, sees the cameras of a task. A stage that does not is not
    computed again where a task says that only its image has changed.
    """
    presets: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """By preset, values that replace the defaults of the config. Presets of the stages of this
    package are in `spec.presets`.
    """

    def __post_init__(self) -> None:
        """Refuse a name that cannot be a folder and a key of YAML alike."""
        if not re.fullmatch(r"[a-z][a-z0-9_]{0,31}", self.name):
            raise ValueError(
                f"the stage name '{self.name}' should be small letters, digits and '_', at "
                "most 32 of them, beginning with a letter"
            )


STAGES: Registry[StageInfo] = Registry(
    "stage",
    "wasp.stages",
    (
        StageInfo("expert", "wasp_cli.stages.expert:ExpertStage", weight=14, reads_images=False),
        StageInfo("dataset", "wasp_cli.stages.dataset:DatasetStage", weight=10),
        StageInfo("world_model", "wasp_cli.stages.world_model:WorldModelStage", weight=13),
        StageInfo("latents", "wasp_cli.stages.latents:LatentsStage", weight=7),
        StageInfo(
            "diagnostics", "wasp_cli.stages.diagnostics:DiagnosticsStage", by_default=True, weight=6
        ),
        StageInfo("policies", "wasp_cli.stages.policies:PoliciesStage", weight=8),
        StageInfo("critics", "wasp_cli.stages.critics:CriticsStage", weight=7),
        StageInfo("reachability", "wasp_cli.stages.reachability:ReachabilityStage", weight=7),
        StageInfo("fallback", "wasp_cli.stages.fallback:FallbackStage", weight=8),
        StageInfo("adversary", "wasp_cli.stages.adversary:AdversaryStage", weight=8),
        StageInfo("heldout", "wasp_cli.stages.heldout:HeldoutStage", weight=4),
        StageInfo("ida_q", "wasp_cli.stages.ida_q:IDAQStage", weight=5),
        StageInfo("denoiser", "wasp_cli.stages.denoiser:DenoiserStage", weight=9),
        StageInfo("consistency", "wasp_cli.stages.consistency:ConsistencyStage", weight=9),
        StageInfo("residual", "wasp_cli.stages.residual:ResidualStage", weight=11),
        StageInfo("clone", "wasp_cli.stages.clone:CloneStage", "person", weight=4),
        StageInfo("severity", "wasp_cli.stages.severity:SeverityStage", "operator", weight=3),
        StageInfo(
            "calibration", "wasp_cli.stages.calibration:CalibrationStage", "method", weight=3
        ),
        StageInfo("operating", "wasp_cli.stages.operating:OperatingStage", "method", weight=2),
        StageInfo("evaluate", "wasp_cli.stages.evaluate:EvaluateStage", "method", weight=1),
        StageInfo(
            "counterfactual", "wasp_cli.stages.counterfactual:CounterfactualStage", "cell", weight=2
        ),
    ),
)


def stages_of(*units: Unit) -> tuple[str, ...]:
    """Return the kinds of the stages that belong to one of `units`, in registry order."""
    return tuple(kind for kind, info in STAGES.items() if info.unit in units)
