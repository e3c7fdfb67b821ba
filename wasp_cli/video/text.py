"""Words and letters on the frames of a video."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
from PIL import ImageFont

from wasp_cli.metrics.episode import GATE_NONE, INTERVENED
from wasp_cli.video.timeline import GATE_NAMES, Told


@lru_cache
def font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    """A typeface that has the paper's symbols: the one that matplotlib brings along."""
    import matplotlib

    folder = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    return ImageFont.truetype(str(folder / ("DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf")), size)


def numbers(told: Told, t: int) -> list[str]:
    """What there is to say of decision t, a line each."""
    lines = [
        f"gate: {GATE_NAMES[int(told.gate[t])]}" if told.gate[t] != GATE_NONE else "gate: none, command stands",
        f"command   {_action(told.a_h[t])}",
        f"executed  {_action(told.a[t])}",
        f"‖a − aᴴ‖  {told.deviation[t]:.2f}" if told.deviation[t] > INTERVENED else "‖a − aᴴ‖  0",
    ]
    if told.gated:
        lines.append(_against("Ḡᶜ", told.g_cost[t], "τ_c", told.tau_c))
        if np.isfinite(told.delta_g[t]):
            lines.append(_against("ΔG", told.delta_g[t], "τ_r", told.tau_r))
        if np.isfinite(told.plan_cost[t]):
            lines.append(f"plan's cost {told.plan_cost[t]:.2f}, alone {told.alone_cost[t]:.2f}")
    elif np.isfinite(told.signal[t]):
        lines.append(_against(told.signal_name, told.signal[t], "limit", told.signal_limit))
    lines.append(f"reward {told.reward[t]:+.3f}, so far {told.reward[: t + 1].sum():.2f}")
    lines.append(f"cost so far {int(told.cost_env[: t + 1].sum())}, goals {int(told.goals[: t + 1].sum())}")
    return lines


def _action(action: np.ndarray[tuple[int], np.dtype[np.float64]]) -> str:
    return "(" + ", ".join(f"{part:+.2f}" for part in action) + ")"


def _against(name: str, value: float, limit_name: str, limit: float | None) -> str:
    if limit is None:
        return f"{name} {value:.2f}"
    return f"{name} {value:.2f} {'>' if value > limit else '≤'} {limit_name} {limit:.3g}"
