"""Worlds with a known answer: what a slow driver, one of WASP's gates and both of them come to in front of a hazard.

The worlds are written down, not learned. They offer what WASP asks of a world model, so every number can be checked by hand, and a plan
against an exhaustive search. `python docs/examples/scenes.py --out scenes.png` draws the four scenes of the paper's Fig. 1.

Dimension letters: B rows, A action size (1 in the corridor, 2 in the plane), T decision steps, K imagined rollouts, H horizon.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wasp_cli.methods.base import Assistant
from wasp_cli.methods.configs import WASPConfig
from wasp_cli.methods.human import HumanOnly
from wasp_cli.methods.noise import gumbel, uniform
from wasp_cli.methods.wasp.assistant import WASP, effective
from wasp_cli.methods.wasp.imagine import Imagination
from wasp_cli.metrics.episode import GATE_NONE, GATE_SAFETY, GATE_TASK, INTERVENED
from wasp_cli.models.base import Latent
from wasp_cli.operators.base import Human, Operator, Policy
from wasp_cli.operators.delayed import DelayedOperator
from wasp_cli.operators.noise import DrawnNoise, EpisodeNoise

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[Any]

STEP = 0.1
"""Seconds of a decision step."""
THRUST, DRAG = 1.0, 1.0
"""v' = v + STEP (THRUST a - DRAG v), p' = p + STEP v': full thrust holds 1 m/s, and stopping from there takes seven steps and 0.24 m."""
PAY = 10.0
"""Reward of a metre towards the goal."""
ARRIVED = 0.15
"""Metres from the goal at which an episode ends."""
BLUR = 0.02
"""Metres over which the predicted probability of a cost goes from 0 to 1 at the hazard's edge, as that of a trained head would."""
GAMMA_R, GAMMA_C, LAM = 0.99, 0.95, 1.0
"""Where critics expect nothing, lambda is 1: Eq. 8 is then the discounted sum over the horizon."""

REACTION = 0.4
"""Seconds by which the slow driver is late."""
SIGHT = 0.45
"""Metres before the hazard at which the careful driver brakes."""
GAIN = 2.0
"""Command per m/s of wrong speed: more would make a driver who is late sway."""


# -- worlds ---------------------------------------------------------------------------------------------------------


class PointWorld:
    """A point with inertia: h = [p, v] in m and m/s [..., 2A], z = [reward of the step that led here] [..., 1].

    The noise input, made standard, shifts the velocity by `jitter` m/s per step, so that rollouts differ.
    """

    action_size: int

    def __init__(self, start: tuple[float, ...], goal: tuple[float, ...], jitter: float, dtype: torch.dtype) -> None:
        self.start, self.goal, self.jitter, self.dtype = start, torch.tensor(goal, dtype=dtype), jitter, dtype
        self.noise_size = self.action_size

    def at(self, *states: tuple[float, ...]) -> Latent:
        """Latents of states (p_1, .., p_A, v_1, .., v_A), one row each."""
        h = torch.tensor(states, dtype=self.dtype)
        return Latent(h, torch.zeros(len(states), 1, dtype=self.dtype))

    def initial(self, batch: int) -> Latent:
        return self.at(*[self.start] * batch)

    def filter(self, latent: Latent, action: Tensor, pixels: Tensor, first: Tensor) -> Latent:
        raise NotImplementedError("the state is known: there is nothing to filter")

    def imagine(self, latent: Latent, action: Tensor, noise: Tensor) -> Latent:
        place, speed = latent.h.split(self.action_size, -1)
        gust = (noise - 0.5772) * (math.sqrt(6.0) / math.pi)  # a Gumbel draw has mean 0.5772 and deviation pi / sqrt(6)
        onward = speed + STEP * (THRUST * action - DRAG * speed) + self.jitter * gust
        there = place + STEP * onward
        return Latent(torch.cat([there, onward], -1), PAY * (self.left(place) - self.left(there)).unsqueeze(-1))

    def reward(self, latent: Latent) -> Tensor:
        return latent.z[..., 0]

    def cost(self, latent: Latent) -> Tensor:
        return torch.sigmoid(self.depth(latent.h[..., : self.action_size]) / BLUR)

    def continues(self, latent: Latent) -> Tensor:
        return (self.left(latent.h[..., : self.action_size]) > ARRIVED).to(self.dtype)

    def inside(self, latent: Latent) -> Tensor:
        """The true cost in {0, 1}: whether the place is in the hazard [...]."""
        return (self.depth(latent.h[..., : self.action_size]) > 0).to(self.dtype)

    def left(self, place: Tensor) -> Tensor:
        """Metres from places [..., A] to the goal: [...]."""
        return (self.goal - place).norm(dim=-1)

    def depth(self, place: Tensor) -> Tensor:
        """Metres from places [..., A] to the hazard's edge, positive within and negative without: [...]."""
        raise NotImplementedError

    def ahead(self, place: Tensor) -> Tensor:
        """Metres to the hazard on the straight way from places [..., A] to the goal: [...], infinite where that way is free.

        From within, the hazard is no longer ahead.
        """
        raise NotImplementedError


