"""kill -9 at random instants, of a worker, of the parent, or of everything: nothing finished is
lost, nothing half is seen.
"""

import json
import os
import random
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

from tests.run.harness import ROOT, goes_on, group_is_gone, start, wait_until
from wasp_cli.store.artifact import file_digest

VICTIMS = ("a worker", "the parent", "everything")


def artifacts(results: Path) -> dict[str, Path]:
    return {
        path.name: path for path in results.glob("store/*/*") if (path / "_manifest.json").exists()
    }


def require_whole(results: Path) -> None:
    """Every artifact that is visible has each file that its manifest lists, byte for byte."""
    for place in results.glob("store/*/*"):
        files = json.loads((place / "_manifest.json").read_text(encoding="utf-8"))["files"]
        there = {
            path.relative_to(place).as_posix() for path in place.rglob("*") if path.is_file()
        } - {"_manifest.json"}
        assert there == files.keys()
        for name, known in files.items():
            assert file_digest(place / name) == known["sha256"]


def children(parent: int, of: bytes = b"") -> list[int]:
    """Child processes with this in their command; never loky's resource tracker, which computes
    no node.
    """
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError, IndexError):
            fields = (folder / "stat").read_text(encoding="utf-8").rpartition(")")[2].split()
            command = (folder / "cmdline").read_bytes()
            if int(fields[1]) == parent and b"resource_tracker" not in command and of in command:
                found.append(int(folder.name))
    return found


def kill_workers(workers: list[int]) -> None:
    """Kill each; the first one may take the others along."""
    for worker in workers:
        with suppress(ProcessLookupError):
            os.kill(worker, signal.SIGKILL)


def kill_all(group: int, workers: list[int]) -> None:
    """Kill a command with its group, and its workers, which are not in it."""
    kill_workers(workers)
    os.killpg(group, signal.SIGKILL)


def kill(victim: str, process: subprocess.Popen[str], chance: random.Random) -> bool:
    """Kill; whether the run itself is dead then."""
    with suppress(ProcessLookupError):
        if victim == "a worker":
            if workers := children(process.pid, b"loky"):
                os.kill(chance.choice(workers), signal.SIGKILL)
            return False
        if victim == "everything":
            kill_all(process.pid, children(process.pid, b"loky"))
        else:
            process.kill()
    return True


def storm(
    command: list[str | Path], results: Path, kills: int, longest: float, chance: random.Random
) -> tuple[dict[str, int], int]:
    """Start a run again and again and kill it, until it was killed so often; how often each
    victim died, and how many runs there were.
    """
    counts, runs = dict.fromkeys(VICTIMS, 0), 0
    kept: dict[str, int] = {}
    while sum(counts.values()) < kills:
        process = start(*command)
        runs += 1
        dead = False
        while not dead and process.poll() is None and sum(counts.values()) < kills:
            time.sleep(chance.uniform(0.02, longest))
            if process.poll() is None:
                victim = VICTIMS[sum(counts.values()) % len(VICTIMS)]
                dead = kill(victim, process, chance)
                counts[victim] += 1
        process.kill()
        process.communicate(timeout=600)
        wait_until(lambda: group_is_gone(process.pid))  # noqa: B023  (called at once)
        require_whole(results)
        now = {key: path.stat().st_mtime_ns for key, path in artifacts(results).items()}
        assert kept.items() <= now.items(), "a finished artifact went, or was computed again"
        kept = now
    return counts, runs


@pytest.mark.parametrize(
    ("kills", "seed", "tasks"),
    [(4, 1, "[goal1]"), pytest.param(50, 100, "[goal1, race1, formula1]", marks=pytest.mark.slow)],
)
def test_kills_at_random_instants(kills, seed, tasks, fakes, small_spec, results):
    small_spec.write_text(
        small_spec.read_text(encoding="utf-8").replace("[goal1]", tasks), encoding="utf-8"
    )
    fakes.set(seconds=0.15)
    counts, runs = storm(
        ["run", small_spec, "--results", results, "-j", "2"],
        results,
        kills,
        1.2,
        random.Random(seed),
    )
    assert sum(counts.values()) == kills
    assert runs > 1
    assert goes_on(fakes, small_spec, results) == 0 or not list(results.glob("tmp/*"))


def payload(results: Path) -> dict[str, str]:
    """Digest of every file of a store whose bytes are a function of its key."""
    return {
        path.relative_to(results / "store").as_posix(): file_digest(path)
        for path in sorted((results / "store").rglob("*"))
        if path.is_file() and path.name not in {"_manifest.json", "episodes.parquet", "_steps.pq"}
    }


@pytest.mark.slow
def test_a_storm_over_other_commands_loses_nothing():
    """See `kill_storm`. WASP_KILLS says how many kills, WASP_KILLS_SEED which."""
    options = (
        "--kills",
        os.environ.get("WASP_KILLS", "120"),
        "--seed",
        os.environ.get("WASP_KILLS_SEED", "1"),
    )
    # A process of its own: it forks, which one that has computed with threads must not.
    command = [sys.executable, "-m", "tests.faults.kill_storm", *options]
    done = subprocess.run(
        command,
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.endswith("nothing was lost\n")
