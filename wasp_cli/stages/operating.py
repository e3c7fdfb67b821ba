"""Operating point of one assistant, from held-out worlds of its training. Artifact:
`operating_point.json`, `held_out.json` (see `learning.operating`); of the operators alone the
latter.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs.operating import OperatingConfig
from wasp_cli.stages.base import Job


class OperatingStage:
    """See the module. The node of the method `human` has the operators alone, and all others read
    it.
    """

    kind = "operating"
    config = OperatingConfig
    settings = ("action_repeat", "returns")
    needs: tuple[str, ...] = ("world_model", "policies")
    needs_informed = ("expert",)

    def run(self, job: Job) -> Mapping[str, Any]:
        """Drive every value of the knob in the same worlds, and choose."""
        import numpy as np

        from wasp_cli.learning.assistants import build_assistant, build_turned, load_parts, words_of
        from wasp_cli.learning.device import training_device
        from wasp_cli.learning.informed import informed_policies, observed
        from wasp_cli.learning.operating import (
            ALONE,
            HeldOut,
            Worlds,
            drivers,
            race,
            read_alone,
            tried,
            write_alone,
            write_race,
        )
        from wasp_cli.methods.base import Assistant
        from wasp_cli.seeds import derive
        from wasp_cli.tasks.registry import TASKS

        config = cast(OperatingConfig, job.config)
        method = job.axes["method"]
        knob: Mapping[str, Any] = job.axes.get("knob", {})
        device = training_device()
        parts = load_parts(
            job.inputs, job.settings["returns"], device, motors=TASKS[job.task].motors
        )
        worlds = Worlds(
            job.task,
            job.seed,
            job.settings["action_repeat"],
            drivers(
                config.operators, config.episodes, derive("operating-drivers", job.task, job.seed)
            ),
            parts,
            informed_policies(job.task, job.inputs, device),
            observed(job.task),
            job.threads,
        )
        finished = 0

        def driven(value: float | None, some: range) -> list[HeldOut]:
            nonlocal finished

            def build() -> Assistant:
                if value is None:
                    return build_assistant(method, job.axes["method_config"], parts)
                return build_turned(method, job.axes["method_config"], parts, knob, value)

            rows = list(worlds.drive(build, method, value, some))
            finished += len(rows)
            text = f"{finished} of at most {config.episodes} held-out episodes"
            job.progress(finished / config.episodes, text)
            return rows

        if ALONE not in job.inputs:
            alone = driven(None, range(config.episodes))
            write_alone(job.out_dir, alone)
            return {
                "return": round(float(np.mean([row.return_ for row in alone])), 2),
                "cost": round(float(np.mean([row.cost for row in alone])), 1),
            }
        values = [None] if not knob else tried(knob["values"], config.episodes)
        found = race(values, config.episodes, driven, read_alone(job.inputs[ALONE]))
        write_race(job.out_dir, method, knob, found)
        best = found.best
        summary = {
            "return": round(best.return_, 2),
            "cost": round(best.cost, 1),
            "alone_return": round(best.alone_return, 2),
            "alone_cost": round(best.alone_cost, 1),
        }
        words = words_of(found.chosen is None, knob, best.value)
        return {"operating_point": words, **summary}