class Corridor(PointWorld):
    """A hazard from `low` to `high` fills the way: all there is to do is to stop before it, and only driving through it pays."""

    action_size = 1

    def __init__(self, low: float = 2.0, high: float = 2.6, jitter: float = 0.0, dtype: torch.dtype = torch.float32) -> None:
        super().__init__((0.0, 0.0), (3.4,), jitter, dtype)
        self.low, self.high = low, high

    def depth(self, place: Tensor) -> Tensor:
        return torch.minimum(place[..., 0] - self.low, self.high - place[..., 0])

    def ahead(self, place: Tensor) -> Tensor:
        gap = self.low - place[..., 0]
        return torch.where(gap >= 0, gap, torch.inf)


class Fork(PointWorld):
    """A round hazard lies across the straight way to the goal, a little to its right: braking is safe, and steering around it also pays."""

    action_size = 2

    def __init__(
        self, centre: tuple[float, float] = (1.9, -0.15), radius: float = 0.5, jitter: float = 0.0, dtype: torch.dtype = torch.float32
    ) -> None:
        super().__init__((0.0, 0.0, 0.0, 0.0), (3.6, 0.0), jitter, dtype)
        self.centre, self.radius = torch.tensor(centre, dtype=dtype), radius

    def depth(self, place: Tensor) -> Tensor:
        return self.radius - (place - self.centre).norm(dim=-1)

    def ahead(self, place: Tensor) -> Tensor:
        along, aside = self.bearing(place)
        gap = along - (self.radius**2 - aside.square()).clamp(min=0).sqrt()  # half the chord that the straight way cuts
        return torch.where((aside.abs() < self.radius) & (gap >= 0), gap, torch.inf)

    def bearing(self, place: Tensor) -> tuple[Tensor, Tensor]:
        """Where the hazard's centre lies as seen from places [..., 2] towards the goal: metres ahead and metres to the left, [...] each."""
        way = direction(self.goal - place)
        to = self.centre - place
        return (way * to).sum(-1), way[..., 0] * to[..., 1] - way[..., 1] * to[..., 0]


class NothingBeyond:
    """Critics that expect nothing beyond the horizon, V_r = V_c = 0: an imagination then knows what it has imagined and no more."""

    def value_r(self, latent: Latent) -> Tensor:
        return torch.zeros_like(latent.h[..., 0])

    value_c = value_r


# -- drivers --------------------------------------------------------------------------------------------------------


def careful(world: PointWorld) -> Policy:
    """A driver who heads straight for the goal at 1 m/s and brakes in front of a hazard; it does not occur to him to steer around it.

    Prompt, he stops in time.
    """

    def command(features: Tensor) -> Tensor:
        place, speed = features[..., : 2 * world.action_size].split(world.action_size, -1)
        way = direction(world.goal - place)
        return steered(torch.where((world.ahead(place) < SIGHT).unsqueeze(-1), 0.0, way), speed)

    return command


