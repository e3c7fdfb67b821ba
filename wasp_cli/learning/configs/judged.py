"""Sections of thresholds, cells and counterfactual branches."""

from __future__ import annotations

from wasp_cli.config import Config, assumed, from_paper


class HeldoutConfig(Config):
    """Episodes of the unimpaired expert on seeds of their own, for every threshold."""

    episodes: int = assumed(20, "held-out episodes", ge=1)


class CalibrationConfig(Config):
    """Thresholds from the held-out episodes."""

    window: int = from_paper(15, "W, section 5.3", ge=1)
    decisions: int = assumed(1500, "held-out decisions at which the task gate is probed", ge=1)
    tau_R_fraction: float = assumed(
        0.1, "tau_R as a fraction of the expert's mean W-step return", ge=0.0
    )


class EvaluateConfig(Config):
    """One cell of the grid."""

    episodes: int = assumed(30, "episodes per cell", ge=1)
    success_goals: int | None = assumed(
        None, "goals that count as success; null: 7 in Goal1, 1 in Race1 and FormulaOne1", ge=1
    )
    safe_cost: float = assumed(
        25.0,
        "kappa per 1000 env steps, as in training: up to it a success is a safe success",
        ge=0.0,
    )


class CounterfactualConfig(Config):
    """Branches of the real task at intervened decisions: what would have happened without the
    intervention (Eq. 19-21).
    """

    window: int = from_paper(15, "W, section 5.3", ge=1)
    stride: int = assumed(
        1,
        "every stride-th intervened decision of a cell is branched; the count goes on from "
        "episode to episode",
        ge=1,
    )
    most: int | None = assumed(
        None,
        "most branched decisions of a cell; where there would be more, the stride is larger; "
        "null: no limit",
        ge=1,
    )
    tau_R_fraction: float = assumed(
        0.1, "tau_R as a fraction of the unimpaired expert's mean W-step return", ge=0.0
    )
