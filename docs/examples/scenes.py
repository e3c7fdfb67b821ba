"""What a slow driver, one gate of the printed WASP and both of them come to in front of a hazard:
the four scenes of the paper's Fig. 1.

    python docs/examples/scenes.py --out scenes.png

The worlds are in `scene_worlds`, the episodes in `scene_drives`.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scene_drives import Drive, drive, imagined, settings
from scene_worlds import STEP, Corridor, Fork, careful, driver
from torch import Tensor

from wasp_cli.methods.configs import PrintedConfig
from wasp_cli.metrics.episode import GATE_SAFETY, GATE_TASK
from wasp_cli.models.base import Latent
from wasp_cli.operators.base import Operator
from wasp_cli.report.canvas import drawn

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[Any]

PANELS: tuple[tuple[str, type[Corridor] | type[Fork], str, int], ...] = (
    ("(a) One step ahead: too late", Corridor, "no-rollout", GATE_SAFETY),
    ("(b) Imagined rollouts: in time", Corridor, "full", GATE_SAFETY),
    ("(c) Safety gate alone: brakes and is stuck", Fork, "safety-only", GATE_SAFETY),
    ("(d) Both gates: safe, and on to the goal", Fork, "full", GATE_TASK),
)
"""Title, world, variant of the printed WASP, and the gate whose imagination is shown, as in
Fig. 1.
"""

ROLLOUTS = 10
"""Imagined rollouts that are drawn."""


class Scene(NamedTuple):
    """What a panel shows: one episode each of the assisted driver and of the driver alone, and
    what was imagined at one moment.
    """

    title: str
    world: Corridor | Fork
    assisted: Drive
    alone: Drive
    moment: int
    """a step t at which the gate fired"""
    nominal: Array
    """[H + 1, K, 2A] imagined at t: the driver alone"""
    corrected: Array
    """[H + 1, K, 2A] imagined at t: the plan and the driver"""


def scenes(steps: int = 80, seed: int = 1, jitter: float = 0.01, **changes: object) -> list[Scene]:
    """The four scenes, each with the careful driver who is late; `changes` are to WASP's
    configuration.
    """
    return [
        _scene(title, kind(jitter=jitter), settings(variant, **changes), gate, steps, seed)
        for title, kind, variant, gate in PANELS
    ]


def _scene(
    title: str, world: Corridor | Fork, config: PrintedConfig, gate: int, steps: int, seed: int
) -> Scene:
    seen: list[tuple[Operator, Latent, Tensor]] = []

    def watch(latent: Latent, a_h: Tensor, operator: Operator) -> None:
        # A fork keeps the memory as it is now.
        seen.append(
            (operator.fork(torch.zeros(1, dtype=torch.long), 1, operator.noise), latent, a_h)
        )

    assisted = drive(world, driver(world, careful(world)), config, steps, seed=seed, watch=watch)
    alone = drive(world, driver(world, careful(world)), None, steps, seed=seed)
    # The first step at which safety was at stake, or the one after it at which a correction was
    # found to pay most.
    fired = assisted.gate[:, 0]
    moment = int((fired == GATE_SAFETY).argmax())
    if gate == GATE_TASK:
        late = (fired == GATE_TASK) & (np.arange(len(fired)) > moment)
        moment = int(np.where(late, assisted.delta_g[:, 0], -np.inf).argmax())
    horizon = 1 if config.variant == "no-rollout" else config.horizon
    plan = torch.from_numpy(assisted.plan[moment, 0])
    nominal = imagined(world, *seen[moment], horizon, ROLLOUTS)
    return Scene(
        title,
        world,
        assisted,
        alone,
        moment,
        nominal,
        imagined(world, *seen[moment], horizon, ROLLOUTS, plan=plan),
    )


BLACK, GREY, ORANGE, SKY, GREEN, VERMILION, PURPLE, BLUE = (
    "#000000",
    "#777777",
    "#E69F00",
    "#56B4E9",
    "#009E73",
    "#D55E00",
    "#CC79A7",
    "#0072B2",
)
"""Okabe and Ito's colours: distinguishable with every common colour blindness. Markers and
dashes tell them apart in print.
"""


def draw(path: Path, found: list[Scene] | None = None) -> None:
    """Draw the four scenes as a PNG: speed over place in the corridor, maps of the plane."""
    style: dict[Any, Any] = {
        "font.size": 9,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "hatch.linewidth": 0.6,
    }
    with drawn((9.6, 5.8), style, dpi=150) as figure:
        figure.get_layout_engine().set(h_pad=0.1, w_pad=0.08)
        panels = figure.subplots(2, 2).flat
        for panel, scene in zip(panels, scenes() if found is None else found, strict=True):
            (_corridor if isinstance(scene.world, Corridor) else _plane)(panel, scene)
            panel.set_title(scene.title, loc="left", fontweight="bold", pad=19)
            panel.text(
                0.0, 1.04, _numbers(scene), transform=panel.transAxes, fontsize=8.5, color="#444444"
            ).set_in_layout(False)
        handles = {
            label: handle
            for panel in figure.axes
            for handle, label in zip(*panel.get_legend_handles_labels(), strict=True)
        }
        figure.legend(
            handles.values(), handles.keys(), loc="outside lower center", ncols=4, frameon=False
        )
        figure.savefig(path, metadata={"Software": None})


def _numbers(scene: Scene) -> str:
    """What the assisted episode came to."""
    drive = scene.assisted
    if isinstance(scene.world, Corridor):
        first = drive.state[(drive.gate[:, 0] == GATE_SAFETY).argmax(), 0, 0]
        story = f"gate fires {scene.world.low - first:.2f} m before"
    elif drive.alive[-1, 0]:
        story = f"stands at x = {drive.state[-1, 0, 0]:.1f} m after {STEP * drive.length[0]:.1f} s"
    else:
        story = f"at the goal after {STEP * drive.length[0]:.1f} s"
    return (
        f"{story} · {STEP * drive.costs[0]:.1f} s in the hazard · intervened "
        f"{100 * drive.int_rate:.0f} %"
    )


def _corridor(panel: Axes, scene: Scene) -> None:
    """Speed over place."""
    assert isinstance(scene.world, Corridor)
    span = (scene.world.low, scene.world.high)
    panel.axvspan(*span, facecolor=VERMILION, alpha=0.18, edgecolor="none")
    panel.axvspan(
        *span, facecolor="none", edgecolor=VERMILION, alpha=0.5, hatch="///", label="hazard"
    )
    _paths(panel, scene)
    panel.set(
        xlim=(0.3, 3.0),
        ylim=(-0.2, 1.08),
        yticks=(0.0, 0.5, 1.0),
        xlabel="place along the corridor (m)",
        ylabel="speed (m/s)",
    )


def _plane(panel: Axes, scene: Scene) -> None:
    """A map."""
    from matplotlib.patches import Circle

    assert isinstance(scene.world, Fork)
    x, y = scene.world.centre.tolist()
    panel.add_patch(
        Circle((x, y), scene.world.radius, facecolor=VERMILION, alpha=0.18, edgecolor="none")
    )
    panel.add_patch(
        Circle(
            (x, y),
            scene.world.radius,
            facecolor="none",
            edgecolor=VERMILION,
            alpha=0.5,
            hatch="///",
        )
    )
    panel.plot(
        *scene.world.goal.tolist(),
        "*",
        color=GREEN,
        markersize=14,
        markeredgecolor="white",
        label="goal",
    )
    _paths(panel, scene)
    panel.set(
        xlim=(-0.05, 3.75),
        ylim=(-0.72, 0.72),
        aspect="equal",
        yticks=(-0.5, 0.0, 0.5),
        xlabel="x (m)",
        ylabel="y (m)",
    )


def _paths(panel: Axes, scene: Scene) -> None:
    """Both executed paths, the steps at which a gate fired, and what was imagined at one of
    them: first two entries of the states.
    """
    drive, alone, moment = scene.assisted, scene.alone, scene.moment
    path = alone.state[: alone.length[0] + 1, 0]
    panel.plot(
        path[:, 0],
        path[:, 1],
        color=BLACK,
        linewidth=1.2,
        linestyle=(0, (4, 2)),
        label="driver alone",
        zorder=2,
    )
    path = drive.state[: drive.length[0] + 1, 0]
    panel.plot(
        path[:, 0],
        path[:, 1],
        color=BLUE,
        linewidth=1.8,
        marker=".",
        markersize=4,
        label="driver with WASP",
        zorder=3,
    )
    for fan, colour, name in (
        (scene.nominal, GREY, "driver alone"),
        (scene.corrected, SKY, "plan, then driver"),
    ):
        for k, label in enumerate([f"imagined: {name}", *[None] * (fan.shape[1] - 1)]):
            panel.plot(
                fan[:, k, 0], fan[:, k, 1], color=colour, linewidth=0.9, label=label, zorder=4
            )
    for gate, colour, marker, name in (
        (GATE_SAFETY, ORANGE, "s", "safety"),
        (GATE_TASK, PURPLE, "D", "task"),
    ):
        places = path[:-1][drive.gate[: drive.length[0], 0] == gate]
        panel.plot(
            places[:, 0],
            places[:, 1],
            marker,
            color=colour,
            markersize=4.5,
            markeredgecolor="white",
            markeredgewidth=0.5,
            label=f"{name} gate fires",
            zorder=5,
        )
    panel.plot(
        *path[moment, :2],
        "o",
        markersize=11,
        markerfacecolor="none",
        markeredgecolor=BLACK,
        label="imagined here",
        zorder=6,
    )


def main() -> None:
    """Draw the picture into a file."""
    parser = argparse.ArgumentParser(
        description="Draw four scenes of safety-aware shared "
        "autonomy in worlds with a known answer."
    )
    parser.add_argument("--out", type=Path, required=True, help="PNG file to write")
    draw(parser.parse_args().out)


if __name__ == "__main__":
    main()