def around(world: Fork, room: float = 0.12) -> Policy:
    """The expert of the plane: he passes the hazard on the left, `room` metres from it."""

    def command(features: Tensor) -> Tensor:
        place, speed = features[..., :4].split(2, -1)
        along, aside = world.bearing(place)
        # To the left of the centre by the angle at which the tangent leaves `room`; nothing to do if the way to the goal leaves more.
        half = torch.asin(((world.radius + room) / torch.hypot(along, aside)).clamp(max=1.0))
        turn = torch.atan2(aside, along) + half
        turn = torch.where((along > 0) & (turn > 0), turn, 0.0)
        way = direction(world.goal - place)
        turned = torch.stack([way[..., 0] * turn.cos() - way[..., 1] * turn.sin(), way[..., 0] * turn.sin() + way[..., 1] * turn.cos()], -1)
        return steered(turned, speed)

    return command


def direction(way: Tensor) -> Tensor:
    """Unit vectors of [..., A]."""
    return way / way.norm(dim=-1, keepdim=True).clamp(min=1e-9)


def steered(wanted: Tensor, speed: Tensor) -> Tensor:
    """The command [..., A] that holds a wanted velocity [..., A] and mends what is missing."""
    return (DRAG / THRUST * wanted + GAIN * (wanted - speed)).clamp(-1, 1)


def driver(world: PointWorld, policy: Policy, seconds: float = REACTION, batch: int = 1) -> Operator:
    """B drivers of one policy who react late by some seconds."""
    return DelayedOperator.build(seconds, Human(lambda _: policy, world.action_size, STEP), EpisodeNoise(range(batch)), batch)


# -- the closed loop --------------------------------------------------------------------------------------------------

TAU_C, TAU_R = 0.3, 0.5
"""Thresholds of the gates: 0.3 costly steps within the horizon, and a gain of 5 cm of way."""


def settings(variant: str = "full", **changes: object) -> WASPConfig:
    """WASP's configuration in these scenes: its defaults but for the thresholds, which belong to a world."""
    return WASPConfig.model_validate({"variant": variant, "tau_c": TAU_C, "tau_r": TAU_R, **changes})


def imagination(world: PointWorld, config: WASPConfig) -> Imagination:
    """Imagined returns in a world that is known exactly."""
    return Imagination(world, NothingBeyond(), effective(config), GAMMA_R, GAMMA_C, LAM)


def assistant(world: PointWorld, config: WASPConfig | None) -> Assistant:
    """WASP over a world that it knows; Human-only without a configuration."""
    return HumanOnly() if config is None else WASP(config, imagination(world, config), {})


class Drive(NamedTuple):
    """What B episodes left behind. After an episode's end only rows of `alive` count."""

    state: Array
    """[T + 1, B, 2A] places and velocities, from the start on"""
    a_h: Array
    """[T, B, A] the driver's commands"""
    action: Array
    """[T, B, A] what was executed"""
    reward: Array
    """[T, B]"""
    cost: Array
    """[T, B] in {0, 1}"""
    gate: Array
    """[T, B] one of GATE_*"""
    g_cost: Array
    """[T, B] nominal cost return (Eq. 9); NaN without a gate"""
    delta_g: Array
    """[T, B] gain of the task gate's probe (Eq. 12); NaN where it was not asked"""
    plan: Array
    """[T, B, L, A] chosen residuals; NaN where nothing was planned"""
    case2: Array
    """[T, B] share of Case II among the planner's iterations; 0 where nothing was planned"""
    alive: Array
    """[T, B]"""

    @property
    def intervened(self) -> Array:
        """[T, B] whether the executed action differs from the command."""
        return self.alive & (np.linalg.norm(self.action - self.a_h, axis=-1) > INTERVENED)

    @property
    def arrived(self) -> Array:
        """[B] whether the goal was reached; the last step counts as not."""
        return ~self.alive[-1]

    @property
    def length(self) -> Array:
        """[B] decision steps of each episode."""
        return self.alive.sum(0)

    @property
    def costs(self) -> Array:
        """[B] steps in the hazard."""
        return (self.cost * self.alive).sum(0)

    @property
    def returns(self) -> Array:
        """[B] sum of rewards."""
        return (self.reward * self.alive).sum(0)

    @property
    def int_rate(self) -> float:
        """Share of all decision steps with an intervention."""
        return float(self.intervened.sum() / self.alive.sum())


