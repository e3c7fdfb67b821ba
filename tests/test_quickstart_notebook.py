"""docs/examples/quickstart.ipynb runs from its first cell to its last, in an empty folder."""

import os
import sys
from pathlib import Path

import pytest

from tests.commands import ROOT

NOTEBOOK = ROOT / "docs" / "examples" / "quickstart.ipynb"


def test_every_cell_runs_and_the_plot_and_the_frame_are_drawn(tmp_path, monkeypatch):
    nbformat = pytest.importorskip("nbformat")
    nbclient = pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    pytest.importorskip("pandas")
    programs = str(Path(sys.executable).parent)  # `wasp` of this environment
    monkeypatch.setenv("PATH", os.pathsep.join([programs, os.environ["PATH"]]))
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    monkeypatch.setenv("JUPYTER_RUNTIME_DIR", str(tmp_path / "runtime"))
    monkeypatch.delenv("MPLBACKEND", raising=False)  # Jupyter chooses its own
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    resources = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(
        notebook, timeout=900, kernel_name="python3", resources=resources
    ).execute()
    shown = [
        kind
        for cell in notebook.cells
        if cell.cell_type == "code"
        for output in cell.outputs
        for kind in output.get("data", {})
    ]
    assert shown.count("text/html") == 1  # the table
    assert shown.count("image/png") == 2
