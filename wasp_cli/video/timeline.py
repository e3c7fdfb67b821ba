"""What the rows say of an episode: in curves over its decisions, to stand under a video with a cursor, and in words."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from wasp_cli.metrics.episode import INTERVENED
from wasp_cli.report.explain.layout import action
from wasp_cli.report.explain.stored import Episode
from wasp_cli.report.explain.timeline import LOOKS, Curve, curves
from wasp_cli.video.map import COMMAND, COST, EXECUTED

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_DPI = 100
_LEFT, _RIGHT, _TOP, _BOTTOM = 88, 14, 6, 36  # margins in px
_STYLE: dict[Any, Any] = {"font.size": 8.5, "axes.spines.top": False, "axes.spines.right": False, "axes.linewidth": 0.7}


class Timeline:
    """The drawn curves, and where the cursor is."""

    def __init__(self, episode: Episode, width: int, height: int) -> None:
        # Imported here: matplotlib takes most of a second.
        from matplotlib import rc_context
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
        from matplotlib.patches import Patch

        self._decisions, self._width = episode.decisions, width
        drawn = [curve for curve in curves(episode) if np.isfinite(curve.values).any()]
        fired = [look for gate, look in LOOKS.items() if (episode.gate == gate).any()]
        with rc_context(_STYLE):
            figure = Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI)
            FigureCanvasAgg(figure)
            *panels, strip = figure.subplots(
                len(drawn) + 1, 1, sharex=True, squeeze=False,
                gridspec_kw={
                    "height_ratios": [*[2.2] * len(drawn), 1.0], "hspace": 0.16,
                    "left": _LEFT / width, "right": 1 - _RIGHT / width, "top": 1 - _TOP / height, "bottom": _BOTTOM / height,
                },
            )[:, 0]  # fmt: skip
            for panel, curve in zip(panels, drawn, strict=True):
                _draw_curve(panel, curve)
            _draw_strip(strip, episode)
            marks = [Patch(color=look.colour, label=look.words) for look in fired]
            figure.legend(
                handles=[*marks, Patch(color=COST, label="cost paid")], loc="lower right", bbox_to_anchor=(1 - _RIGHT / width, 0.0),
                ncols=4, frameon=False, fontsize=8, borderaxespad=0.2, handlelength=1.0, handleheight=0.8, columnspacing=1.2,
            )  # fmt: skip
            strip.set_xlim(-0.5, episode.decisions - 0.5)
            for panel in (*panels, strip):
                panel.tick_params(length=2)
            strip.tick_params(axis="y", length=0)
            strip.set_xlabel("decision", labelpad=1)
            file = io.BytesIO()
            figure.savefig(file, format="png", dpi=_DPI)
        self.image = Image.open(file).convert("RGB")

    def cursor(self, t: int) -> float:
        """Return the column of decision t in px."""
        return _LEFT + (t + 0.5) / self._decisions * (self._width - _LEFT - _RIGHT)


def _draw_curve(panel: Axes, curve: Curve) -> None:
    values, limit, decisions = curve.values, curve.limit, np.arange(len(curve.values))
    panel.plot(decisions, values, color=COMMAND, linewidth=0.9, marker=".", markersize=2.2)
    if limit is not None:
        panel.axhline(limit, color=EXECUTED, linewidth=1.1, linestyle="--")
        label = f"{curve.limit_name} {limit:.3g}"
        panel.annotate(label, (1.0, limit), (-2, 2), ("axes fraction", "data"), "offset points", ha="right", color="#8f3f74", fontsize=8)
        panel.fill_between(decisions, limit, values, where=values > limit, color=EXECUTED, alpha=0.35, linewidth=0, interpolate=True)
    shown = [value for value in (*values[np.isfinite(values)].tolist(), limit) if value is not None]
    low, high = min(0.0, *shown), max(0.2, *shown)
    panel.set_ylim(low - 0.06 * (high - low), high + 0.3 * (high - low))
    panel.set_ylabel(curve.name, rotation=0, ha="right", va="center", labelpad=4)
    panel.locator_params(axis="y", nbins=3)
    panel.grid(axis="y", color="#e3e3e3", linewidth=0.5)
    panel.set_axisbelow(True)


def _draw_strip(panel: Axes, episode: Episode) -> None:
    rows = [(1.1, episode.gate == gate, look.colour) for gate, look in LOOKS.items()]
    for y, where, colour in [*rows, (0.1, episode.costly, COST)]:
        panel.broken_barh([(t - 0.5, 1) for t in np.flatnonzero(where).tolist()], (y, 0.8), facecolors=colour, linewidth=0)
    panel.set_ylim(0, 2)
    panel.set_yticks([0.5, 1.5], ["cost", "gate"])


def numbers(episode: Episode, t: int) -> list[str]:
    """Say what there is to say of decision `t`, a line each."""
    gate, limits = LOOKS.get(int(episode.gate[t])), episode.thresholds
    deviation, alone = float(episode.numbers["deviation"][t]), episode.at("alone_cost", t)
    lines = [
        f"gate: {gate.words}" if gate else "gate: none, the command stands",
        f"command   {action(episode.a_h[t].tolist())}",
        f"executed  {action(episode.a[t].tolist())}",
        f"‖a − aᴴ‖  {deviation:.2f}" if deviation > INTERVENED else "‖a − aᴴ‖  0",
    ]
    if episode.gated:
        lines += _against("Ḡᶜ", episode.at("g_cost", t), "τ_c", limits.tau_c)
        lines += _against("ΔG", episode.at("delta_g", t), "τ_r", limits.tau_r)
        if (cost := episode.at("plan_cost", t)) is not None:
            lines.append(f"plan's cost {cost:.2f}" + ("" if alone is None else f", without it {alone:.2f}"))
    else:
        lines += _against(episode.signal.name, episode.at("signal", t), "limit", episode.signal_limit)
    reward, cost_env, goals = (episode.numbers[name][: t + 1] for name in ("reward", "cost_env", "goals"))
    lines.append(f"reward {reward[-1]:+.3f}, so far {reward.sum():.2f}")
    lines.append(f"cost so far {int(cost_env.sum())}, goals {int(goals.sum())}")
    return lines


def _against(name: str, value: float | None, limit_name: str, limit: float | None) -> list[str]:
    if value is None:
        return []
    return [f"{name} {value:.2f}" + ("" if limit is None else f" {'>' if value > limit else '≤'} {limit_name} {limit:.3g}")]
