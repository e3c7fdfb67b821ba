"""Ctrl-C before a command has begun: the exit code of an interruption, one word, and no traceback of imports."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = "import wasp_cli.__main__ as program; program.main()"


@pytest.mark.parametrize("module", ["wasp_cli.cli.early", "torch._C"])
def test_it_ends_without_a_traceback(module: str, tmp_path: Path) -> None:
    """The signal comes when Python says that it has imported `module`; more is imported after each."""
    command = [sys.executable, "-P", "-X", "importtime", "-c", PROGRAM, "doctor"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path)
    sent, said = False, []
    assert process.stderr is not None
    for line in process.stderr:
        if not line.startswith("import time:"):
            said.append(line)
        elif not sent and line.split("|")[-1].strip() == module:
            process.send_signal(signal.SIGINT)
            sent = True
    process.communicate()
    assert sent
    assert (process.returncode, said) == (130, ["interrupted\n"])
