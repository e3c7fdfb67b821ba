"""Environments that start a process, each in another way: a module of somebody's own, which tests
put beside docs/examples/puddle.py.

WASP_SIMULATORS is a folder: its name is in the command of every process, and its file `closed` has
a line for every environment that was closed.
"""

import ctypes
import itertools
import multiprocessing
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import gymnasium
from puddle import Puddle

FOLDER = Path(os.environ["WASP_SIMULATORS"])
COMMAND = ["tail", "-f", str(FOLDER / "simulated")]
DEAF = "import signal, time; signal.signal(15, signal.SIG_IGN); print(flush=True); time.sleep(1000)"
SILENT = {"stdin": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}


class Sim(Puddle):
    """A simulator in a process of its own, as most are: asked to end, and waited for."""

    def __init__(self):
        self.simulator = self.begun()

    def begun(self):
        return subprocess.Popen(COMMAND, stdout=subprocess.DEVNULL, **SILENT)

    def reset(self, **options):
        assert self.simulator.poll() is None, "the simulator is gone"
        return super().reset(**options)

    def close(self):
        with (FOLDER / "closed").open("a") as file:
            file.write(f"{os.getpid()}\n")
        self.end()

    def end(self):
        self.simulator.terminate()
        self.simulator.wait()


class Session(Sim):
    """In a session of its own."""

    def begun(self):
        return subprocess.Popen(
            COMMAND, stdout=subprocess.DEVNULL, start_new_session=True, **SILENT
        )


class Bare(Sim):
    """Without environment variables."""

    def begun(self):
        return subprocess.Popen(COMMAND, stdout=subprocess.DEVNULL, env={}, **SILENT)


class Shell(Sim):
    """As the child of a shell, which does not pass on what ends it."""

    def begun(self):
        command = ["sh", "-c", '"$@" & wait', "sh", *COMMAND]
        return subprocess.Popen(command, stdout=subprocess.DEVNULL, **SILENT)

    def end(self):
        """Leave it: nobody has thought of it."""


class Daemon(Shell):
    """As nobody's child."""

    def begun(self):
        command = ["sh", "-c", '("$@" &)', "sh", *COMMAND]
        subprocess.run(command, stdout=subprocess.DEVNULL, start_new_session=True, **SILENT)
        return subprocess.Popen(COMMAND, stdout=subprocess.DEVNULL, **SILENT)


class Deaf(Sim):
    """It does not listen to SIGTERM, and is waited for all the same."""

    def begun(self):
        process = subprocess.Popen(
            [sys.executable, "-c", DEAF, str(FOLDER)], stdout=subprocess.PIPE, **SILENT
        )
        process.stdout.readline()
        return process


class Raising(Sim):
    """Closing fails before anything has ended."""

    def end(self):
        raise OSError("the simulator does not answer")


class Native(Sim):
    """Closing hangs in native code that holds the interpreter's lock: in workers, and there not
    the first one, which is asked what it is.
    """

    numbers = itertools.count()

    def begun(self):
        self.number = next(self.numbers)
        return super().begun()

    def end(self):
        in_worker = "Loky" in multiprocessing.current_process().name
        if in_worker and self.number:
            ctypes.PyDLL(None).sleep(1000)
        super().end()


class Talking(Sim):
    """A thread that nobody ends."""

    def begun(self):
        threading.Thread(target=time.sleep, args=(1000,)).start()
        return super().begun()


for kind in (Sim, Session, Bare, Shell, Daemon, Deaf, Raising, Native, Talking):
    gymnasium.register(f"{kind.__name__}-v0", entry_point=kind, max_episode_steps=200)
