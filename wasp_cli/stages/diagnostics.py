"""Quality of the world model on episodes that it was not trained on. Artifact: `diagnostics.json`
(see `learning.diagnostics`); `images.parquet`, or where the task shows no image `vectors.parquet`
(see `learning.image_samples`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, cast

from wasp_cli.learning.configs.world import DiagnosticsConfig
from wasp_cli.stages.base import Job
from wasp_cli.stages.finite import finite_json

SHOWN = (1, 5, 10, 15)  # imagined steps that the summary shows
SUMMARY = ("auprc", "persistence", "base", "predicted_over_base", "recall", "reward_r2")
"""Numbers of these steps that it shows for the held-out episodes."""


class DiagnosticsStage:
    """See the module."""

    kind = "diagnostics"
    config = DiagnosticsConfig
    settings = ("action_repeat", "returns")
    needs: tuple[str, ...] = ("expert", "dataset", "world_model", "latents")

    def run(self, job: Job) -> Mapping[str, Any]:
        """Judge fresh episodes of unseen operators and the held-out ones of the dataset, and sample
        what the model sees and imagines of the latter.
        """
        import numpy as np
        import torch

        from wasp_cli.learning.diagnostics import Alarm, judge_filter, judge_steps, judge_window
        from wasp_cli.learning.encoding import encode
        from wasp_cli.learning.forecast import forecast, spread_starts
        from wasp_cli.learning.image_samples import (
            FILES,
            Sample,
            decoded_sample,
            imagined_samples,
            sampled_windows,
            write_samples,
        )
        from wasp_cli.learning.latents import load_latents
        from wasp_cli.learning.observations import judge_observations
        from wasp_cli.learning.readout import StateReadout
        from wasp_cli.learning.shards import HELD_OUT, Recording, cost_sources, read_shards
        from wasp_cli.learning.unseen import unseen_episodes
        from wasp_cli.models.policy import checkpoint_fractions, load_privileged
        from wasp_cli.models.world_model import load_world_model
        from wasp_cli.seeds import derive
        from wasp_cli.tasks.make import make_task
        from wasp_cli.tasks.privileged_layout import privileged_groups

        config = cast(DiagnosticsConfig, job.config)
        alarm = Alarm(config.threshold, job.settings["returns"].gamma_c)
        model = load_world_model(job.inputs["world_model"])
        folder = job.inputs["dataset"]
        held_out = read_shards(folder, ["episode"]).held_out(HELD_OUT)

        # -- the two sets of episodes
        job.progress(0.0, "driving fresh episodes")
        task = make_task(
            job.task,
            config.episodes,
            action_repeat=job.settings["action_repeat"],
            observe=(model.reads, "privileged"),
            threads=job.threads,
        )
        expert = job.inputs["expert"]
        skills = [load_privileged(expert, fraction) for fraction in checkpoint_fractions(expert)]
        unseen = unseen_episodes(task, skills, job.task, job.seed)
        recordings: dict[str, Recording] = {
            "held_out": read_shards(folder, mask=held_out),
            "unseen": unseen,
        }

        # -- the regression to the privileged vector, fitted on rows that were learned from
        job.progress(0.15, "fitting the readout")
        allowed = np.flatnonzero(~held_out)
        count = min(config.readout_rows, len(allowed))
        places = np.linspace(0, len(allowed) - 1, count).round().astype(int)
        mask = np.zeros(len(held_out), bool)
        mask[allowed[places]] = True
        fitted_latents = load_latents(job.inputs["latents"]).rows(torch.from_numpy(mask))
        fitted = read_shards(folder, [model.reads, "privileged"], mask)
        groups = privileged_groups(job.task, fitted.privileged.shape[1])
        readout = StateReadout.fit(model, fitted, fitted_latents, groups, config.readout_penalty)
        del fitted, fitted_latents

        # -- judge both sets
        sets: dict[str, dict[str, Any]] = {}
        for number, (name, recording) in enumerate(recordings.items()):

            def during(
                share: float, text: str, begin: float = 0.2 + 0.4 * number, name: str = name
            ) -> None:
                job.progress(begin + 0.2 * share, f"{name}: {text}")

            latents = encode(model, recording, during)
            during(1.0, "imagining")
            seed = derive("diagnostics", job.task, job.seed, name)

            # costs, rewards and ends
            starts = spread_starts(recording, config.horizon, config.starts, ended=True)
            seen = forecast(model, recording, latents, starts, config.horizon, config.samples, seed)
            steps = judge_steps(recording, seen, alarm, cost_sources(folder))

            # images, or vectors
            image_starts = spread_starts(recording, config.horizon, config.image_starts)
            observations = judge_observations(
                model, recording, latents, image_starts, config.horizon, config.samples, seed
            )

            # the privileged vector
            ahead = spread_starts(recording, config.readout_step, config.starts)
            behaviours, episodes = np.unique(
                recording.behaviour[recording.first > 0].astype(str), return_counts=True
            )
            sets[name] = {
                "episodes": dict(zip(behaviours.tolist(), episodes.tolist(), strict=True)),
                "starts": len(starts),
                "steps": [row | more for row, more in zip(steps, observations, strict=True)],
                "window": judge_window(recording, seen, alarm),
                "filter": judge_filter(model, recording, latents, config.image_starts),
                "readout": {
                    "filtered": readout.filtered(recording, latents),
                    "embedding": readout.embedded(recording),
                    "step": config.readout_step,
                    "imagined": readout.imagined(
                        recording, latents, ahead, config.readout_step, config.samples, seed
                    ),
                },
            }

            # samples for people to look at
            if name == "held_out":
                imagined: list[Sample] = []
                windows = sampled_windows(recording, seen) if len(image_starts) else []
                if windows:
                    imagined = imagined_samples(model, recording, latents, seen, windows, seed)
                decoded = decoded_sample(model, recording, latents)
                write_samples(job.out_dir / FILES[model.reads], recording, decoded, imagined)
        (job.out_dir / "diagnostics.json").write_text(finite_json(sets))
        return _summary(sets)


def _summary(sets: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the numbers of the shown steps that people ask for first."""
    held_out = sets["held_out"]
    unseen = sets["unseen"]
    summary: dict[str, Any] = {}

    # -- costs and rewards
    summary |= _shown_steps("", held_out, SUMMARY)
    summary["auprc_any"] = round(held_out["window"]["auprc"], 3)
    summary |= _shown_steps("unseen_", unseen, ("auprc",))
    summary["unseen_auprc_any"] = round(unseen["window"]["auprc"], 3)

    # -- the privileged vector
    for group, share in held_out["readout"]["filtered"].items():
        summary[f"readout_{group}"] = round(share, 3)
    for group, share in held_out["readout"]["embedding"].items():
        summary[f"readout_embedding_{group}"] = round(share, 3)

    # -- observations at the last imagined step
    last = held_out["steps"][-1]
    over_copy = "vector_over_copy" if "vector_over_copy" in last else "image_over_copy"
    summary[f"{over_copy}@{last['k']}"] = round(last[over_copy], 3)
    return summary


def _shown_steps(prefix: str, judged: Mapping[str, Any], names: Sequence[str]) -> dict[str, float]:
    """Return some numbers of a set at the shown steps, as far as the horizon reaches."""
    steps = {row["k"]: row for row in judged["steps"]}
    return {
        f"{prefix}{name}@{k}": round(steps[k][name], 3)
        for name in names
        for k in SHOWN
        if k in steps
    }
