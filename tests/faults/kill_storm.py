"""kill -9 at random instants of commands: python -m tests.faults.kill_storm [--kills N] [--seed S]

Every kill hits the command itself, one of its workers, or its whole group, at an instant drawn from
the time that it takes undisturbed. After each kill everything that was stored before is there, byte
for byte; after a few of them the same command ends well, and what it leaves is what an undisturbed
one leaves. Commands begin in forks of one process that has imported everything, so that a kill hits
their work and not their imports. This process computes nothing itself: a library whose threads run
does not survive a fork.
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
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from tests.faults.kill_rounds import COMMANDS, Command, prepare
from tests.faults.test_random_kills import children, kill_all
from tests.run.harness import LED_BY, group_is_gone, wait_until

VICTIMS = ("the command", "a worker", "its group")
IN_A_ROW = 4  # kills at most before the command may end


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
        os.environ[LED_BY] = str(os.getpid())
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


def ended(child: int) -> int:
    """Wait for a process; return its exit status, negative for a signal."""
    status: list[int] = []

    def over() -> bool:
        status[:] = os.waitpid(child, os.WNOHANG)
        return status[0] == child

    wait_until(over)
    return os.waitstatus_to_exitcode(status[1])


class Storm:
    """Kills, and what they hit."""

    def __init__(self, root: Path, seed: int) -> None:
        self.root, self.chance = root, random.Random(seed)
        self.kills: Counter[str] = Counter()  # by command
        self.seconds: dict[str, float] = {}

    def do(self, what: str, task: Callable[[], object], folder: Path) -> None:
        """Do something that has to end well."""
        log = self.root / "log.txt"
        log.unlink(missing_ok=True)
        code = ended(forked(task, log, folder))
        if code:
            raise SystemExit(
                f"{what} in {folder} ended with {code}:\n{log.read_text(errors='replace')[-6000:]}"
            )

    def calm(self, command: Command) -> None:
        """Do it once undisturbed: how long it takes, and what it leaves."""
        folder = self.fresh(command, "calm")
        begun = time.monotonic()
        self.do(f"calm {command.name}", lambda: command.start(folder), folder)
        self.seconds[command.name] = time.monotonic() - begun
        self.do(f"looking at calm {command.name}", lambda: command.compare(folder, folder), folder)

    def fresh(self, command: Command, name: str) -> Path:
        folder = self.root / f"{name}-{command.name}"
        shutil.copytree(self.root / "base", folder)
        self.do(f"preparing {command.name}", lambda: command.arrange(folder), folder)
        return folder

    def round(self, command: Command, most: int) -> None:
        """Kill a command a few times, look after each, and let it end."""
        folder = self.fresh(command, "round")
        for _ in range(min(most, self.chance.randint(1, IN_A_ROW))):
            self.kill(command, folder)
            self.do(f"looking after a kill of {command.name}", lambda: command.look(folder), folder)
        self.do(f"resuming {command.name}", lambda: command.start(folder), folder)
        self.do(f"looking after {command.name}", lambda: command.look(folder), folder)
        self.do(
            f"judging {command.name}",
            lambda: command.compare(folder, self.root / f"calm-{command.name}"),
            folder,
        )
        shutil.rmtree(folder)

    def kill(self, command: Command, folder: Path) -> None:
        log = self.root / "killed.txt"
        child = forked(lambda: command.start(folder), log, folder)
        time.sleep(self.chance.uniform(0.0, self.seconds[command.name]))
        over, code = os.waitpid(child, os.WNOHANG)
        if over:  # faster than expected: no kill
            assert not code, log.read_text()
            return
        victim, workers = self.chance.choice(VICTIMS), children(child)
        with suppress(ProcessLookupError):
            if victim == "a worker" and workers:
                os.kill(self.chance.choice(workers), signal.SIGKILL)
            elif victim == "its group":
                kill_all(child, workers)
            else:
                os.kill(child, signal.SIGKILL)
        code = ended(child)
        if victim == "a worker" and workers:  # the command lives on without it
            assert code == 0, (
                f"{command.name} did not survive a worker: "
                f"{log.read_text(errors='replace')[-4000:]}"
            )
        wait_until(lambda: group_is_gone(child))
        self.kills[command.name] += 1


def storm(kills: int, seed: int, root: Path) -> None:
    """Kill each command until it has had its share of the kills."""
    made = Storm(root, seed)
    made.do("preparing", lambda: prepare(root / "base"), root)
    weights = sum(command.weight for command in COMMANDS)
    for command in COMMANDS:
        share = max(1, round(kills * command.weight / weights))
        made.calm(command)
        while made.kills[command.name] < share:
            made.round(command, share - made.kills[command.name])
        print(
            f"{command.name}: {share} kills, {made.seconds[command.name]:.1f} s undisturbed",
            flush=True,
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        storm(asked.kills, asked.seed, Path(place))
    print("nothing was lost")
