"""Measure our Diffusion and our IDA on the worlds of Yoneda et al. 2023: `python -m tests.external.measure FOLDER`.

FOLDER keeps the experts, the denoisers and every cell, so that a second run goes on. The rows go to `results/published`.
"""

from __future__ import annotations

import json
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
from tests.external.flights import alone, fly
from tests.external.lander import Kind
from tests.external.pilots import PILOTS
from wasp_cli.learning.configs.baselines import DenoiserConfig

FIRST = 1_000_000
"""Seed of the first world of an evaluation."""
RATIOS = (0.4, 1.0, 0.2, 0.6, 0.8)
DENOISER = DenoiserConfig()
KINDS: tuple[Kind, ...] = ("lander", "reacher")


def say(text: str) -> None:
    print(time.strftime("%H:%M:%S"), text, flush=True)


def prepare(kind: Kind, folder: Path) -> SAC:
    """Train the expert and what the assistants need, as far as it is not there."""
    minutes: dict[str, float] = {}
    begun = time.perf_counter()

    def took(part: str) -> None:
        nonlocal begun
        minutes[part], begun = (time.perf_counter() - begun) / 60, time.perf_counter()
        with (folder / "minutes.jsonl").open("a") as file:
            file.write(json.dumps({part: minutes[part]}) + "\n")

    train_expert(kind, folder, say)
    took("expert")
    model = SAC.load(folder / "model.zip", device="cpu")
    if not (folder / "demonstrations.npz").exists():
        fly_demonstrations(kind, model, folder / "demonstrations.npz", say)
        took("demonstrations")
    if not (folder / "quality.json").exists():
        learn_denoiser(kind, folder / "demonstrations.npz", folder, DENOISER, say)
        took("denoiser")
    save_votes(kind, model, folder)
    return model


def cells(kind: Kind) -> Iterator[tuple[str, str, float]]:
    """Yield (pilot, assistant, ratio), what the pass is about first."""
    for name, ratio in (("alone", 0.0), *(("diffusion", ratio) for ratio in RATIOS[:1]), ("ida", 0.4), *(("diffusion", r) for r in RATIOS[1:])):
        for pilot in ("noisy", "laggy", "expert", "zero"):
            yield pilot, name, ratio


def measure(kind: Kind, model: SAC, folder: Path, pilot: str, name: str, ratio: float) -> list[dict[str, Any]]:
    """Return the rows of a cell: an episode each."""
    path = folder / "cells" / f"{pilot}-{name}-{ratio:g}.json"
    if path.exists():
        return json.loads(path.read_text())  # type: ignore[no-any-return]
    begun, episodes = time.perf_counter(), external.GROUPS * external.EPISODES
    worlds = range(FIRST, FIRST + episodes)
    expert = actor(model)
    if name == "alone":
        loop = alone(kind, pilot, expert, worlds)
    else:
        loop = fly(kind, pilot, expert, assistant(name, ratio, folder), worlds)
    change = np.linalg.norm(loop.action - loop.a_h, axis=-1) * loop.alive  # [T, B]
    gates = [decision.record and decision.record.gate.numpy() for decision in loop.decisions]
    gate = np.array([np.zeros(episodes) if each is None else each for each in gates]) * loop.alive
    rows = [
        {
            "world": kind, "pilot": pilot, "value": PILOTS[kind][pilot][1], "assistant": name, "ratio": ratio,
            "group": i // external.EPISODES, "episode": i, "reached": bool(loop.goals[:, i].any()),
            "crashed": bool(loop.cost[:, i].any()), "decisions": int(loop.alive[:, i].sum()),
            "intervened": int((gate[:, i] > 0).sum()), "deviation": float(change[:, i].sum()),
        }
        for i in range(episodes)
    ]  # fmt: skip
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(rows))
    shares = ", ".join(f"{key} {100 * np.mean([row[key] for row in rows]):.1f} %" for key in ("reached", "crashed"))
    say(f"{kind} {pilot} {name} {ratio:g}: {shares}, {time.perf_counter() - begun:.0f} s")
    return rows


def publish(folder: Path) -> None:
    """Write what is measured so far, and how it was come by."""
    rows = [row for path in sorted(folder.glob("*/cells/*.json")) for row in json.loads(path.read_text())]
    pq.write_table(pa.Table.from_pylist(rows), external.ROWS, compression="zstd")
    found: dict[str, Any] = {}
    for kind in (kind for kind in KINDS if (folder / kind / "quality.json").exists()):
        lines = [json.loads(line) for line in (folder / kind / "curve.jsonl").read_text().splitlines()]
        minutes: dict[str, float] = {}
        for line in (folder / kind / "minutes.jsonl").read_text().splitlines():
            for part, took in json.loads(line).items():
                minutes[part] = minutes.get(part, 0.0) + took
        found[kind] = {
            "expert": lines[-1], "minutes": {part: round(took, 1) for part, took in minutes.items()},
            "denoiser": json.loads((folder / kind / "quality.json").read_text()),
        }  # fmt: skip
    external.PARTS.write_text(json.dumps(found, indent=1) + "\n")


def main(folder: Path) -> None:
    torch.set_num_threads(1)
    models = {}
    for kind in KINDS:
        models[kind] = prepare(kind, folder / kind)
        for pilot, name, ratio in cells(kind):
            measure(kind, models[kind], folder / kind, pilot, name, ratio)
            publish(folder)
    print(external.page())


if __name__ == "__main__":
    main(Path(sys.argv[1]))
