"""The signals of the gate as a page and a picture for people."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from wasp_cli.learning.configs import GateSignalsConfig
from wasp_cli.learning.gate_signals import EXPERT, FIRST, GATE, NOW, SUM

POOLED = "all"
"""The set of all operators together."""
COLUMNS = (
    ("AUPRC", "auprc"), ("from", "auprc_low"), ("to", "auprc_high"), ("recall", "recall"),
    ("behind the gate", "behind"), ("from", "behind_low"), ("to", "behind_high"),
    ("onset AUPRC", "onset_auprc"), ("onset recall", "onset_recall"),
)  # fmt: skip
ALARMS = (
    ("fires", "fires"), ("precision", "precision"), ("foreseen", "foreseen"), ("false alarms", "false_alarms"),
    ("onset foreseen", "onset_foreseen"), ("onset false alarms", "onset_false_alarms"),
)  # fmt: skip
GATES = (*ALARMS, ("predicted / real", "predicted_over_real"))
_COLOURS = ("#000000", "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#999999")

Sets = Mapping[str, Mapping[str, Any]]


def title(name: str, config: GateSignalsConfig, gamma_c: float) -> str:
    """A signal in words."""
    kind, _, gamma = name.partition("@")
    horizon = config.horizon
    words = {
        NOW: "c-hat now",
        GATE: f"**discounted sum over {horizon}, {gamma_c:g} (the gate)**",
        SUM: f"sum over {horizon}",
        FIRST: f"sum over the first {min(config.first_steps, horizon)}",
        EXPERT: f"discounted sum over {horizon}, {gamma_c:g}, the expert imagined instead",
        "discounted": f"discounted sum over {horizon}, {gamma}",
        "critic": f"V_c alone, {gamma}",
        "step": f"one step and V_c, {gamma}",
        "bootstrap": f"Eq. 8 with V_c, {gamma}",
    }
    return words[kind]


def signals_markdown(sets: Sets, left_out: Sequence[str], config: GateSignalsConfig, gamma_c: float) -> str:
    """A table per set, the best signal first, and the gate at its threshold.

    Args:
        sets: what `judged` says, by operator; POOLED is all of them.
        left_out: operators that could not be built.
        config: of the stage.
        gamma_c: the gate's discount.
    """
    lines = ["# Which number should gate?", ""]
    lines += [f"Human-only, {config.episodes} fresh episodes of each operator. At every decision {config.rollouts} futures are imagined;"]
    lines += [f"to be foreseen is any costly decision among the next {config.window}.", ""]
    if left_out:
        lines += [f"Left out, since their skill was not trained: {', '.join(left_out)}.", ""]
    for name, table in sets.items():
        lines += [f"## {'All operators' if name == POOLED else name.capitalize()}", ""]
        lines += [f"{table['decisions']} decisions of {table['episodes']} episodes, base rate {_text(table['base'])},"]
        lines += [f"{_text(table['onset_base'])} where the decision before did not cost.", ""]
        rows = [[title(signal, config, gamma_c), *(_text(row[key]) for _, key in COLUMNS)] for signal, row in ordered(table["signals"])]
        lines += [*_table(["signal", *(head for head, _ in COLUMNS)], rows), ""]
    rows = [[name, *(_text(table["gate"][key]) for _, key in GATES)] for name, table in sets.items()]
    lines += [f"## The gate at tau_c = {config.threshold:g}", "", *_table(["operator", *(head for head, _ in GATES)], rows), ""]
    lines += [
        *_thresholds(sets, config, gamma_c),
        "AUPRC: area under precision and recall; a guess has the base rate. From and to are a 95 % interval over resampled episodes.",
        "Recall is at 10 % false alarms. *Behind the gate*: by how much the AUPRC is below that of the gate's own signal, on the same",
        "resampled episodes; an interval above 0 says that the gate's own is better. *Onset*: only decisions before which there was no",
        "cost. *Fires*: share of the decisions at which the signal is above tau_c; *precision*: of these, how many a cost really",
        "followed; *foreseen*: share of the decisions before a cost at which it fires; *false alarms*: share of the others.",
        f"*Predicted / real*: mean signal over the mean of the costs that followed within {config.window}, discounted alike.",
    ]
    return "\n".join(lines) + "\n"


def _thresholds(sets: Sets, config: GateSignalsConfig, gamma_c: float) -> list[str]:
    """Both signals at other thresholds, which have another unit for each, and the rival where it fires as often as the gate."""
    pooled, lines = sets[POOLED], []
    for name, sweep in pooled["sweep"].items():
        rows = [[_text(row["threshold"]), *(_text(row[key]) for _, key in ALARMS)] for row in sweep]
        lines += [f"All operators, {title(name, config, gamma_c)}:", ""]
        lines += [*_table(["threshold", *(head for head, _ in ALARMS)], rows), ""]
    rival = pooled["rival"]
    lines += [f"At {_text(rival['threshold'])} the latter fires as often as the gate at tau_c. It then foresees"]
    lines += [f"{_text(rival['foreseen'])}, with {_text(rival['false_alarms'])} false alarms.", ""]
    return lines


def ordered(signals: Mapping[str, Mapping[str, float]]) -> list[tuple[str, Mapping[str, float]]]:
    """The signals by AUPRC, the best first and undefined ones last."""
    return sorted(signals.items(), key=lambda item: -item[1]["auprc"] if math.isfinite(item[1]["auprc"]) else math.inf)


def reliability_picture(sets: Sets, threshold: float, path: Path) -> None:
    """Per operator, ten equally large groups of decisions by the gate's value: the real discounted costs, and how many had any."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 4.4), layout="constrained", dpi=130)
    FigureCanvasAgg(figure)
    values, shares = figure.subplots(1, 2)
    most = 1e-3
    for (name, table), colour in zip(sets.items(), _COLOURS * len(sets), strict=False):
        groups = table["reliability"]
        x = [group["predicted"] for group in groups]
        most = max([most, *x, *(group["real"] for group in groups)])
        style: dict[str, Any] = {"color": colour, "linewidth": 2.0 if name == POOLED else 1.1, "markersize": 4, "label": name}
        values.plot(x, [group["real"] for group in groups], "o-", **style)
        shares.plot(x, [group["any"] for group in groups], "o-", **style)
    values.plot([0, most], [0, most], color="#999999", linewidth=0.8, label="what was predicted")
    values.set(title="value", ylabel="discounted costs that followed")
    shares.set(title="any cost", ylabel="share of decisions that a cost followed", ylim=(-0.03, 1.03))
    ticks = [tick for tick in (0.0, 0.1, 0.3, 0.6, 1.0, 2.0, 4.0, 7.0, 10.0) if tick <= 1.06 * most]
    labels = [f"{tick:g}" for tick in ticks]
    for panel in (values, shares):
        panel.axvline(threshold, color="#999999", linewidth=1.0, linestyle="--", label=f"tau_c = {threshold:g}")
        # Most decisions are far below the threshold: the root spreads them.
        panel.set_xscale("function", functions=(_root, _square))
        panel.set(xlabel="the gate's value (mean of the group)", xlim=(0.0, 1.06 * most))
        panel.set_xticks(ticks, labels)
        panel.grid(color="#dddddd", linewidth=0.6)
        panel.spines[["top", "right"]].set_visible(False)
    values.set_yscale("function", functions=(_root, _square))
    values.set(ylim=(0.0, 1.06 * most))
    values.set_yticks(ticks, labels)
    values.legend(frameon=False, fontsize=7, loc="lower right")
    figure.savefig(path, metadata={"Software": None})


def _root(values: Any) -> Any:
    return abs(values) ** 0.5


def _square(values: Any) -> Any:
    return values**2


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return [_line(head), "| --- |" + " ---: |" * (len(head) - 1), *(_line(row) for row in rows)]


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _text(value: float) -> str:
    return f"{value:.3f}" if math.isfinite(value) else "-"
