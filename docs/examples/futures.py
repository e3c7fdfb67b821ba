"""What happens if you keep doing this, and what if it is corrected now? The three futures that WASP
compares at a decision, in a world with a known answer.

    python docs/examples/futures.py --out futures.png

A driver passes a round hazard too close: his command errs to the right of the expert's, and has
done so since the start. One such command does no harm, since an expert would steer clear after it.
If the error goes on, he grazes the hazard.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scene_drives import GAMMA_C, GAMMA_R, LAM, NoCritics
from scene_worlds import Fork, around
from torch import Tensor

from wasp_cli.methods.configs import WASPConfig
from wasp_cli.methods.wasp.assistant import WASP
from wasp_cli.methods.wasp.imagine import Imagination
from wasp_cli.metrics.episode import GATE_SAFETY
from wasp_cli.models.base import Latent
from wasp_cli.operators.base import EpisodeNoise, Operator
from wasp_cli.report.canvas import drawn
from wasp_cli.tasks.motors import UNKNOWN

ERROR = (0.0, -0.6)  # what the driver adds to the expert's command: he drifts to the right
TAU_C = 0.5  # costly decisions within the horizon
TAU_R = 100.0  # the task gate stays silent: this picture is about the safety gate
HORIZON = 15
STEPS = 30  # decisions until the driver has passed the hazard


class Moment(NamedTuple):
    """A decision, and what WASP imagined there."""

    way: NDArray[Any]  # [T + 1, 2] places from the start to this decision
    futures: dict[str, NDArray[Any]]  # by name, places [H + 1, 2]
    costs: dict[str, float]  # by name, expected costly decisions within the horizon, discounted
    fired: bool  # whether the safety gate fired


def assistant(world: Fork) -> WASP:
    """Build WASP over a world that it knows, with the expert who steers around the hazard."""
    config = WASPConfig.model_validate(
        {
            "horizon": HORIZON,
            "rollouts": 1,
            "tau_c": TAU_C,
            "tau_r": TAU_R,
            "error_lasts": 1.0,
        }
    )
    imagination = Imagination(world, NoCritics(), around(world), GAMMA_R, GAMMA_C, LAM)
    made = WASP(config, imagination, {}, UNKNOWN)
    made.reset(torch.ones(1, dtype=torch.bool), [0])
    return made


@torch.inference_mode()
def moment() -> Moment:
    """Drive without help until the safety gate fires, and return what it compared there."""
    world = Fork()
    expert = around(world)
    helper = assistant(world)
    nobody = Operator(expert, world.action_size, EpisodeNoise([0]), 1)
    latent = world.initial(1)
    way = [latent.h[0, :2].numpy()]
    for _ in range(STEPS):
        command = (expert(latent.features) + torch.tensor(ERROR)).clamp(-1, 1)
        decision = helper.decide(latent, command, nobody)
        assert decision.record is not None
        if int(decision.record.gate) == GATE_SAFETY:
            break
        latent = world.imagine(latent, command, torch.full((1, world.noise_size), 0.5772))
        way.append(latent.h[0, :2].numpy())
    error = command - expert(latent.features)
    ways = {
        "the command once, then the expert": (command, torch.zeros_like(error)),
        "the error goes on": (command, error),
        "corrected now": (expert(latent.features), torch.zeros_like(error)),
    }
    futures = {}
    costs = {}
    for name, (first, goes_on) in ways.items():
        futures[name], costs[name] = imagined(world, latent, first, goes_on)
    return Moment(np.stack(way), futures, costs, int(decision.record.gate) == GATE_SAFETY)


def imagined(
    world: Fork, latent: Latent, first: Tensor, goes_on: Tensor
) -> tuple[NDArray[Any], float]:
    """Return the places [H + 1, 2] of one command, then the expert with an error, and the
    discounted cost.
    """
    expert = around(world)
    still = torch.full((1, world.noise_size), 0.5772)
    places = [latent.h[0, :2].numpy()]
    cost = 0.0
    for k in range(HORIZON):
        action = first if k == 0 else (expert(latent.features) + goes_on).clamp(-1, 1)
        latent = world.imagine(latent, action, still)
        places.append(latent.h[0, :2].numpy())
        cost += GAMMA_C**k * float(world.cost(latent))
    return np.stack(places), cost


COLOURS = {
    "the command once, then the expert": "#0072B2",
    "the error goes on": "#D55E00",
    "corrected now": "#009E73",
}
"""Okabe and Ito's, distinguishable with every common colour blindness."""
DASHES = {
    "the command once, then the expert": "--",
    "the error goes on": "-",
    "corrected now": "-.",
}


def draw(path: Path) -> None:
    """Draw the moment as a PNG: a map with the way so far and the three futures."""
    found = moment()
    world = Fork()
    with drawn((7.6, 3.9), {"font.size": 9}, dpi=150) as figure:
        from matplotlib.patches import Circle

        panel = figure.subplots()
        centre = (float(world.centre[0]), float(world.centre[1]))
        panel.add_patch(Circle(centre, world.radius, color="#F3C6B4", label="hazard"))
        panel.plot(*found.way.T, color="#777777", lw=2, label="driven so far")
        for name, places in found.futures.items():
            panel.plot(
                *places.T,
                DASHES[name],
                color=COLOURS[name],
                lw=1.8,
                label=f"{name}: cost {found.costs[name]:.1f}",
            )
        panel.plot(*found.way[-1], "ko", ms=5)
        panel.set(xlabel="metres", ylabel="metres", aspect="equal", xlim=(-0.1, 2.6))
        panel.set_title(
            f"The safety gate fires, since a future costs more than tau_c = {TAU_C:g}",
            loc="left",
            fontsize=9,
        )
        panel.spines[["top", "right"]].set_visible(False)
        figure.legend(frameon=False, fontsize=8, loc="outside lower center", ncols=2)
        figure.savefig(path)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("futures.png"))
    draw(parser.parse_args().out)
