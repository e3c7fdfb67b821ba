"""Rollouts: a further round of data, with the assistant at work.

Artifact: a complete dataset (see `stages.dataset`): the shards of the round before, then those of this round with the behaviour "wasp",
whose episodes are numbered on.

The assistant is full WASP of the round before, without a calibration: tau_c and tau_r are the values of its section, and fall back to
`TAU_C_FALLBACK` and `TAU_R_FALLBACK` of `methods.wasp.gates` where the section asks for calibrated ones.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

from wasp_cli.learning.configs.recorded import RolloutsConfig
from wasp_cli.stages.base import Job

BEHAVIOUR = "wasp"


class RolloutsStage:
    """See the module."""

    kind = "rollouts"
    config = RolloutsConfig
    settings = ("action_repeat", "returns")
    needs: tuple[str, ...] = ("dataset", "world_model", "policies", "critics")
    """All of the round before."""

    def run(self, job: Job) -> Mapping[str, Any]:
        """Collect shard after shard until there are enough new decision steps."""
        import numpy as np

        from wasp_cli.learning.assistants import build_assistant, load_parts
        from wasp_cli.learning.contents import ALL, contents_of
        from wasp_cli.learning.rollouts import assisted_episodes, in_turn
        from wasp_cli.learning.shards import count_rows, hand_over, read_shards, shard_files, write_shard
        from wasp_cli.operators.base import EpisodeNoise, OperatorContext
        from wasp_cli.seeds import derive
        from wasp_cli.tasks.make import make_task

        config = cast(RolloutsConfig, job.config)
        observe = ("pixels", "privileged")
        task = make_task(job.task, config.envs, action_repeat=job.settings["action_repeat"], observe=observe, threads=job.threads)
        parts = load_parts(job.inputs, job.settings["returns"])
        assistant = build_assistant(job.axes["method"], job.axes["method_config"], parts)
        context = OperatorContext(parts.skills.at, task.action_size, task.decision_seconds)
        known = shard_files(job.inputs["dataset"])
        recorded = int(np.max(read_shards(job.inputs["dataset"], ["episode"]).episode)) + 1

        def streams(role: str, first: int) -> list[int]:
            return [derive(f"rollouts-{role}", job.task, job.seed, job.axes["round"], first + i) for i in range(config.envs)]

        new: list[Path] = []
        steps = 0
        while steps < config.steps:
            path = job.work_dir / f"shard-{len(known) + len(new):04d}.parquet"
            first, before = len(new) * config.envs, steps

            def tell(share: float, text: str, before: int = before) -> None:
                most = config.envs * task.max_decisions
                job.progress(min(1.0, (before + share * most) / config.steps), f"{before} of {config.steps} decision steps, {text}")

            if not path.exists():
                operator = in_turn(config.operators, context, EpisodeNoise(streams("operator", first)), config.envs, first)
                seeds = streams("episode", first), streams("method", first)
                recording = assisted_episodes(task, parts.world_model, operator, assistant, *seeds, BEHAVIOUR, recorded + first, tell)
                partial = path.with_suffix(".partial")
                write_shard(partial, recording, task.cost_sources)
                partial.rename(path)  # an interrupted collection goes on after its last whole shard
            new.append(path)
            steps += count_rows(path) - config.envs
        for path in [*known, *new]:
            hand_over(path, job.out_dir / path.name)
        contents = contents_of(job.out_dir)
        (job.out_dir / "contents.json").write_text(json.dumps(contents, indent=1))
        size = sum(path.stat().st_size for path in job.out_dir.glob("shard-*.parquet"))
        own = contents[BEHAVIOUR]
        return {
            "steps": int(contents[ALL]["steps"]), "costly_share": contents[ALL]["costly_share"],
            "own_steps": int(own["steps"]), "own_costly_share": own["costly_share"], "own_return": own["return_per_episode"],
            "megabytes": round(size / 2**20, 1),
        }  # fmt: skip
