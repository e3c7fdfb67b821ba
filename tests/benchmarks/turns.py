"""Scripts that measure once for every line that they read, of two checkouts by turns."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

HERE = Path(__file__).parents[2]


@contextmanager
def running(*commands: Sequence[object]) -> Iterator[list[subprocess.Popen[str]]]:
    """The scripts of this folder with their arguments, warm: what they say first is not counted."""
    processes = [
        subprocess.Popen(
            [sys.executable, *map(str, [HERE / "tests/benchmarks" / str(script), *arguments])],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
        )
        for script, *arguments in commands
    ]
    try:
        for process in processes:
            answer(process)
        yield processes
    finally:
        for process in processes:
            process.kill()
            process.communicate()


def answer(process: subprocess.Popen[str]) -> Any:
    return json.loads(process.stdout.readline())


def asked(process: subprocess.Popen[str]) -> Any:
    process.stdin.write("\n")
    process.stdin.flush()
    return answer(process)