Watch = Callable[[Latent, Tensor, Operator], None]
"""Called before every decision with the latents, the commands [B, A] just issued and the operator that issued them."""


@torch.inference_mode()
def drive(
    world: PointWorld, operator: Operator, config: WASPConfig | None, steps: int, *,
    start: Latent | None = None, seed: int = 0, watch: Watch | None = None,
) -> Drive:  # fmt: skip
    """The closed loop in a world that is its own truth, for all rows of an operator side by side.

    Args:
        world: steps the truth, and is what the assistant imagines with.
        operator: of B rows, fresh.
        config: of WASP; None executes the driver's commands.
        steps: T.
        start: [B]; the world's own start if None.
        seed: names the streams of the world's noise and of the assistant.
        watch: sees every decision's situation.
    """
    batch = operator.batch
    latent = world.initial(batch) if start is None else start
    helper = assistant(world, config)
    helper.reset(torch.ones(batch, dtype=torch.bool), [1000 * seed + row for row in range(batch)])
    truth = [np.random.default_rng((seed, row)) for row in range(batch)]
    alive = torch.ones(batch, dtype=torch.bool)
    undefined = torch.full((batch,), torch.nan)
    blank = (torch.full((batch,), GATE_NONE), undefined, undefined, undefined.view(-1, 1, 1), torch.zeros(batch))
    states, found = [latent.h], []
    for _ in range(steps):
        a_h = operator.command(latent.features).clamp(-1, 1)
        if watch is not None:
            watch(latent, a_h, operator)
        action, record, planned = helper.decide(latent, a_h, operator)
        latent = world.imagine(latent, action, gumbel(truth, world.noise_size))
        gates = blank[:3] if record is None else (record.gate, record.g_cost, record.delta_g)
        plans = blank[3:] if planned is None else (planned.residuals, planned.case2.to(torch.float32).mean(-1))
        found.append((a_h, action, world.reward(latent), world.inside(latent), *gates, *plans, alive))
        alive = alive & (world.continues(latent) > 0)
        states.append(latent.h)
    return Drive(torch.stack(states).numpy(), *(torch.stack(column).numpy() for column in zip(*found, strict=True)))


@torch.inference_mode()
def imagined(
    world: PointWorld,
    operator: Operator,
    latent: Latent,
    a_h: Tensor,
    horizon: int,
    copies: int,
    *,
    plan: Tensor | None = None,
    seed: int = 0,
) -> Array:
    """K imagined rollouts from one row, of the driver alone as the safety gate sees them, or of a plan and him (Eq. 13).

    Args:
        world: what is imagined.
        operator: has just issued `a_h`; its copies begin with its memory.
        latent: one row.
        a_h: [1, A]
        horizon: H.
        copies: K.
        plan: residuals [L, A].
        seed: names the draws.

    Returns:
        States [H + 1, K, 2A].
    """
    source = [np.random.default_rng(seed)]
    gusts = gumbel(source, horizon, copies, world.noise_size)[0]  # [H, K, Z]
    forked = operator.fork(torch.zeros(1, dtype=torch.long), copies, DrawnNoise(uniform(source, horizon, copies, operator.draws)[0]))
    latent, now = latent.expand_rows(copies), a_h.repeat_interleave(copies, 0)
    states = [latent.h]
    for k in range(horizon):
        action = now if k == 0 else forked.command(latent.features)
        if plan is not None and k < len(plan):
            action = (action + plan[k]).clamp(-1, 1)
        latent = world.imagine(latent, action, gusts[k])
        states.append(latent.h)
    return torch.stack(states).numpy()


