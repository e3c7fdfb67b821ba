"""A figure is there whole or not at all, whenever the process that draws it is killed."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

DRAW = """
import os, signal, sys
from pathlib import Path
from matplotlib.figure import Figure
from wasp_cli.report.figures import drawn, figure_files

real, left = Figure.savefig, int(sys.argv[2])

def killed(self, file, **options):
    global left
    if left == 0:
        (file if hasattr(file, "write") else open(file, "wb")).write(b"begun")
        os.kill(os.getpid(), signal.SIGKILL)
    left -= 1
    real(self, file, **options)

Figure.savefig = killed
with drawn((2, 2)) as figure:
    figure.subplots().plot([1, 2])
    figure_files(figure, Path(sys.argv[1]), "figure3")
"""


@pytest.mark.parametrize(("written", "there"), [(0, set()), (1, {"figure3.png"})])
def test_a_killed_report_leaves_no_half_drawn_figure(written: int, there: set[str], tmp_path: Path) -> None:
    root = Path(__file__).parents[3]
    done = subprocess.run(
        [sys.executable, "-c", DRAW, tmp_path, str(written)], env={**os.environ, "PYTHONPATH": str(root)}, timeout=600, check=False
    )
    assert done.returncode == -signal.SIGKILL
    assert {path.name for path in tmp_path.iterdir()} == there
    for path in tmp_path.glob("*.png"):
        assert path.read_bytes().startswith(b"\x89PNG")
        assert b"IEND" in path.read_bytes()[-12:]
