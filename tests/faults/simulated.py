"""Runs of fake stages over environments that start processes (see `simulators`)."""

import json
import os
import shutil
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import psutil

from tests.run import fake_stages
from tests.run.harness import ROOT, start, wait_until
from wasp_cli.store.plain import read_json_lines

SPEC = """
name: ends
preset: smoke
task: simulators:{}-v0
methods: [human]
operators: {{noisy: {{moderate: 0.4}}}}
seeds: [0]
"""
NODES = 7
KINDS = ("Sim", "Session", "Bare", "Shell", "Daemon")
"""What is left alone by nobody but us, each in another way."""

SMALLEST = (
    "--select",
    "stage=dataset",
    *[
        part
        for setting in (
            "expert.interactions=400",
            "expert.envs=4",
            "expert.evaluation_episodes=2",
            "dataset.steps=300",
        )
        for part in ("--set", setting)
    ],
)


class Home:
    """A folder with the module of the environments, runs in it, and what they leave."""

    def __init__(self, folder: Path, real: bool = False) -> None:
        """`real`: the stages are not fakes, but two of the smallest."""
        self.folder, self.results, self.real = folder, folder / "results", real
        self.set()
        for module in (
            ROOT / "tests/faults/simulators.py",
            ROOT / "docs/examples/puddle.py",
        ):
            shutil.copy(module, folder)
        (folder / "simulated").touch()

    def set(self, **options) -> None:
        """Let the stages of the next runs behave in some way (see `fake_stages`)."""
        said = {"log": str(self.folder / "executions.log"), "worlds": 2, **options}
        os.environ[fake_stages.OPTIONS] = json.dumps(said)
        os.environ["WASP_SIMULATORS"] = str(self.folder)

    def start(self, kind: str, *options: str) -> subprocess.Popen[str]:
        (self.folder / f"{kind}.yaml").write_text(SPEC.format(kind), encoding="utf-8")
        command = ["run", f"{kind}.yaml", "--results", str(self.results), *options]
        if not self.real:
            return start(*command, cwd=self.folder)
        return subprocess.Popen(
            [sys.executable, "-m", "wasp_cli", *command, *SMALLEST],
            cwd=self.folder,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def run(self, kind: str, *options: str, code: int = 0) -> str:
        """A run to its end; what it prints."""
        process = self.start(kind, *options)
        out, errors = process.communicate(timeout=600)
        assert process.returncode == code, errors
        assert "Traceback" not in errors
        return out + errors

    def closed(self) -> list[str]:
        """The process of every environment that was closed so far."""
        with suppress(FileNotFoundError):
            return (self.folder / "closed").read_text(encoding="utf-8").splitlines()
        return []

    def left(self) -> list[psutil.Process]:
        """Processes of environments."""
        return [
            process
            for process in psutil.process_iter(["cmdline"])
            if str(self.folder) in " ".join(process.info["cmdline"] or ())
            and "fake_wasp" not in " ".join(process.info["cmdline"])
        ]

    def require_none_left(self) -> None:
        """A few seconds after a run there are none; a busy machine may need more."""
        wait_until(lambda: not self.left(), 60.0)

    def notes(self) -> list[str]:
        """What the only run says of environments that did not close."""
        (journal,) = self.results.glob("runs/*/journal.jsonl")
        return [
            event["message"] for event in read_json_lines(journal) if event["event"] == "unclosed"
        ]
