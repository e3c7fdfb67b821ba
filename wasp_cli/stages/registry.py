"""The stages by kind. Adding one is a module with its class, a config in `learning.configs` and one line here."""

from __future__ import annotations

from dataclasses import dataclass

from wasp_cli.registry import Registry


@dataclass(frozen=True)
class StageInfo:
    """A node kind; `target` is its class (light to import: heavy imports are inside `run`)."""

    name: str
    target: str


STAGES: Registry[StageInfo] = Registry(
    "stage",
    None,
    (
        StageInfo("expert", "wasp_cli.stages.expert:ExpertStage"),
        StageInfo("dataset", "wasp_cli.stages.dataset:DatasetStage"),
        StageInfo("world_model", "wasp_cli.stages.world_model:WorldModelStage"),
        StageInfo("latents", "wasp_cli.stages.latents:LatentsStage"),
        StageInfo("diagnostics", "wasp_cli.stages.diagnostics:DiagnosticsStage"),
        StageInfo("policies", "wasp_cli.stages.policies:PoliciesStage"),
        StageInfo("critics", "wasp_cli.stages.critics:CriticsStage"),
        StageInfo("gate_signals", "wasp_cli.stages.gate_signals:GateSignalsStage"),
        StageInfo("rollouts", "wasp_cli.stages.rollouts:RolloutsStage"),
        StageInfo("heldout", "wasp_cli.stages.heldout:HeldoutStage"),
        StageInfo("ida_q", "wasp_cli.stages.ida_q:IDAQStage"),
        StageInfo("denoiser", "wasp_cli.stages.denoiser:DenoiserStage"),
        StageInfo("residual", "wasp_cli.stages.residual:ResidualStage"),
        StageInfo("calibration", "wasp_cli.stages.calibration:CalibrationStage"),
        StageInfo("evaluate", "wasp_cli.stages.evaluate:EvaluateStage"),
        StageInfo("counterfactual", "wasp_cli.stages.counterfactual:CounterfactualStage"),
    ),
)
