"""Runs over environments that start a process are ended at random instants, again and again:
python -m tests.faults.kill_simulators [--kills N] [--seed S] [--real]

Each time a worker, the run, or both are killed, or the run gets SIGTERM, Ctrl-C, or Ctrl-C twice.
A few seconds later no process of an environment is left, what was finished is there, and the run
that follows leaves the bytes that an undisturbed one leaves. With --real the stages are not fakes.
"""

import argparse
import os
import random
import signal
import subprocess
import tempfile
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path

from tests.faults.simulated import KINDS, Home
from tests.faults.test_random_kills import (
    artifacts,
    children,
    kill_workers,
    payload,
    require_whole,
)
from tests.run.harness import wait_until

VICTIMS = ("a worker", "the run", "both", "SIGTERM", "Ctrl-C", "Ctrl-C twice")
IN_A_ROW = 3  # kills at most before the run may end
JOBS = ("-j", "2")


def strike(victim: str, process: subprocess.Popen[str], chance: random.Random) -> bool:
    """Whether there was something to strike."""
    workers = children(process.pid, b"loky")
    if process.poll() is not None or (victim == "a worker" and not workers):
        return False
    with suppress(ProcessLookupError):
        if victim == "a worker":
            os.kill(chance.choice(workers), signal.SIGKILL)
        if victim == "both":
            kill_workers(workers)
        if victim in ("the run", "both"):
            process.kill()
        if victim == "SIGTERM":
            process.terminate()
        if victim.startswith("Ctrl-C"):
            os.killpg(process.pid, signal.SIGINT)
        if victim == "Ctrl-C twice":
            time.sleep(chance.uniform(0.0, 1.0))
            os.killpg(process.pid, signal.SIGINT)
    return True


class Storm:
    """Kills, and what they hit."""

    def __init__(self, root: Path, seed: int, real: bool) -> None:
        self.root, self.chance, self.real = root, random.Random(seed), real
        self.kills: Counter[str] = Counter()
        self.missed = 0  # strikes when there was nothing to strike: too early, or too late
        self.longest = 0.0  # seconds from the end of a run until nothing was left
        self.seconds: dict[str, float] = {}
        self.rounds = 0

    def home(self, name: str) -> Home:
        folder = self.root / name
        folder.mkdir()
        return Home(folder, self.real)

    def calm(self, kind: str) -> None:
        """One run undisturbed: how long it takes, and what it leaves."""
        home = self.home(f"calm-{kind}")
        home.set(seconds=0.2)
        began = time.monotonic()
        home.run(kind, *JOBS)
        self.seconds[kind] = time.monotonic() - began
        home.require_none_left()

    def round(self, kind: str, most: int) -> None:
        """Strike a run a few times, look after each, and let it end."""
        home = self.home(f"round-{self.rounds}")
        self.rounds += 1
        kept: dict[str, int] = {}
        for _ in range(min(most, self.chance.randint(1, IN_A_ROW))):
            home.set(seconds=0.2)
            process = home.start(kind, *JOBS)
            time.sleep(self.chance.uniform(0.0, self.seconds[kind]))
            victim = self.chance.choice(VICTIMS)
            if strike(victim, process, self.chance):
                self.kills[victim] += 1
            else:
                self.missed += 1
            process.wait(600)
            began = time.monotonic()
            wait_until(lambda: not home.left(), 60.0)
            self.longest = max(self.longest, time.monotonic() - began)
            process.communicate(timeout=600)
            require_whole(home.results)
            now = {key: path.stat().st_mtime_ns for key, path in artifacts(home.results).items()}
            assert kept.items() <= now.items(), "a finished artifact went, or was computed again"
            kept = now
        home.set(seconds=0.2)
        home.run(kind, *JOBS)
        home.require_none_left()
        assert payload(home.results) == payload(self.root / f"calm-{kind}" / "results")
        assert not list(home.results.glob("tmp/*"))

    def all(self, kills: int) -> None:
        while (done := sum(self.kills.values())) < kills:
            kind = KINDS[self.rounds % len(KINDS)]
            if kind not in self.seconds:
                self.calm(kind)
            self.round(kind, kills - done)
            print(f"{sum(self.kills.values())} of {kills}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--real", action="store_true")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        storm = Storm(Path(place), asked.seed, asked.real)
        storm.all(asked.kills)
    print(", ".join(f"{victim} {count}" for victim, count in sorted(storm.kills.items())))
    print(f"{storm.rounds} rounds, {storm.missed} strikes missed")
    print(f"nothing was left after {storm.longest:.1f} s at most, and nothing was lost")