# -- the picture ------------------------------------------------------------------------------------------------------

PANELS: tuple[tuple[str, type[Corridor] | type[Fork], str, int], ...] = (
    ("(a) One step ahead: too late", Corridor, "no-rollout", GATE_SAFETY),
    ("(b) Imagined rollouts: in time", Corridor, "full", GATE_SAFETY),
    ("(c) Safety gate alone: brakes and is stuck", Fork, "safety-only", GATE_SAFETY),
    ("(d) Both gates: safe, and on to the goal", Fork, "full", GATE_TASK),
)
"""Title, world, variant of WASP, and the gate whose imagination is shown, as in Fig. 1."""

ROLLOUTS = 10
"""Imagined rollouts that are drawn."""


class Scene(NamedTuple):
    """What a panel shows: one episode each of the assisted driver and of the driver alone, and what was imagined at one moment."""

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
    """The four scenes, each with the careful driver who is late; `changes` are to WASP's configuration."""
    return [_scene(title, kind(jitter=jitter), settings(variant, **changes), gate, steps, seed) for title, kind, variant, gate in PANELS]


def _scene(title: str, world: Corridor | Fork, config: WASPConfig, gate: int, steps: int, seed: int) -> Scene:
    seen: list[tuple[Operator, Latent, Tensor]] = []

    def watch(latent: Latent, a_h: Tensor, operator: Operator) -> None:
        # A fork keeps the memory as it is now.
        seen.append((operator.fork(torch.zeros(1, dtype=torch.long), 1, operator.noise), latent, a_h))

    assisted = drive(world, driver(world, careful(world)), config, steps, seed=seed, watch=watch)
    alone = drive(world, driver(world, careful(world)), None, steps, seed=seed)
    # The first step at which safety was at stake, or the one after it at which a correction was found to pay most.
    fired = assisted.gate[:, 0]
    moment = int((fired == GATE_SAFETY).argmax())
    if gate == GATE_TASK:
        late = (fired == GATE_TASK) & (np.arange(len(fired)) > moment)
        moment = int(np.where(late, assisted.delta_g[:, 0], -np.inf).argmax())
    horizon, plan = effective(config).horizon, torch.from_numpy(assisted.plan[moment, 0])
    nominal = imagined(world, *seen[moment], horizon, ROLLOUTS)
    return Scene(title, world, assisted, alone, moment, nominal, imagined(world, *seen[moment], horizon, ROLLOUTS, plan=plan))


BLACK, GREY, ORANGE, SKY, GREEN, VERMILION, PURPLE, BLUE = (
    "#000000", "#777777", "#E69F00", "#56B4E9", "#009E73", "#D55E00", "#CC79A7", "#0072B2",
)  # fmt: skip
"""Okabe and Ito's colours: distinguishable with every common colour blindness. Markers and dashes tell them apart in print."""


