"""What the rows say of an episode: in curves over its decisions, to stand under a video with a cursor, and in words. T = decisions."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from wasp_cli.metrics.episode import GATE_LATE, GATE_METHOD, GATE_NONE, GATE_SAFETY, GATE_TASK, INTERVENED
from wasp_cli.video.map import COMMAND, COST, EXECUTED

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]

GATE_COLOURS = {GATE_SAFETY: "#0072B2", GATE_TASK: "#E69F00", GATE_METHOD: "#56B4E9", GATE_LATE: "#696969"}
GATE_NAMES = {GATE_SAFETY: "safety gate", GATE_TASK: "task gate", GATE_METHOD: "its own rule", GATE_LATE: "late, command stands"}
_DPI = 100
_LEFT, _RIGHT, _TOP, _BOTTOM = 88, 14, 6, 36
"""Margins in px."""
_STYLE: dict[Any, Any] = {"font.size": 8.5, "axes.spines.top": False, "axes.spines.right": False, "axes.linewidth": 0.7}


@dataclass(frozen=True, eq=False)
class EpisodeTrace:
    """What the rows say of an episode; arrays are [T], NaN is undefined."""

    title: str
    gate: NDArray[np.int64]
    costly: NDArray[np.bool_]
    a_h: Floats
    """[T, A]"""
    a: Floats
    """[T, A]"""
    deviation: Floats
    reward: Floats
    cost_env: Floats
    goals: Floats
    g_cost: Floats
    delta_g: Floats
    signal: Floats
    plan_cost: Floats
    alone_cost: Floats
    gated: bool
    """whether the method has WASP's gates"""
    tau_c: float | None
    tau_r: float | None
    signal_name: str
    signal_limit: float | None
    decision_seconds: float

    @property
    def length(self) -> int:
        """T"""
        return len(self.gate)


class Timeline:
    """The drawn curves, and where the cursor is."""

    def __init__(self, trace: EpisodeTrace, width: int, height: int) -> None:
        """Draw them once, as an image of `width` x `height` px."""
        # Imported here: matplotlib takes most of a second.
        from matplotlib import rc_context
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        self._trace, self._width = trace, width
        curves = _curves(trace)
        with rc_context(_STYLE):
            figure = Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI)
            FigureCanvasAgg(figure)
            grid = figure.add_gridspec(
                len(curves) + 1, 1, height_ratios=[*[2.2] * len(curves), 1.0], hspace=0.16,
                left=_LEFT / width, right=1 - _RIGHT / width, top=1 - _TOP / height, bottom=_BOTTOM / height,
            )  # fmt: skip
            panels = [figure.add_subplot(grid[i]) for i in range(len(curves) + 1)]
            for panel, (name, values, limit, limit_name) in zip(panels, curves, strict=False):
                _draw_curve(panel, name, values, limit, limit_name)
            _draw_strip(panels[-1], trace)
            figure.legend(
                handles=_marks(trace), loc="lower right", bbox_to_anchor=(1 - _RIGHT / width, 0.0), ncols=4, frameon=False, fontsize=8,
                borderaxespad=0.2, handlelength=1.0, handleheight=0.8, columnspacing=1.2,
            )  # fmt: skip
            for panel in panels:
                panel.set_xlim(-0.5, trace.length - 0.5)
                panel.tick_params(labelbottom=panel is panels[-1], length=2)
            panels[-1].set_xlabel("decision", labelpad=1)
            file = io.BytesIO()
            figure.savefig(file, format="png", dpi=_DPI)
        self.image = Image.open(file).convert("RGB")

    def cursor(self, t: int) -> float:
        """Return the column of decision t in px."""
        return _LEFT + (t + 0.5) / self._trace.length * (self._width - _LEFT - _RIGHT)


def _curves(trace: EpisodeTrace) -> list[tuple[str, Floats, float | None, str]]:
    """Name, values, limit and its name of every panel."""
    if trace.gated:
        found = [("$\\bar{G}^c$", trace.g_cost, trace.tau_c, "$\\tau_c$"), ("$\\Delta G$", trace.delta_g, trace.tau_r, "$\\tau_r$")]
        return [curve for curve in found if np.isfinite(curve[1]).any()] or found[:1]
    found = [("$\\|a-a^H\\|$", trace.deviation, None, "")]
    if np.isfinite(trace.signal).any():
        found.append((trace.signal_name, trace.signal, trace.signal_limit, "threshold"))
    return found


