"""Picture of a learning curve: return, cost and multiplier over the interactions."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

PANELS = (("return", "Return per episode"), ("cost_per_1000", "Cost per 1000 env steps"), ("multiplier", "Multiplier"))


def draw_curve(curve: Sequence[dict[str, float]], limit: float | None, path: Path) -> None:
    """Write a PNG with a panel per quantity, one below the other; `limit` is the cost limit per 1000 env steps, where there is one.

    Rollouts in which no episode ended have no return and leave a gap.
    """
    style: dict[Any, Any] = {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}
    with rc_context(style):
        figure = Figure(figsize=(6.0, 5.4), layout="constrained", dpi=120)
        FigureCanvasAgg(figure)
        interactions = np.array([row["interactions"] for row in curve])
        panels = figure.subplots(len(PANELS), 1, sharex=True)
        for panel, (name, title) in zip(panels, PANELS, strict=True):
            panel.plot(interactions / 1000.0, [row[name] for row in curve], color="#0072B2", linewidth=1.2)
            panel.set_title(title, loc="left")
            panel.grid(color="#dddddd", linewidth=0.6)
        if limit is not None:
            panels[1].axhline(limit, color="#D55E00", linestyle="--", linewidth=1.0, label=f"limit {limit:g}")
            panels[1].legend(frameon=False, loc="upper right")
        panels[-1].set_xlabel("Interactions in thousands of decision steps")
        figure.savefig(path, metadata={"Software": None})
