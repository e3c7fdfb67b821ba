"""A results folder of invented cells, as `wasp run` leaves them."""

from pathlib import Path

import numpy as np

from tests.store.test_tables import invent
from wasp_cli.metrics.episode import episode_metrics
from wasp_cli.store.artifact import commit, staging_folder
from wasp_cli.store.layout import Layout
from wasp_cli.store.tables import CellIdentity, Thresholds, write_cell

KEYS = [f"{number:020x}" for number in range(3)]
"""Of cells with three episodes of five steps."""


def folder_of_cells(root: Path, method: str = "ida") -> Layout:
    layout = Layout(root)
    layout.prepare()
    for seed, key in enumerate(KEYS):
        staging = staging_folder(layout, key)
        trajectories = [invent(seed * 10 + episode, 5) for episode in range(3)]
        rows = [episode_metrics(trajectory, 1, 25) for trajectory in trajectories]
        identity = CellIdentity("goal1", method, "full", "laggy", 0.5, seed)
        write_cell(staging, identity, trajectories, rows, Thresholds(), [np.ones(5)] * 3, [0, 1, 2])
        commit(
            layout,
            "evaluate",
            key,
            staging,
            {"label": f"goal1 s{seed} {method} laggy=0.5", "key": key, "kind": "evaluate"},
        )
    return layout