def _draw_curve(panel: Axes, name: str, values: Floats, limit: float | None, limit_name: str) -> None:
    decisions = np.arange(len(values))
    panel.plot(decisions, values, color=COMMAND, linewidth=0.9, marker=".", markersize=2.2)
    if limit is not None:
        panel.axhline(limit, color=EXECUTED, linewidth=1.1, linestyle="--")
        label = f"{limit_name} {limit:.3g}"
        panel.annotate(label, (1.0, limit), (-2, 2), ("axes fraction", "data"), "offset points", ha="right", color="#8f3f74", fontsize=8)
        panel.fill_between(decisions, limit, values, where=values > limit, color=EXECUTED, alpha=0.35, linewidth=0, interpolate=True)
    seen = [value for value in (*values[np.isfinite(values)].tolist(), limit) if value is not None]
    low, high = min(0.0, *seen), max(0.2, *seen)
    panel.set_ylim(low - 0.06 * (high - low), high + 0.3 * (high - low))
    panel.set_ylabel(name, rotation=0, ha="right", va="center", labelpad=4)
    panel.locator_params(axis="y", nbins=3)
    panel.grid(axis="y", color="#e3e3e3", linewidth=0.5)
    panel.set_axisbelow(True)


def _draw_strip(panel: Axes, trace: EpisodeTrace) -> None:
    """Interventions by gate above, costs below."""
    for gate, colour in GATE_COLOURS.items():
        where = np.flatnonzero(trace.gate == gate)
        panel.broken_barh([(t - 0.5, 1) for t in where.tolist()], (1.1, 0.8), facecolors=colour, linewidth=0)
    panel.broken_barh([(t - 0.5, 1) for t in np.flatnonzero(trace.costly).tolist()], (0.1, 0.8), facecolors=COST, linewidth=0)
    panel.set_ylim(0, 2)
    panel.set_yticks([0.5, 1.5], ["cost", "gate"])
    panel.tick_params(axis="y", length=0)


def _marks(trace: EpisodeTrace) -> list[Any]:
    """The legend of the strip."""
    from matplotlib.patches import Patch

    fired = [gate for gate in GATE_COLOURS if (trace.gate == gate).any()]
    return [Patch(color=GATE_COLOURS[gate], label=GATE_NAMES[gate]) for gate in fired] + [Patch(color=COST, label="cost paid")]


def numbers(trace: EpisodeTrace, t: int) -> list[str]:
    """Say what there is to say of decision `t`, a line each."""
    lines = [
        f"gate: {GATE_NAMES[int(trace.gate[t])]}" if trace.gate[t] != GATE_NONE else "gate: none, command stands",
        f"command   {_action(trace.a_h[t])}",
        f"executed  {_action(trace.a[t])}",
        f"‖a − aᴴ‖  {trace.deviation[t]:.2f}" if trace.deviation[t] > INTERVENED else "‖a − aᴴ‖  0",
    ]
    if trace.gated:
        lines.append(_against("Ḡᶜ", trace.g_cost[t], "τ_c", trace.tau_c))
        if np.isfinite(trace.delta_g[t]):
            lines.append(_against("ΔG", trace.delta_g[t], "τ_r", trace.tau_r))
        if np.isfinite(trace.plan_cost[t]):
            lines.append(f"plan's cost {trace.plan_cost[t]:.2f}, without it {trace.alone_cost[t]:.2f}")
    elif np.isfinite(trace.signal[t]):
        lines.append(_against(trace.signal_name, trace.signal[t], "limit", trace.signal_limit))
    lines.append(f"reward {trace.reward[t]:+.3f}, so far {trace.reward[: t + 1].sum():.2f}")
    lines.append(f"cost so far {int(trace.cost_env[: t + 1].sum())}, goals {int(trace.goals[: t + 1].sum())}")
    return lines


def _action(action: np.ndarray[tuple[int], np.dtype[np.float64]]) -> str:
    return "(" + ", ".join(f"{part:+.2f}" for part in action) + ")"


def _against(name: str, value: float, limit_name: str, limit: float | None) -> str:
    if limit is None:
        return f"{name} {value:.2f}"
    return f"{name} {value:.2f} {'>' if value > limit else '≤'} {limit_name} {limit:.3g}"
