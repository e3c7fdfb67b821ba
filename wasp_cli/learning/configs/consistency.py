"""The section of the stage `consistency`, in a file of its own so that the key of no other
stage covers it.
"""

from __future__ import annotations

from wasp_cli.config import Config, assumed


class ConsistencyConfig(Config):
    """CSA's consistency model and its teacher, conditioned on the latent features."""

    levels: int = assumed(
        80, "levels of the ladder on which is distilled, as in the authors' code", ge=2
    )
    width: int = assumed(128, "units of a layer and of the embeddings (the original has 256)", ge=1)
    depth: int = assumed(3, "layers (the original has 4)", ge=1)
    teacher_updates: int = assumed(
        4000, "gradient steps of the teacher (the original passes 5000 times over the data)", ge=1
    )
    updates: int = assumed(
        6000,
        "gradient steps of the distillation (the original passes 3000 times over the data)",
        ge=1,
    )
    batch: int = assumed(512, "actions per update (the original has 4096)", ge=1)
    learning_rate: float = assumed(
        1e-3, "RAdam, falling to zero (the original has 3e-4 throughout)", gt=0.0
    )
    ema: float = assumed(
        0.999,
        "decay of the averaged weights that are used, of the teacher and of the student",
        ge=0.0,
        lt=1.0,
    )
