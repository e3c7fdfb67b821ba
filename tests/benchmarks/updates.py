"""Updates of a world model at the sizes of `cpu`, on random images: of this project (any checkout
of it) or of dreamerv3-torch.

`python updates.py wasp|dreamer CHECKOUT`: for every line that it reads it trains UPDATES times and
writes the CPU time of one, in ms.
"""

import sys
import tempfile
import time
import types
from pathlib import Path
from typing import Any

BATCH, LENGTH, ROWS, UPDATES = 8, 32, 4000, 5


def wasp(report: Any) -> None:
    """Eq. 6 with all its additions, on 8 sequences of 32 steps."""
    import numpy as np
    import torch

    from wasp_cli.learning import world_model as learning
    from wasp_cli.learning.configs import WorldModelConfig
    from wasp_cli.learning.privileged_state import new_readout
    from wasp_cli.learning.shards import Recording
    from wasp_cli.run.worker import keep_memory
    from wasp_cli.tasks.privileged_layout import privileged_mirror
    from wasp_cli.tasks.registry import TASKS

    keep_memory()  # as every worker does
    learning.SHOWN = UPDATES
    random = np.random.default_rng(0)
    turned = privileged_mirror("goal1")
    flags = np.arange(ROWS) % 200
    columns: dict[str, Any] = dict.fromkeys(Recording._fields, np.zeros(ROWS, np.float32)) | {
        "pixels": random.integers(0, 256, (ROWS, 6, 64, 64), np.uint8),
        "privileged": random.standard_normal((ROWS, len(turned[0])), np.float32),
        "action": random.uniform(-1, 1, (ROWS, 2)).astype(np.float32),
        "cost": (random.random(ROWS) < 0.05).astype(np.float32),
        "first": (flags == 0).astype(np.float32),
        "episode": (np.arange(ROWS) // 200).astype(np.int32),
    }
    columns.pop("state", None)  # images are what it sees
    recording, rows = Recording(**columns), np.arange(ROWS)
    config = WorldModelConfig(batch=BATCH, length=LENGTH, updates=10**6, checkpoint_every=10**9)
    model = learning.build(config, 2)
    model.mean_image.copy_(learning.mean_image(recording))
    readout = new_readout(model, recording, rows, config)
    matrix = np.array(TASKS["goal1"].mirror, np.float32)
    torch.manual_seed(0)
    with tempfile.TemporaryDirectory() as work:
        learning.train(
            model,
            recording,
            rows,
            config,
            config.updates,
            0,
            Path(work),
            lambda *_: report(),
            readout=readout,
            mirror=matrix,
            privileged_mirror=turned,
        )


def dreamer(report: Any) -> None:
    """The update of dreamerv3-torch's world model with the sizes of ours; it decodes every step
    and imagines nothing.
    """
    # What its tools import beside the update.
    sys.modules["torch.utils.tensorboard"] = types.SimpleNamespace(SummaryWriter=None)
    import models
    import numpy as np
    from gymnasium import spaces

    from wasp_cli.learning.configs import WorldModelConfig
    from wasp_cli.run.worker import keep_memory

    keep_memory()
    ours = WorldModelConfig()
    head = {"layers": 2, "dist": "symlog_disc", "loss_scale": 1.0, "outscale": 0.0}
    images = {
        "mlp_keys": "$^",
        "cnn_keys": "image",
        "act": "SiLU",
        "norm": True,
        "cnn_depth": ours.depth,
        "kernel_size": 4,
        "minres": 4,
        "mlp_layers": 2,
        "mlp_units": ours.head,
    }
    config = types.SimpleNamespace(
        precision=32,
        device="cpu",
        num_actions=2,
        act="SiLU",
        norm=True,
        units=ours.head,
        initial="learned",
        encoder=images | {"symlog_inputs": True},
        decoder=images
        | {"cnn_sigmoid": False, "image_dist": "mse", "vector_dist": "symlog_mse", "outscale": 1.0},
        dyn_stoch=ours.variables,
        dyn_deter=ours.deter,
        dyn_hidden=ours.hidden,
        dyn_rec_depth=1,
        dyn_discrete=ours.classes,
        dyn_mean_act="none",
        dyn_std_act="sigmoid2",
        dyn_min_std=0.1,
        unimix_ratio=ours.unimix,
        reward_head=head,
        cont_head=head,
        grad_heads=["decoder", "reward", "cont"],
        model_lr=1e-4,
        opt_eps=1e-8,
        grad_clip=1000,
        weight_decay=0.0,
        opt="adam",
        kl_free=1.0,
        dyn_scale=0.5,
        rep_scale=0.1,
        discount=0.997,
    )
    space = spaces.Dict({"image": spaces.Box(0, 255, (64, 64, 6), np.uint8)})
    random = np.random.default_rng(0)
    print_, sys.stdout = sys.stdout, sys.stderr
    model = models.WorldModel(space, None, 0, config)
    sys.stdout = print_
    shape = (BATCH, LENGTH)
    data = {
        "image": random.integers(0, 256, (*shape, 64, 64, 6), np.uint8),
        "action": random.uniform(-1, 1, (*shape, 2)).astype(np.float32),
        "reward": random.standard_normal(shape, np.float32),
        "is_first": np.zeros(shape, np.float32),
        "is_terminal": np.zeros(shape, np.float32),
        "discount": np.ones(shape, np.float32),
    }
    while True:
        for _ in range(UPDATES):
            model._train(dict(data))
        report()


class Report:
    """Told after every UPDATES updates; the first ones are not counted."""

    def __init__(self) -> None:
        self._begun: float | None = None

    def __call__(self) -> None:
        spent = 0.0 if self._begun is None else time.process_time() - self._begun
        print(1000 * spent / UPDATES, flush=True)
        if not sys.stdin.readline():
            sys.exit()
        self._begun = time.process_time()


if __name__ == "__main__":
    kind, checkout = sys.argv[1:]
    sys.path.insert(0, checkout)
    import torch

    torch.set_num_threads(1)
    {"wasp": wasp, "dreamer": dreamer}[kind](Report())
