"""Stages of every kind that compute nothing: each hashes what it reads, writes down that it ran,
and misbehaves on request.

WASP_FAKE is JSON: {"log": file, "seconds": s, "work": iterations of a hash,
"bytes": size of a further file, "weights": whether to leave a safetensors file,
"free": n (what runs after the first n waits to be interrupted),
"worlds": n (environments of the node's task that are begun, and left as they are),
"behave": {part of a node's name: "raise", "raise once", "refuse", "kill", "kill once", "exit",
"sleep", "hang" (in native code) or "eat"},
"summaries": {part of a node's name: numbers that it tells beside its own}}.
"""

import hashlib
import json
import os
import signal
import sys
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import save_file

from wasp_cli.errors import TrainingError
from wasp_cli.stages.base import Job
from wasp_cli.stages.registry import STAGES
from wasp_cli.tasks.make import make_task

OPTIONS = "WASP_FAKE"


class Fake:
    """What every fake stage does."""

    kind = ""
    settings: tuple[str, ...] = ()
    needs: tuple[str, ...] = ()
    config: Any = None

    def run(self, job: Job) -> Mapping[str, Any]:
        options = json.loads(os.environ[OPTIONS])
        name = " ".join([job.task, f"s{job.seed}", job.kind, *map(str, job.axes.values())])
        with open(options["log"], "a", encoding="utf-8") as file:
            file.write(f"{name}\n")
            file.flush()
            # up to here it is the order of beginnings, whoever begins meanwhile
            written = file.tell()
        print(f"fake {name}")
        job.progress(0.5, "halfway")
        (job.out_dir / "half.bin").write_bytes(b"half")
        if "worlds" in options:
            make_task(job.task, options["worlds"]).reset(range(options["worlds"]))
        time.sleep(options.get("seconds", 0.0))
        if "work" in options:
            hashlib.pbkdf2_hmac("sha256", b"", b"", options["work"])
        if Path(options["log"]).read_bytes()[:written].count(b"\n") > options.get(
            "free", sys.maxsize
        ):
            time.sleep(600)  # until someone interrupts; not for ever, should nobody do so
        for text, behaviour in options.get("behave", {}).items():
            if text in name:
                misbehave(behaviour, Path(options["log"]).with_suffix(".once"))
        digest = hashlib.sha256(name.encode())
        for kind in sorted(job.inputs):
            digest.update((job.inputs[kind] / "data.bin").read_bytes())
        (job.out_dir / "data.bin").write_bytes(digest.digest())
        if "bytes" in options:
            (job.out_dir / "more.bin").write_bytes(digest.digest() * (options["bytes"] // 32))
        if options.get("weights"):
            save_file(
                {"w": np.frombuffer(digest.digest(), np.uint8).astype(np.float32)},
                job.out_dir / "weights.safetensors",
            )
        told = {"number": int.from_bytes(digest.digest()[:2], "big"), "nothing": float("nan")}
        for text, numbers in options.get("summaries", {}).items():
            if text in name:
                told |= numbers
        return told


def misbehave(behaviour: str, once: Path) -> None:
    if behaviour == "sleep":
        time.sleep(600)
    if behaviour == "hang":
        # one call, about a minute: no signal handler of Python's runs meanwhile
        hashlib.pbkdf2_hmac("sha256", b"", b"", 100_000_000)
    if behaviour == "eat":
        eaten = []
        for _ in range(600):
            eaten.append(b"x" * 2_000_000)
            time.sleep(0.005)
    if behaviour == "raise once" and not once.exists():
        once.touch()
        raise OSError("no luck this time")
    if behaviour == "raise":
        raise ZeroDivisionError("one\nby zero")
    if behaviour == "refuse":
        raise TrainingError("the loss is not finite", "lower the learning rate")
    if behaviour == "exit":
        sys.exit(7)
    if behaviour == "kill" or (behaviour == "kill once" and not once.exists()):
        once.touch()
        os.kill(os.getpid(), signal.SIGKILL)


def _fake(kind: str) -> type[Fake]:
    real = STAGES.load(kind)
    body = {"kind": kind, "settings": real.settings, "needs": real.needs, "config": real.config}
    return type(f"Fake_{kind}", (Fake,), body)


def install() -> dict[str, Any]:
    """Put a fake in the place of every stage; returns what was there."""
    before = dict(STAGES._own)
    for kind, info in before.items():
        if f"Fake_{kind}" not in globals():
            globals()[f"Fake_{kind}"] = _fake(kind)
        STAGES._own[kind] = replace(info, target=f"tests.run.fake_stages:Fake_{kind}")
    STAGES._all = None
    return before


def __getattr__(name: str) -> Any:
    # A worker imports this module afresh, and asks for the class by name.
    if name.startswith("Fake_"):
        globals()[name] = _fake(name.removeprefix("Fake_"))
        return globals()[name]
    raise AttributeError(name)
