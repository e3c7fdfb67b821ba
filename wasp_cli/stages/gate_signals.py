"""Gate signals: which number foresees costs and the return best, measured on fresh Human-only episodes under several operators.

Artifact: `signals.json` (every signal of the cost and of the return by operator and for all of them, the gate at its threshold, its
reliability: its value beside the costs that really followed, curves of the further critics).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs.latent import GateSignalsConfig
from wasp_cli.stages.base import Job
from wasp_cli.stages.finite import finite_json

TRAINING = 0.4
"""Share of the progress that the critics take."""


class GateSignalsStage:
    """See the module."""

    kind = "gate_signals"
    config = GateSignalsConfig
    settings = ("action_repeat", "returns")
    needs: tuple[str, ...] = ("dataset", "world_model", "latents", "policies", "critics", "lookahead")

    def run(self, job: Job) -> Mapping[str, Any]:
        """Train critics at the other discounts, let every operator drive, and judge what was signalled."""
        from wasp_cli.learning.closed_loop import run_episodes
        from wasp_cli.learning.gate_signals import GATE, SignalRecorder, bootstrap, critics_by_discount, discounted
        from wasp_cli.learning.gate_signals_judge import POOLED, SignalRows, joined, judged, signal_rows
        from wasp_cli.learning.latents import load_latents
        from wasp_cli.learning.shards import read_shards
        from wasp_cli.models.critics import LatentCritics
        from wasp_cli.models.lookahead import LookAhead
        from wasp_cli.models.policy import load_skills
        from wasp_cli.models.weights import load_module
        from wasp_cli.models.world_model import load_world_model
        from wasp_cli.operators.base import EpisodeNoise, Operator, OperatorContext, build_operator
        from wasp_cli.operators.registry import UNIMPAIRED
        from wasp_cli.seeds import derive
        from wasp_cli.tasks.make import make_task

        config = cast(GateSignalsConfig, job.config)
        returns = job.settings["returns"]
        model, skills = load_world_model(job.inputs["world_model"]), load_skills(job.inputs["policies"])
        trained = load_module(LatentCritics, job.inputs["critics"] / "critics.safetensors")
        head = load_module(LookAhead, job.inputs["lookahead"] / "lookahead.safetensors")
        recording = read_shards(job.inputs["dataset"], ["action", "reward", "cost", "terminal", "first", "episode"])
        costs, promises, curves = critics_by_discount(
            model, skills, recording, load_latents(job.inputs["latents"]), trained, config, returns, (job.task, job.seed),
            lambda share, text: job.progress(TRAINING * share, text),
        )  # fmt: skip

        asked: list[tuple[str, float | None]] = [(UNIMPAIRED, None)]
        asked += [(variant, value) for variant in sorted(config.operators) for value in config.operators[variant]]
        there = [(variant, value) for variant, value in asked if variant != "limited-skill" or value in skills.fractions]
        task = make_task(job.task, config.episodes, action_repeat=job.settings["action_repeat"], observe=("pixels",), threads=job.threads)
        context = OperatorContext(skills.at, task.action_size, task.decision_seconds)
        batch = config.episodes
        parts: dict[str, SignalRows] = {}
        for number, (variant, value) in enumerate(there):
            name = _name(variant, value)

            def during(share: float, text: str, number: int = number, name: str = name) -> None:
                job.progress(TRAINING + (1 - TRAINING) * (number + share) / len(there), f"{name}: {text}")

            layouts, mistakes, draws = (
                [derive(f"gate-signals-{role}", job.task, job.seed, variant, value, i) for i in range(batch)]
                for role in ("episode", "operator", "draws")
            )
            operator = build_operator(variant, value, context, EpisodeNoise(mistakes), batch)
            expert = Operator.build(1.0, context, EpisodeNoise(mistakes), batch)
            recorder = SignalRecorder(model, costs, promises, expert, config, returns, head)
            loop = run_episodes(task, model, operator, recorder, layouts, draws, progress=during)
            parts[name] = signal_rows(loop, recorder.seen, recorder.promised, config.window, returns, number * batch)
        rival, task_gate = bootstrap(returns.gamma_c), bootstrap(returns.gamma_r)
        everyone = {POOLED: joined(list(parts.values())), **parts}
        sets = {name: judged(rows, config.threshold, rival, task_gate) for name, rows in everyone.items()}

        left_out = [_name(*one) for one in asked if one not in there]
        gates = {"gamma_c": returns.gamma_c, "gamma_r": returns.gamma_r, "gate": GATE, "task_gate": task_gate}
        facts = {**gates, **json.loads(config.model_dump_json()), "left_out": left_out}
        (job.out_dir / "signals.json").write_text(finite_json({**facts, "sets": sets, "curves": curves}))
        pooled = sets[POOLED]
        eq8 = pooled["signals"][rival]
        numbers = {
            "auprc": pooled["signals"][GATE]["auprc"], "auprc_bootstrap": eq8["auprc"], "base": pooled["base"],
            "onset_auprc": pooled["signals"][GATE]["onset_auprc"], "onset_auprc_bootstrap": eq8["onset_auprc"],
            "onset_base": pooled["onset_base"],
            **{name: pooled["gate"][name] for name in ("fires", "foreseen", "false_alarms", "predicted_over_real")},
            **{
                f"return_{span}_{label}": pooled["returns"][span]["signals"][name]["pearson"]
                for span in ("window", "rest")
                for label, name in (("sum", discounted(returns.gamma_r)), ("bootstrap", task_gate))
            },
        }  # fmt: skip
        return {name: round(value, 3) for name, value in numbers.items()}


def _name(variant: str, value: float | None) -> str:
    return "unimpaired" if value is None else f"{variant} {value:g}"
