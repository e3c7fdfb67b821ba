"""Small artifacts of every kind that a report draws, as their stages leave them."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from tests.learning.recordings import SOURCES, recording
from wasp_cli.learning.contents import contents
from wasp_cli.learning.critic_quality import Pairs, write_pairs
from wasp_cli.learning.image_samples import Sample, write_samples
from wasp_cli.learning.shards import write_shard
from wasp_cli.report.trained.artifacts import Trained
from wasp_cli.store.layout import Layout

HORIZON = 6
BINS = [
    {"predicted": 0.05, "seen": 0.0, "size": 90},
    {"predicted": None, "seen": None, "size": 0},
    {"predicted": 0.9, "seen": 1.0, "size": 3},
]
CURVE = [
    {
        "interactions": 100.0 * i,
        "return": None if i == 1 else i,
        "cost_per_1000": 40 - i,
        "multiplier": 0.1 * i,
    }
    for i in range(5)
]
QUALITY = {
    kind: {"0": {"conformity": 0.5, "fidelity": 0.0}, "0.4": {"conformity": 0.25, "fidelity": 0.3}}
    for kind in ("expert", "recorded")
}


def diagnosed(sources: tuple[str, ...] = SOURCES) -> dict[str, Any]:
    """Both sets of episodes; the last step is undefined."""
    names = (
        "base",
        "auprc",
        "auprc_low",
        "auprc_high",
        "persistence",
        "recall",
        "predicted_over_base",
        "calibration_error",
        "onset_base",
        "onset_auprc",
        "foreseen",
        "onset_foreseen",
        "reward_r2",
        "image_error",
        "copy_error",
        "image_over_copy",
    )
    steps: list[dict[str, Any]] = []
    for k in range(1, HORIZON + 1):
        row: dict[str, Any] = {name: None if k == HORIZON else round(0.05 * k, 4) for name in names}
        ends = {"ends_base": 0.25, "ends_auprc": None, "ends_over_base": 1.5}
        steps.append(
            {
                "k": k,
                **row,
                "calibration_error": 0.1,
                **ends,
                "foreseen_by_source": dict.fromkeys(sources, 0.5),
                "reliability": BINS,
            }
        )
    keys = ("base", "auprc", "recall", "foreseen", "false_alarms")
    window: dict[str, Any] = {f"{prefix}{key}": 0.125 for prefix in ("", "onset_") for key in keys}
    window |= {"persistence": 0.2, "cost_correlation": None, "gamma": 0.95, "threshold": 0.5}
    filtered = {
        "auprc": 0.9,
        "base": 0.05,
        "predicted_over_base": 1.1,
        "image_error": 0.01,
        "image_variance": 0.04,
    }
    told = {"all": 0.5, "motion": 0.75, "things": None}
    readout = {
        "filtered": told,
        "embedding": {**told, "motion": -0.25},
        "step": 5,
        "imagined": told,
    }
    one = {
        "episodes": {"expert": 3, "noisy": 1},
        "starts": 40,
        "steps": steps,
        "window": window,
        "filter": filtered,
        "readout": readout,
    }
    return {"held_out": one, "unseen": one}


def write_dataset(folder: Path) -> None:
    """Two shards with their contents: five frames of them cost."""
    data = recording()
    data.cost[:], data.sources[:] = 0, 0
    data.cost[[4, 30]], data.sources[4, 0], data.sources[30, 1] = 1, 4, 1
    for number in (0, 1):
        write_shard(
            folder / f"shard-{number:04d}.parquet",
            data.rows((data.episode == 2) == (number == 1)),
            SOURCES,
        )
    (folder / "contents.json").write_text(json.dumps(contents(data, SOURCES)))


def write_images(folder: Path) -> None:
    """Ten decoded frames and two imagined windows, in which the model sees the negative of the
    truth.
    """
    data = recording()
    rows = [np.arange(10), np.arange(1, 2 + HORIZON), np.arange(22, 23 + HORIZON)]
    samples = [Sample(one, 255 - data.pixels[one], np.linspace(0, 1, len(one))) for one in rows]
    write_samples(folder / "images.parquet", data, samples[0], samples[1:])


def write_all_pairs(folder: Path, *names: str) -> None:
    random = np.random.default_rng(0)
    write_pairs(
        folder / "pairs.parquet",
        {name: Pairs(random.random(105), random.random(105), np.zeros(105), 0.0) for name in names},
    )


def artifact(layout: Layout, kind: str, seed: int = 0) -> Trained:
    """Write an artifact of a kind with its manifest."""
    key = f"{kind.encode().hex()}{seed:02d}"[-20:].rjust(20, "0")
    folder = layout.artifact(kind, key)
    folder.mkdir(parents=True)
    documents: dict[str, dict[str, Any]] = {
        "expert": {"curve.json": CURVE},
        "residual": {"curve.json": CURVE},
        "diagnostics": {"diagnostics.json": diagnosed()},
        "denoiser": {"quality.json": QUALITY},
        "consistency": {"quality.json": QUALITY},
    }
    for name, document in documents.get(kind, {}).items():
        (folder / name).write_text(json.dumps(document), encoding="utf-8")
    if kind == "dataset":
        write_dataset(folder)
    if kind == "diagnostics":
        write_images(folder)
    if kind in ("critics", "ida_q"):
        write_all_pairs(folder, *(("V_r", "V_c") if kind == "critics" else ("Q",)))
    config = {"cost_limit": 25.0, "mode": "penalty"} if kind == "residual" else {"cost_limit": 25.0}
    layout.manifest(kind, key).write_text(json.dumps({"config": config}), encoding="utf-8")
    return Trained(kind, "goal1", seed, key, 1.0, {}, kind)
