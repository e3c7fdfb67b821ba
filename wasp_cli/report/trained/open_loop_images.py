"""Pictures of what a world model sees and imagines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from wasp_cli.learning.diagnostics import Forecast, imagined_images
from wasp_cli.learning.latents import Latents
from wasp_cli.learning.sampling import generator
from wasp_cli.learning.shards import Recording
from wasp_cli.models.world_model import SafetyWorldModel

COSTLY, CALM = 3, 2
"""Windows of the open-loop strip that reach a cost from a start without one, and windows without any cost."""
SIDE, GAP, LABEL, BAR, TEXT = 96, 4, 92, 26, 15
"""Sizes in px of an open-loop strip: a frame, between frames, the names of the rows, the bars of costs, a line of text."""
_INK, _PAPER, _TRUE, _IMAGINED = (20, 20, 20), (255, 255, 255), (214, 39, 40), (31, 119, 180)
_SET_COLOURS = {"held_out": "#0072B2", "unseen": "#D55E00"}
_SET_NAMES = {"held_out": "held-out episodes", "unseen": "unseen operators"}

Images = NDArray[np.uint8]


# -- what the filtered state shows ------------------------------------------------------------------------------


@torch.inference_mode()
def reconstruction_sheet(model: SafetyWorldModel, recording: Recording, latents: Latents, path: Path, columns: int = 10) -> None:
    """Rows: true front, decoded front, true rear, decoded rear; columns: steps spread over the episodes, half of them costly."""
    spread = np.linspace(0, len(recording.first) - 1, columns).astype(int)
    costly = np.flatnonzero(recording.cost > 0)
    marked = np.zeros(columns, bool)
    if len(costly):
        marked[columns // 2 :] = True
        spread[marked] = costly[np.linspace(0, len(costly) - 1, int(marked.sum())).astype(int)]
    true = recording.pixels[spread]  # [K, 6, 64, 64]
    decoded = _bytes(model.decode(latents.at(torch.from_numpy(spread))).numpy())
    sheet = Image.new("RGB", (LABEL + columns * (SIDE + GAP) + GAP, 4 * (SIDE + GAP) + GAP + TEXT), _PAPER)
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(11)
    for row, (name, images, camera) in enumerate(_rows(true, decoded, "decoded")):
        y = GAP + row * (SIDE + GAP)
        draw.text((GAP, y + SIDE // 2 - 6), name, _INK, font)
        for column in range(columns):
            sheet.paste(_frame(images[column], camera), (LABEL + column * (SIDE + GAP), y))
    for column in np.flatnonzero(marked).tolist():
        draw.text((LABEL + column * (SIDE + GAP), 4 * (SIDE + GAP) + 1), "costs", _TRUE, font)
    sheet.save(path, format="PNG")


# -- what is imagined -------------------------------------------------------------------------------------------


class Strip(NamedTuple):
    """One window: the start, then H steps."""

    title: str
    true: Images
    """[1 + H, 6, 64, 64]"""
    imagined: Images
    """[1 + H, 6, 64, 64]; the first one is the decoded filtered state"""
    cost: NDArray[Any]
    """[1 + H] real cost"""
    predicted: NDArray[Any]
    """[1 + H] imagined probability of a cost; the first one is the filtered state's"""


