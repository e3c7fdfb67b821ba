"""Operating point of one assistant, from held-out worlds of its training. Artifact:
`operating_point.json` and `held_out.json` (see `learning.operating`); of the operators alone only
`held_out.json`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs.operating import OperatingConfig
from wasp_cli.stages.base import Job


class OperatingStage:
    """See the module. The node of the method `human` has the operators alone; the nodes of all
    other methods read it.
    """

    kind = "operating"
    config = OperatingConfig
    settings = ("action_repeat", "returns")
    needs: tuple[str, ...] = ("world_model", "policies")
    needs_informed = ("expert",)

    def run(self, job: Job) -> Mapping[str, Any]:
        """Drive values of the knob in the same worlds, and choose one of them."""
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
            spread_values,
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
        motors = TASKS[job.task].motors
        parts = load_parts(job.inputs, job.settings["returns"], device, motors=motors)

        # -- the held-out worlds, and who drives in each
        stream = derive("operating-drivers", job.task, job.seed)
        worlds = Worlds(
            task=job.task,
            seed=job.seed,
            action_repeat=job.settings["action_repeat"],
            drivers=drivers(config.operators, config.episodes, stream),
            parts=parts,
            informed=informed_policies(job.task, job.inputs, device),
            observe=observed(job.task),
            threads=job.threads,
        )
        finished = 0

        def drive(value: float | None, numbers: range) -> list[HeldOut]:
            """Drive some of the worlds at a value of the knob."""
            nonlocal finished

            def build() -> Assistant:
                if value is None:
                    return build_assistant(method, job.axes["method_config"], parts)
                return build_turned(method, job.axes["method_config"], parts, knob, value)

            rows = list(worlds.drive(build, method, value, numbers))
            finished += len(rows)
            text = f"{finished} of at most {config.episodes} held-out episodes"
            job.progress(finished / config.episodes, text)
            return rows

        # -- the operators alone, for all assistants
        if ALONE not in job.inputs:
            alone = drive(None, range(config.episodes))
            write_alone(job.out_dir, alone)
            return {
                "return": round(float(np.mean([row.return_ for row in alone])), 2),
                "cost": round(float(np.mean([row.cost for row in alone])), 1),
            }

        # -- the race between the values of the knob
        values: list[float | None] = [None]
        if knob:
            values = [*spread_values(knob["values"], config.episodes)]
        found = race(values, config.episodes, drive, read_alone(job.inputs[ALONE]))
        write_race(job.out_dir, method, knob, found)
        best = found.best
        return {
            "operating_point": words_of(found.chosen is None, knob, best.value),
            "return": round(best.return_, 2),
            "cost": round(best.cost, 1),
            "alone_return": round(best.alone_return, 2),
            "alone_cost": round(best.alone_cost, 1),
        }
