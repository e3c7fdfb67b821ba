"""kill -9 at random instants of seven commands: python -m tests.faults.kill_storm [--kills N] [--seed S] [--commands NAME ...]

Every kill hits the command itself, one of its workers, or its whole group, at an instant drawn from the time that it takes undisturbed.
After each kill everything that was stored before is there, byte for byte; after a few of them the same command ends well, and what it
leaves is what an undisturbed one leaves. Commands begin in forks of one process that has imported everything, so that a kill hits their
work and not their imports. This process computes nothing itself: a library whose threads run does not survive a fork.
"""

import argparse
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from tests.faults.kill_rounds import COMMANDS, Command, prepare
from tests.run.harness import group_is_gone, wait_until

VICTIMS = ("the command", "a worker", "its group")
IN_A_ROW = 4
"""Kills at most before the command may end."""
LONGEST = 300.0
"""Seconds that an undisturbed command may take on a busy machine."""


def forked(task: Callable[[], object], log: Path, folder: Path) -> int:
    """Do something in a process of its own, in a group of its own; return its id."""
    sys.stdout.flush()
    child = os.fork()
    if child:
        with suppress(OSError):
            os.setpgid(child, child)
        return child
    code = 1
    try:
        os.setpgid(0, 0)
        os.chdir(folder)
        file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        for stream in (1, 2):
            os.dup2(file, stream)
        task()
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def ended(child: int, seconds: float = LONGEST) -> int:
    """Wait for a process; return its exit status, negative for a signal."""
    found: list[int] = []

    def over() -> bool:
        found[:] = os.waitpid(child, os.WNOHANG)
        return found[0] == child

    wait_until(over, seconds)
    return os.waitstatus_to_exitcode(found[1])


def children(parent: int) -> Iterator[int]:
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError, IndexError):
            line = (folder / "stat").read_text(encoding="utf-8").rpartition(")")[2].split()
            if int(line[1]) == parent and b"resource_tracker" not in (folder / "cmdline").read_bytes():
                yield int(folder.name)


def state_of(folder: Path) -> dict[str, tuple[int, int]]:
    """Time and size of every file."""
    found = {}
    for path in folder.rglob("*"):
        with suppress(OSError):
            status = path.lstat()
            found[str(path)] = (status.st_mtime_ns, status.st_size)
    return found


class Storm:
    """Kills, and what they hit."""

    def __init__(self, root: Path, seed: int) -> None:
        self.root, self.chance = root, random.Random(seed)
        self.kills: Counter[str] = Counter()
        """By command."""
        self.midway: Counter[str] = Counter()
        """Of these: it had changed a file by then, and was not over."""
        self.victims: Counter[str] = Counter()
        self.rounds: Counter[str] = Counter()
        self.seconds: dict[str, float] = {}

    def do(self, what: str, task: Callable[[], object], folder: Path) -> None:
        """Do something that has to end well."""
        log = self.root / "log.txt"
        log.unlink(missing_ok=True)
        code = ended(forked(task, log, folder))
        if code:
            raise SystemExit(f"{what} in {folder} ended with {code}:\n{log.read_text(errors='replace')[-6000:]}")

    def calm(self, command: Command) -> None:
        """Do it once undisturbed: how long it takes, and what it leaves."""
        folder = self.fresh(command, "calm")
        begun = time.monotonic()
        self.do(f"calm {command.name}", lambda: command.run(folder, 0), folder)
        self.seconds[command.name] = time.monotonic() - begun
        self.do(f"looking at calm {command.name}", lambda: command.judge(folder, folder), folder)

    def fresh(self, command: Command, name: str) -> Path:
        folder = self.root / f"{name}-{command.name}"
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(self.root / "base", folder)
        self.do(f"preparing {command.name}", lambda: command.arrange(folder), folder)
        return folder

    def round(self, command: Command, quota: int) -> None:
        """Kill a command a few times, look after each, and let it end."""
        folder = self.fresh(command, "round")
        for number in range(self.chance.randint(1, IN_A_ROW)):
            if self.kills[command.name] >= quota:
                break
            self.kill(command, folder, number)
            self.do(f"looking after a kill of {command.name}", lambda: command.look(folder), folder)
        self.do(f"resuming {command.name}", lambda: command.run(folder, IN_A_ROW), folder)
        self.do(f"looking after {command.name}", lambda: command.look(folder), folder)
        self.do(f"judging {command.name}", lambda: command.judge(folder, self.root / f"calm-{command.name}"), folder)
        self.rounds[command.name] += 1
        shutil.rmtree(folder)

    def kill(self, command: Command, folder: Path, number: int) -> None:
        before, log = state_of(folder), self.root / "killed.txt"
        child = forked(lambda: command.run(folder, number), log, folder)
        time.sleep(self.chance.uniform(0.0, self.seconds[command.name]))
        over, code = os.waitpid(child, os.WNOHANG)
        if over:  # faster than expected: no kill
            assert not code, log.read_text()
            return
        victim = self.chance.choice(VICTIMS)
        workers = list(children(child))
        if victim == "a worker" and not workers:
            victim = "the command"
        with suppress(ProcessLookupError):
            if victim == "a worker":
                os.kill(self.chance.choice(workers), signal.SIGKILL)
            else:
                (os.killpg if victim == "its group" else os.kill)(child, signal.SIGKILL)
        changed = state_of(folder) != before
        code = ended(child)
        if victim == "a worker":  # the command lives on without it
            assert code == 0, f"{command.name} did not survive a worker: {log.read_text(errors='replace')[-4000:]}"
        wait_until(lambda: group_is_gone(child))
        self.kills[command.name] += 1
        self.victims[victim] += 1
        self.midway[command.name] += changed

    def table(self) -> str:
        rows = [
            f"{name:8} {self.kills[name]:4} kills, {self.midway[name]:4} mid-way, {rounds:3} rounds" for name, rounds in self.rounds.items()
        ]
        total = f"{sum(self.kills.values())} kills, {sum(self.midway.values())} mid-way; victims: {dict(self.victims)}"
        return "\n".join([*rows, total])


def storm(kills: int, seed: int, root: Path, commands: Sequence[Command] = COMMANDS) -> Storm:
    """Kill until every command had its share of the kills; next is the one that is furthest behind."""
    made = Storm(root, seed)
    made.do("preparing", lambda: prepare(root / "base"), root)
    print("prepared", flush=True)
    weights = sum(command.weight for command in commands)
    quota = {command.name: max(1, round(kills * command.weight / weights)) for command in commands}
    while due := [command for command in commands if made.kills[command.name] < quota[command.name]]:
        command = min(due, key=lambda each: made.kills[each.name] / quota[each.name])
        if command.name not in made.seconds:
            made.calm(command)
            print(f"{command.name}: {made.seconds[command.name]:.1f} s undisturbed", flush=True)
        made.round(command, quota[command.name])
        print(f"{command.name}: {made.kills[command.name]} of {quota[command.name]}", flush=True)
    print(made.table(), flush=True)
    return made


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--commands", nargs="+", choices=[command.name for command in COMMANDS])
    asked = parser.parse_args()
    chosen = [command for command in COMMANDS if command.name in (asked.commands or [command.name])]
    with tempfile.TemporaryDirectory() as place:
        storm(asked.kills, asked.seed, Path(place), chosen)
    print("nothing was lost")
