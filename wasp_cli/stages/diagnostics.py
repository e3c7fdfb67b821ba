"""What the world model is worth on unseen episodes. Artifact: `diagnostics.json`,
`images.parquet`, or `vectors.parquet` where the task shows no image (see `learning.diagnostics`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

from wasp_cli.learning.configs.world import DiagnosticsConfig
from wasp_cli.stages.base import Job
from wasp_cli.stages.finite import finite_json

SHOWN = (1, 5, 10, 15)  # imagined steps that the summary shows


class DiagnosticsStage:
    """See the module."""

    kind = "diagnostics"
    config = DiagnosticsConfig
    settings = ("action_repeat", "returns")
    needs: tuple[str, ...] = ("expert", "dataset", "world_model", "latents")

    def run(self, job: Job) -> Mapping[str, Any]:
        """Judge both sets of episodes, and sample what is seen of the held-out ones."""
        import numpy as np
        import torch

        from wasp_cli.learning import diagnostics as judge
        from wasp_cli.learning.diagnostics import unseen_episodes
        from wasp_cli.learning.encoding import encode
        from wasp_cli.learning.image_samples import (
            FILES,
            decoded_sample,
            imagined_samples,
            sampled_windows,
            write_samples,
        )
        from wasp_cli.learning.latents import load_latents
        from wasp_cli.learning.readout import StateReadout
        from wasp_cli.learning.shards import HELD_OUT, Recording, cost_sources, read_shards
        from wasp_cli.models.policy import checkpoint_fractions, load_privileged
        from wasp_cli.models.world_model import load_world_model
        from wasp_cli.seeds import derive
        from wasp_cli.tasks.make import make_task
        from wasp_cli.tasks.privileged_layout import privileged_groups

        config = cast(DiagnosticsConfig, job.config)
        alarm = judge.Alarm(config.threshold, job.settings["returns"].gamma_c)
        model = load_world_model(job.inputs["world_model"])
        folder = job.inputs["dataset"]
        held = read_shards(folder, ["episode"]).held_out(HELD_OUT)
        observe = (model.reads, "privileged")
        task = make_task(
            job.task,
            config.episodes,
            action_repeat=job.settings["action_repeat"],
            observe=observe,
            threads=job.threads,
        )
        fractions = checkpoint_fractions(job.inputs["expert"])
        job.progress(0.0, "driving fresh episodes")
        recordings: dict[str, Recording] = {
            "unseen": unseen_episodes(
                task,
                [load_privileged(job.inputs["expert"], f) for f in fractions],
                job.task,
                job.seed,
            ),
            "held_out": read_shards(folder, mask=held),
        }
        job.progress(0.15, "fitting the readout")
        learned = np.flatnonzero(~held)
        chosen = np.zeros(len(held), bool)
        chosen[
            learned[
                np.linspace(0, len(learned) - 1, min(config.readout_rows, len(learned)))
                .round()
                .astype(int)
            ]
        ] = True
        known = load_latents(job.inputs["latents"]).rows(torch.from_numpy(chosen))
        told = read_shards(folder, [model.reads, "privileged"], chosen)
        groups = privileged_groups(job.task, told.privileged.shape[1])
        readout = StateReadout.fit(model, told, known, groups, config.readout_penalty)
        del told, known
        sets: dict[str, dict[str, Any]] = {}
        for part, (name, recording) in enumerate(reversed(recordings.items())):

            def during(
                share: float, text: str, begun: float = 0.2 + 0.4 * part, name: str = name
            ) -> None:
                job.progress(begun + 0.2 * share, f"{name}: {text}")

            latents = encode(model, recording, during)
            seed = derive("diagnostics", job.task, job.seed, name)
            starts = judge.spread_starts(recording, config.horizon, config.starts, ended=True)
            during(1.0, "imagining")
            seen = judge.forecast(
                model, recording, latents, starts, config.horizon, config.samples, seed
            )
            few = judge.spread_starts(recording, config.horizon, config.image_starts)
            ahead = judge.spread_starts(recording, config.readout_step, config.starts)
            steps = judge.judged_steps(recording, seen, alarm, cost_sources(folder))
            seen_ahead = judge.judged_observations(
                model, recording, latents, few, config.horizon, config.samples, seed
            )
            kinds, counts = np.unique(
                recording.behaviour[recording.first > 0].astype(str), return_counts=True
            )
            sets[name] = {
                "episodes": dict(zip(kinds.tolist(), counts.tolist(), strict=True)),
                "starts": len(starts),
                "steps": [row | more for row, more in zip(steps, seen_ahead, strict=True)],
                "window": judge.judged_window(recording, seen, alarm),
                "filter": judge.judged_filter(model, recording, latents, config.image_starts),
                "readout": {
                    "filtered": readout.filtered(recording, latents),
                    "embedding": readout.embedded(recording),
                    "step": config.readout_step,
                    "imagined": readout.imagined(
                        recording, latents, ahead, config.readout_step, config.samples, seed
                    ),
                },
            }
            if name == "held_out":
                windows = sampled_windows(recording, seen) if len(few) else []
                imagined = (
                    imagined_samples(model, recording, latents, seen, windows, seed)
                    if windows
                    else []
                )
                write_samples(
                    job.out_dir / FILES[model.reads],
                    recording,
                    decoded_sample(model, recording, latents),
                    imagined,
                )
        (job.out_dir / "diagnostics.json").write_text(finite_json(sets))
        return _summary(sets)


def _summary(sets: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """The numbers of the shown steps that people ask for first."""
    summary: dict[str, Any] = {}
    for prefix, name, keys in (
        (
            "",
            "held_out",
            ("auprc", "persistence", "base", "predicted_over_base", "recall", "reward_r2"),
        ),
        ("unseen_", "unseen", ("auprc",)),
    ):
        steps = {row["k"]: row for row in sets[name]["steps"]}
        summary |= {
            f"{prefix}{key}@{k}": round(steps[k][key], 3)
            for key in keys
            for k in SHOWN
            if k in steps
        }
        summary[f"{prefix}auprc_any"] = round(sets[name]["window"]["auprc"], 3)
    told = sets["held_out"]["readout"]
    summary |= {f"readout_{group}": round(share, 3) for group, share in told["filtered"].items()}
    summary |= {
        f"readout_embedding_{group}": round(share, 3) for group, share in told["embedding"].items()
    }
    last = sets["held_out"]["steps"][-1]
    over_copy = "vector_over_copy" if "vector_over_copy" in last else "image_over_copy"
    return summary | {f"{over_copy}@{last['k']}": round(last[over_copy], 3)}
