"""The stage `risk`: trains the network of Careful on the recorded episodes. Artifact:
`risk.safetensors` (+ .json).
"""

from __future__ import annotations

from wasp_example.configs import RiskConfig


class RiskStage:
    """A class that names its section and what it reads; heavy imports stay inside `run`, so
    that `wasp plan` needs no torch.
    """

    kind = "risk"
    config = RiskConfig
    settings = ("action_repeat",)  # shared settings of the spec that its result depends on
    needs = ("dataset", "latents")  # recorded episodes, and their filtered latents row for row

    def run(self, job):
        """Train on nine tenths of the episodes, and judge on the others."""
        import torch

        from wasp_cli.learning.latents import load_latents
        from wasp_cli.learning.shards import HELD_OUT, read_shards
        from wasp_cli.metrics.ranking import average_precision
        from wasp_cli.models.weights import save_weights
        from wasp_cli.seeds import derive
        from wasp_example.risk import Risk, examples, train

        recording = read_shards(job.inputs["dataset"], ["action", "cost", "episode"])
        latents = load_latents(job.inputs["latents"])
        action = torch.from_numpy(recording.action)
        rows, costly = examples(recording, job.config.window)
        held = recording.held_out(HELD_OUT)[rows]

        def features_of(index):
            return latents.at(index).features

        sizes = {
            "features": features_of(torch.arange(1)).shape[1],
            "action": action.shape[1],
            "hidden": list(job.config.hidden),
        }
        # every draw has a name of its own, and depends on the seed
        torch.manual_seed(derive("risk-weights", job.task, job.seed))
        risk = Risk(**sizes)
        seed = derive("risk", job.task, job.seed)
        loss = train(
            risk, features_of, action, rows[~held], costly[~held], job.config, seed, job.progress
        )
        save_weights(risk, job.out_dir / "risk.safetensors", **sizes)
        with torch.inference_mode():
            index = torch.from_numpy(rows[held])
            score = risk(features_of(index), action[index + 1]).numpy()
        return {
            "loss": loss,
            "auprc": average_precision(costly[held], score),
            "base_rate": float(costly[held].mean()),
        }
