"""Measure our Diffusion and our IDA on the worlds of Yoneda et al. 2023: `python -m
tests.external.measure FOLDER`.

FOLDER keeps the experts, the denoisers and every cell, so that a second run goes on. The rows go to
`results/published`. Where `WASP_YONEDA` names a checkout of the authors' repository, their own
experts fly too, and first.
"""

import json
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import external
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from stable_baselines3 import SAC

from tests.external.assistants import assistant, fly_demonstrations, learn_denoiser, save_votes
from tests.external.expert import actor, train_expert
from tests.external.flights import fly
from tests.external.lander import Kind
from tests.external.pilots import PILOTS
from tests.external.theirs import TheirDenoiser, their_expert
from wasp_cli.learning.configs.baselines import DenoiserConfig
from wasp_cli.methods.human import HumanOnly

FIRST = 1_000_000  # seed of the first world of an evaluation
RATIOS = (0.4, 1.0, 0.2, 0.6, 0.8)
DENOISER = DenoiserConfig(updates=30_000, batch=4096)  # the authors' budget
KINDS: tuple[Kind, ...] = ("lander", "reacher")


def say(text: str) -> None:
    print(time.strftime("%H:%M:%S"), text, flush=True)


def prepare(whose: str, kind: Kind, folder: Path) -> SAC:
    """Return an expert; train it and what the assistants need, as far as it is not there."""
    folder.mkdir(parents=True, exist_ok=True)
    if whose == "theirs":
        model = their_expert(kind, Path(os.environ["WASP_YONEDA"]))
    else:
        train_expert(kind, folder, say)
        model = SAC.load(folder / "model.zip", device="cpu")
    shown = folder / "demonstrations.npz"
    for part, there, make in (
        ("demonstrations", shown, lambda: fly_demonstrations(kind, model, shown, say)),
        (
            "denoiser",
            folder / "quality.json",
            lambda: learn_denoiser(kind, shown, folder, DENOISER, say),
        ),
    ):
        if not there.exists():
            begun = time.perf_counter()
            make()
            (folder / f"{part}.minutes").write_text(f"{(time.perf_counter() - begun) / 60:.1f}")
    save_votes(kind, model, folder)
    return model


def cells(whose: str, kind: Kind) -> Iterator[tuple[str, str, float]]:
    """Yield (pilot, assistant, ratio), what the pass is about first; `released` is our
    Diffusion with their denoiser.
    """
    assisted = [("diffusion", ratio) for ratio in RATIOS]
    released = [("released", 0.4)] if whose == "theirs" else []
    for name, ratio in (("alone", 0.0), assisted[0], ("ida", 0.4), *released, *assisted[1:]):
        for pilot in PILOTS[kind]:
            yield pilot, name, ratio


def measure(
    kind: Kind, model: SAC, folder: Path, group: int, pilot: str, name: str, ratio: float
) -> None:
    """Write the rows of a group of a cell, an episode each, if they are not there."""
    path = folder / "cells" / f"{pilot}-{name}-{ratio:g}-{group}.json"
    if path.exists():
        return
    begun, episodes = time.perf_counter(), external.EPISODES
    worlds = range(FIRST + group * episodes, FIRST + (group + 1) * episodes)
    expert = actor(model)
    helper = (
        HumanOnly()
        if name == "alone"
        else assistant("ida" if name == "ida" else "diffusion", ratio, folder)
    )
    if name == "released":
        helper.assist.denoiser = TheirDenoiser(kind, Path(os.environ["WASP_YONEDA"]))
    loop = fly(kind, pilot, expert, helper, worlds)
    change = np.linalg.norm(loop.action - loop.a_h, axis=-1) * loop.alive  # [T, B]
    gates = [decision.record and decision.record.gate.numpy() for decision in loop.decisions]
    gate = np.array([np.zeros(episodes) if each is None else each for each in gates]) * loop.alive
    rows = [
        {
            "world": kind,
            "pilot": pilot,
            "value": PILOTS[kind][pilot][1],
            "assistant": name,
            "ratio": ratio,
            "group": group,
            "episode": group * episodes + i,
            "reached": bool(loop.goals[:, i].any()),
            "crashed": bool(loop.cost[:, i].any()),
            "decisions": int(loop.alive[:, i].sum()),
            "intervened": int((gate[:, i] > 0).sum()),
            "deviation": float(change[:, i].sum()),
        }
        for i in range(episodes)
    ]
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(rows))
    shares = ", ".join(
        f"{key} {100 * np.mean([row[key] for row in rows]):.1f} %" for key in ("reached", "crashed")
    )
    say(
        f"{kind} {pilot} {name} {ratio:g}, group {group}: {shares}, "
        f"{time.perf_counter() - begun:.0f} s"
    )


def publish(folder: Path) -> None:
    """Write what is measured so far, and how it was come by."""
    paths = sorted(folder.glob("*/*/cells/*.json"))
    rows = [
        {"expert": path.parts[-4]} | row for path in paths for row in json.loads(path.read_text())
    ]
    pq.write_table(pa.Table.from_pylist(rows), external.ROWS, compression="zstd")
    found: dict[str, dict[str, Any]] = {}
    for quality in sorted(folder.glob("*/*/quality.json")):
        there = quality.parent
        minutes = {
            part: float((there / f"{part}.minutes").read_text())
            for part in ("demonstrations", "denoiser")
        }
        each = {"denoiser": json.loads(quality.read_text()), "minutes": minutes}
        if (there / "curve.jsonl").exists():
            lines = [json.loads(line) for line in (there / "curve.jsonl").read_text().splitlines()]
            each["learned"] = lines[-1]["decisions"]
            minutes["expert"] = round(sum(line["seconds"] for line in lines) / 60, 1)
        found.setdefault(there.parent.name, {})[there.name] = each
    external.PARTS.write_text(json.dumps(found, indent=1) + "\n")


def main(folder: Path) -> None:
    torch.set_num_threads(1)
    experts = [
        whose for whose in external.EXPERTS if whose == "ours" or "WASP_YONEDA" in os.environ
    ]
    for group in range(external.GROUPS):
        for whose in experts:
            for kind in KINDS:
                model = prepare(whose, kind, folder / whose / kind)
                for pilot, name, ratio in cells(whose, kind):
                    measure(kind, model, folder / whose / kind, group, pilot, name, ratio)
                publish(folder)
    print(external.page())


if __name__ == "__main__":
    main(Path(sys.argv[1]))