def shown_windows(recording: Recording, seen: Forecast) -> list[int]:
    """Indices into the starts: onsets of a cost late in the window first, spread over the episodes, then windows without any cost."""
    whole: NDArray[np.bool_] = np.asarray(seen.within.all(1))
    costs = (recording.cost[seen.follow] > 0) & whole[:, None]
    calm = (recording.cost[seen.starts] == 0) & whole
    first = np.where(costs.any(1), costs.argmax(1), -1)
    # An onset in the middle of the window shows both the approach and the cost.
    onset = np.flatnonzero(calm & (first >= costs.shape[1] // 3) & (first < costs.shape[1] - 1))
    if not len(onset):
        onset = np.flatnonzero(costs.any(1))
    quiet = np.flatnonzero(calm & ~costs.any(1))
    return [int(i) for group, count in ((onset, COSTLY), (quiet, CALM)) for i in _spread(group, count)]


@torch.inference_mode()
def strips(
    model: SafetyWorldModel, recording: Recording, latents: Latents, seen: Forecast, windows: Sequence[int], seed: int
) -> list[Strip]:
    """The chosen windows with one imagined future each; predicted costs are those of the forecast (means over its samples)."""
    index, horizon = np.array(windows, int), seen.cost.shape[1]
    starts = seen.starts[index]
    now = latents.at(torch.from_numpy(starts))
    begun, cost = model.decode(now).numpy()[:, None], model.cost(now).numpy()[:, None]
    future = imagined_images(model, recording, latents, starts, horizon, generator(seed))
    imagined = _bytes(np.concatenate([begun, future], 1))
    predicted = np.concatenate([cost, seen.cost[index]], 1)
    found = []
    for i, start in enumerate(starts.tolist()):
        rows = np.arange(start, start + horizon + 1)
        number = int(np.sum(recording.episode[:start] == recording.episode[start]))
        title = f"{recording.behaviour[start]}, episode {recording.episode[start]}, step {number}"
        found.append(Strip(title, recording.pixels[rows], imagined[i], recording.cost[rows], predicted[i]))
    return found


def open_loop_sheet(found: Sequence[Strip], path: Path) -> None:
    """A block per window: true front, imagined front, true rear, imagined rear, and under each step the predicted and the real cost."""
    columns = len(found[0].cost)
    block = TEXT + 4 * (SIDE + GAP) + BAR + TEXT + 3 * GAP
    sheet = Image.new("RGB", (LABEL + columns * (SIDE + GAP) + GAP, len(found) * block), _PAPER)
    draw, font, bold = ImageDraw.Draw(sheet), ImageFont.load_default(11), ImageFont.load_default(13)
    for number, strip in enumerate(found):
        top = number * block
        draw.text((GAP, top), f"{strip.title}: seen at 0, then {columns - 1} steps imagined under the true actions", _INK, bold)
        for row, (name, images, camera) in enumerate(_rows(strip.true, strip.imagined, "imagined")):
            y = top + TEXT + GAP + row * (SIDE + GAP)
            draw.text((GAP, y + SIDE // 2 - 6), name, _INK, font)
            for column in range(columns):
                x = LABEL + column * (SIDE + GAP)
                sheet.paste(_frame(images[column], camera), (x, y))
                if strip.cost[column] > 0:
                    draw.rectangle((x - 2, y - 2, x + SIDE + 1, y + SIDE + 1), outline=_TRUE, width=2)
        base = top + TEXT + GAP + 4 * (SIDE + GAP) + BAR
        draw.text((GAP, base - BAR), "predicted cost", _IMAGINED, font)
        draw.text((GAP, base - BAR // 2), "real cost", _TRUE, font)
        for column in range(columns):
            x, high = LABEL + column * (SIDE + GAP), round((BAR - 2) * float(strip.predicted[column]))
            draw.line((x, base, x + SIDE, base), _INK)
            draw.rectangle((x + 4, base - high, x + SIDE // 2 - 4, base), _IMAGINED)
            if strip.cost[column] > 0:
                draw.rectangle((x + SIDE // 2 + 4, base - BAR + 2, x + SIDE - 4, base), _TRUE)
            draw.text((x + 4, base + 1), f"{column}:  {strip.predicted[column]:.2f}", _IMAGINED, font)
    sheet.save(path, format="PNG")


def open_loop_film(found: Sequence[Strip], path: Path) -> None:
    """The same windows side by side as an animation: true over imagined, front then rear; a red edge marks a real cost."""
    frames = []
    for step in range(len(found[0].cost)):
        frame = Image.new("RGB", (LABEL + len(found) * (SIDE + GAP), TEXT + 4 * (SIDE + GAP) + TEXT), _PAPER)
        draw, font = ImageDraw.Draw(frame), ImageFont.load_default(11)
        draw.text((GAP, 1), f"step {step}" if step else "seen (step 0)", _INK, font)
        for column, strip in enumerate(found):
            x = LABEL + column * (SIDE + GAP)
            for row, (name, images, camera) in enumerate(_rows(strip.true, strip.imagined, "imagined")):
                y = TEXT + row * (SIDE + GAP)
                if column == 0:
                    draw.text((GAP, y + SIDE // 2 - 6), name, _INK, font)
                frame.paste(_frame(images[step], camera), (x, y))
                if strip.cost[step] > 0:
                    draw.rectangle((x, y, x + SIDE - 1, y + SIDE - 1), outline=_TRUE, width=3)
            draw.text((x, TEXT + 4 * (SIDE + GAP)), f"cost: {strip.predicted[step]:.2f}", _IMAGINED, font)
        frames.append(frame.convert("P", palette=Image.Palette.ADAPTIVE))
    frames[0].save(path, format="GIF", save_all=True, append_images=frames[1:], duration=[1000, *[250] * (len(frames) - 1)], loop=0)


# -- numbers ----------------------------------------------------------------------------------------------------


def reliability_figure(sets: Mapping[str, Mapping[str, Any]], shown: Sequence[int], path: Path) -> None:
    """Per shown step: the share of costs that was seen against the predicted probability; a mark's size says how many starts it has."""
    figure, panels = _figure(len(shown))
    for panel, k in zip(panels, shown, strict=True):
        panel.plot([0, 1], [0, 1], color="#999999", linewidth=0.8)
        for name, table in sets.items():
            for row in table["steps"]:
                if row["k"] == k:
                    bins = [b for b in row["reliability"] if b["size"]]
                    x, y = [b["predicted"] for b in bins], [b["seen"] for b in bins]
                    panel.plot(x, y, color=_SET_COLOURS[name], linewidth=1.0)
                    sizes = [12 * np.log10(1 + b["size"]) ** 1.5 for b in bins]
                    panel.scatter(x, y, sizes, color=_SET_COLOURS[name], label=f"{_SET_NAMES[name]}, ECE {row['calibration_error']:.3f}")
        panel.set(title=f"step {k}", xlabel="predicted probability of a cost", xlim=(-0.03, 1.03), ylim=(-0.03, 1.03))
        panel.legend(frameon=False, fontsize=7, loc="upper left")
    panels[0].set_ylabel("share seen")
    figure.savefig(path)


def horizon_figure(sets: Mapping[str, Mapping[str, Any]], path: Path) -> None:
    """Over the imagined step: AUPRC with its interval, predicted over base rate, reward R2, image error over that of a copy."""
    figure, panels = _figure(4)
    for name, table in sets.items():
        steps, colour = table["steps"], _SET_COLOURS[name]
        k = [row["k"] for row in steps]

        def line(panel: Any, key: str, style: str, label: str, k: Any = k, steps: Any = steps, colour: str = colour) -> None:
            panel.plot(k, [row[key] for row in steps], style, color=colour, linewidth=1.2, markersize=3, label=label)

        low, high = ([row[f"auprc_{end}"] for row in steps] for end in ("low", "high"))
        panels[0].fill_between(k, low, high, color=colour, alpha=0.15, linewidth=0)
        for key, style, text in (("auprc", "o-", "model"), ("persistence", "--", "persistence"), ("base", ":", "base rate")):
            line(panels[0], key, style, text if table is next(iter(sets.values())) else "_")  # colours are named in the other panels
        for panel, key in zip(panels[1:], ("predicted_over_base", "reward_r2", "image_over_copy"), strict=True):
            line(panel, key, "o-", _SET_NAMES[name])
    titles = ("cost AUPRC", "predicted cost / base rate", "reward R2", "image error / error of a copy")
    for panel, title in zip(panels, titles, strict=True):
        panel.set(title=title, xlabel="imagined step", xticks=[1, *range(5, 1 + max(len(table["steps"]) for table in sets.values()), 5)])
        panel.set_ylim(bottom=min(0.0, panel.get_ylim()[0]))
        panel.legend(frameon=False, fontsize=7)
    panels[0].set_ylim(0.0, 1.0)
    for panel in (panels[1], panels[3]):
        panel.axhline(1.0, color="#999999", linewidth=0.8)
        panel.set_ylim(top=max(1.3, panel.get_ylim()[1]))
    panels[1].axhspan(0.8, 1.25, color="#eeeeee", zorder=0)
    figure.savefig(path)


def _figure(panels: int) -> tuple[Any, Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.6 * panels, 3.4), layout="constrained", dpi=130)
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, panels, squeeze=False)[0]
    for panel in axes:
        panel.grid(color="#dddddd", linewidth=0.6)
        panel.spines[["top", "right"]].set_visible(False)
    return figure, axes


# -- images -----------------------------------------------------------------------------------------------------


def _rows(true: Images, other: Images, word: str) -> tuple[tuple[str, Images, int], ...]:
    """Name, images and first channel of the four rows of a picture."""
    return ("true front", true, 0), (f"{word} front", other, 0), ("true rear", true, 3), (f"{word} rear", other, 3)


def _frame(image: Images, camera: int) -> Image.Image:
    """One camera of [6, 64, 64] at the size of a frame."""
    shown = Image.fromarray(np.ascontiguousarray(image[camera : camera + 3].transpose(1, 2, 0)))
    return shown.resize((SIDE, SIDE), Image.Resampling.NEAREST)


def _bytes(images: NDArray[Any]) -> Images:
    """From [0, 1] to uint8."""
    return (images * 255).round().clip(0, 255).astype(np.uint8)


def _spread(rows: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """At most `count` of the rows, from the middles of equal parts."""
    count = min(count, len(rows))
    spread: NDArray[np.int64] = rows[((np.arange(count) + 0.5) / max(1, count) * len(rows)).astype(int)]
    return spread
