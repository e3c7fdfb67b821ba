"""Calibration of one method's thresholds on the held-out episodes, and of a bound in costly
decisions on the incidents of the dataset. Artifact: `calibration.json` (by name, with their
distributions).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs.judged import CalibrationConfig
from wasp_cli.stages.base import Job


class CalibrationStage:
    """See the module."""

    kind = "calibration"
    config = CalibrationConfig
    settings = ("action_repeat", "returns")
    needs: tuple[str, ...] = ("heldout", "world_model", "policies")

    def run(self, job: Job) -> Mapping[str, Any]:
        """Take the thresholds of the method from held-out decisions of the unimpaired expert."""
        import numpy as np
        import torch

        from wasp_cli.learning.assistants import build_assistant, load_parts
        from wasp_cli.learning.heldout import load_heldout
        from wasp_cli.methods.base import CalibratedAssistant, Heldout
        from wasp_cli.metrics.incidents import incident_cost, read_incidents, tau_of
        from wasp_cli.metrics.windows import sums_ahead
        from wasp_cli.models.base import Latent
        from wasp_cli.operators.base import EpisodeNoise, Operator, OperatorContext
        from wasp_cli.seeds import derive
        from wasp_cli.tasks.registry import TASKS

        config = cast(CalibrationConfig, job.config)

        # -- the decisions, with what they cost in the window ahead
        heldout = load_heldout(job.inputs["heldout"])
        total = len(heldout.a_h)
        cost_ahead = torch.from_numpy(
            sums_ahead(heldout.cost.numpy(), heldout.episode.numpy(), config.window)
        )
        index = torch.linspace(0, total - 1, min(config.decisions, total)).round().long()
        chosen = Heldout(
            Latent(heldout.latent.h[index], heldout.latent.z[index]),
            heldout.a_h[index],
            heldout.reward[index],
            heldout.cost[index],
            heldout.episode[index],
            heldout.terminal[index],
        )
        parts = load_parts(job.inputs, job.settings["returns"], motors=TASKS[job.task].motors)
        method_config: Mapping[str, Any] = job.axes["method_config"]

        # -- where tau_c is `auto`, it follows from the cost of incidents in the dataset
        incidents: dict[str, float] = {}
        if method_config.get("tau_c") == "auto":
            lengths = read_incidents(job.inputs["dataset"])
            discount = job.settings["returns"].gamma_c
            incident = incident_cost(lengths, method_config["horizon"], discount)
            incidents["incident"] = 0.0 if incident is None else incident
            method_config = {**method_config, "tau_c": tau_of(incident)}

        # -- the method's own thresholds. The unimpaired operator has no memory, so that only its
        # policy and its number of rows matter here.
        assistant = build_assistant(job.axes["method"], method_config, parts)
        context = OperatorContext(parts.skills.at, heldout.a_h.shape[1], 0.0)
        operator = Operator.build(1.0, context, EpisodeNoise([0] * len(index)), len(index))
        with torch.inference_mode():
            seed = derive("calibration", job.task, job.seed)
            thresholds: dict[str, float] = cast(CalibratedAssistant, assistant).calibrate(
                chosen, cost_ahead[index], operator, seed
            )

        # -- tau_R, from the returns in the window ahead
        returns = sums_ahead(heldout.reward.numpy(), heldout.episode.numpy(), config.window)
        thresholds["tau_R"] = config.tau_R_fraction * float(np.nanmean(returns))
        (job.out_dir / "calibration.json").write_text(
            json.dumps(thresholds, indent=1, sort_keys=True)
        )
        return {name: round(value, 4) for name, value in (thresholds | incidents).items()}
