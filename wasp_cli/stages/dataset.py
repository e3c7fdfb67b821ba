"""Dataset: episodes from a mixture of behaviours, with what assistants see. Artifact:
`shard-NNNN.parquet`, `contents.json` (see `learning.contents`), `incidents.json` (see
`metrics.incidents`).
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

from wasp_cli.learning.configs.recorded import DatasetConfig
from wasp_cli.stages.base import Job


class DatasetStage:
    """See the module."""

    kind = "dataset"
    config = DatasetConfig
    settings = ("action_repeat",)
    needs: tuple[str, ...] = ("expert",)

    def run(self, job: Job) -> Mapping[str, Any]:
        """Collect shards until there are enough decision steps. An interrupted collection goes on
        after its last whole shard.
        """
        import numpy as np

        from wasp_cli.learning.behaviours import Commander, behaviours
        from wasp_cli.learning.contents import ALL, contents_of, most_costly, unseen_sources
        from wasp_cli.learning.dataset import record
        from wasp_cli.learning.shards import (
            HELD_OUT,
            count_rows,
            hand_over,
            held_out_period,
            read_shards,
            write_shard,
        )
        from wasp_cli.metrics.incidents import incident_lengths, write_incidents
        from wasp_cli.models.policy import checkpoint_fractions, load_privileged
        from wasp_cli.seeds import derive
        from wasp_cli.tasks.make import make_task
        from wasp_cli.tasks.sight import seen_of

        config = cast(DatasetConfig, job.config)
        task = make_task(
            job.task,
            config.envs,
            action_repeat=job.settings["action_repeat"],
            observe=(seen_of(job.task), "privileged"),
            threads=job.threads,
        )
        expert = job.inputs["expert"]
        skills = [load_privileged(expert, fraction) for fraction in checkpoint_fractions(expert)]

        # -- who drives: a schedule of whole periods, so that it stays balanced when it is repeated
        period = held_out_period(HELD_OUT)
        planned = period * max(1, math.ceil(config.steps / task.max_decisions / period))
        schedule = behaviours(
            config.mixture.model_dump(),
            planned,
            len(skills),
            np.random.default_rng(derive("dataset-mixture", job.task, job.seed)),
        )

        # -- shards; episodes may end early, so shards are added until there are enough steps
        files: list[Path] = []
        steps = 0
        shard = 0
        while steps < config.steps:
            path = job.work_dir / f"shard-{shard:04d}.parquet"
            if not path.exists():
                episodes = range(shard * config.envs, (shard + 1) * config.envs)
                rows = [schedule[episode % planned] for episode in episodes]
                seeds = [derive("dataset-episode", job.task, job.seed, i) for i in episodes]
                random = np.random.default_rng(
                    derive("dataset-commands", job.task, job.seed, shard)
                )
                commander = Commander(skills, rows, task.action_size, random)
                names = [row.name for row in rows]
                recording = record(task, seeds, commander.command, names, episodes.start)
                partial = path.with_suffix(".partial")
                write_shard(partial, recording, task.cost_sources)
                partial.rename(path)
            files.append(path)
            steps += count_rows(path) - config.envs
            shard += 1
            job.progress(
                min(1.0, steps / config.steps), f"{steps} of {config.steps} decision steps"
            )
        for path in files:
            hand_over(path, job.out_dir / path.name)

        # -- what it holds
        contents = contents_of(job.out_dir)
        (job.out_dir / "contents.json").write_text(json.dumps(contents, indent=1))
        costs = read_shards(job.out_dir, ["cost", "episode"])
        write_incidents(job.out_dir, incident_lengths(costs.cost, costs.episode))

        # -- summary
        whole = contents[ALL]
        unseen = unseen_sources(contents)
        most = most_costly(contents)
        size = sum(path.stat().st_size for path in files)
        summary: dict[str, Any] = {
            "steps": steps,
            "episodes": whole["episodes"],
            "costly_share": round(whole["costly_share"], 4),
            "sources_not_seen": len(unseen),
            "return": round(whole["return_per_episode"], 2),
        }
        if unseen:
            summary["unseen_sources"] = ", ".join(unseen)
        if most is not None:
            summary["most_costly"] = most
        summary["megabytes"] = round(size / 2**20, 1)
        return summary