def draw(path: Path, found: list[Scene] | None = None) -> None:
    """Draw the four scenes as a PNG: speed over place in the corridor, maps of the plane."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    style: dict[Any, Any] = {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "hatch.linewidth": 0.6}
    with rc_context(style):
        figure = Figure(figsize=(9.6, 5.8), layout="constrained", dpi=150)
        FigureCanvasAgg(figure)
        figure.get_layout_engine().set(h_pad=0.1, w_pad=0.08)
        panels = figure.subplots(2, 2).flat
        for panel, scene in zip(panels, scenes() if found is None else found, strict=True):
            (_corridor if isinstance(scene.world, Corridor) else _plane)(panel, scene)
            panel.set_title(scene.title, loc="left", fontweight="bold", pad=19)
            panel.text(0.0, 1.04, _numbers(scene), transform=panel.transAxes, fontsize=8.5, color="#444444").set_in_layout(False)
        handles = {label: handle for panel in figure.axes for handle, label in zip(*panel.get_legend_handles_labels(), strict=True)}
        figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=4, frameon=False)
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
    return f"{story} · {STEP * drive.costs[0]:.1f} s in the hazard · intervened {100 * drive.int_rate:.0f} %"


def _corridor(panel: Axes, scene: Scene) -> None:
    """Speed over place."""
    assert isinstance(scene.world, Corridor)
    span = (scene.world.low, scene.world.high)
    panel.axvspan(*span, facecolor=VERMILION, alpha=0.18, edgecolor="none")
    panel.axvspan(*span, facecolor="none", edgecolor=VERMILION, alpha=0.5, hatch="///", label="hazard")
    _paths(panel, scene)
    panel.set(xlim=(0.3, 3.0), ylim=(-0.2, 1.08), yticks=(0.0, 0.5, 1.0), xlabel="place along the corridor (m)", ylabel="speed (m/s)")


def _plane(panel: Axes, scene: Scene) -> None:
    """A map."""
    from matplotlib.patches import Circle

    assert isinstance(scene.world, Fork)
    x, y = scene.world.centre.tolist()
    panel.add_patch(Circle((x, y), scene.world.radius, facecolor=VERMILION, alpha=0.18, edgecolor="none"))
    panel.add_patch(Circle((x, y), scene.world.radius, facecolor="none", edgecolor=VERMILION, alpha=0.5, hatch="///"))
    panel.plot(*scene.world.goal.tolist(), "*", color=GREEN, markersize=14, markeredgecolor="white", label="goal")
    _paths(panel, scene)
    panel.set(xlim=(-0.05, 3.75), ylim=(-0.72, 0.72), aspect="equal", yticks=(-0.5, 0.0, 0.5), xlabel="x (m)", ylabel="y (m)")


def _paths(panel: Axes, scene: Scene) -> None:
    """Both executed paths, the steps at which a gate fired, and what was imagined at one of them: first two entries of the states."""
    drive, alone, moment = scene.assisted, scene.alone, scene.moment
    path = alone.state[: alone.length[0] + 1, 0]
    panel.plot(path[:, 0], path[:, 1], color=BLACK, linewidth=1.2, linestyle=(0, (4, 2)), label="driver alone", zorder=2)
    path = drive.state[: drive.length[0] + 1, 0]
    panel.plot(path[:, 0], path[:, 1], color=BLUE, linewidth=1.8, marker=".", markersize=4, label="driver with WASP", zorder=3)
    for fan, colour, name in ((scene.nominal, GREY, "driver alone"), (scene.corrected, SKY, "plan, then driver")):
        for k, label in enumerate([f"imagined: {name}", *[None] * (fan.shape[1] - 1)]):
            panel.plot(fan[:, k, 0], fan[:, k, 1], color=colour, linewidth=0.9, label=label, zorder=4)
    for gate, colour, marker, name in ((GATE_SAFETY, ORANGE, "s", "safety"), (GATE_TASK, PURPLE, "D", "task")):
        places = path[:-1][drive.gate[: drive.length[0], 0] == gate]
        panel.plot(places[:, 0], places[:, 1], marker, color=colour, markersize=4.5, markeredgecolor="white", markeredgewidth=0.5,
                   label=f"{name} gate fires", zorder=5)  # fmt: skip
    panel.plot(*path[moment, :2], "o", markersize=11, markerfacecolor="none", markeredgecolor=BLACK, label="imagined here", zorder=6)


def main() -> None:
    """Draw the picture into a file."""
    parser = argparse.ArgumentParser(description="Draw four scenes of safety-aware shared autonomy in worlds with a known answer.")
    parser.add_argument("--out", type=Path, required=True, help="PNG file to write")
    draw(parser.parse_args().out)


if __name__ == "__main__":
    main()
