"""Whatever a user has set, a figure of ours has the same bytes, and the user's settings stay."""

import hashlib
import os
import shutil
import sys
from pathlib import Path
from subprocess import run

import matplotlib
import pytest

from tests.commands import ROOT, python
from tests.report.golden_store import STORE
from wasp_cli.report.canvas import drawn, figure_files

INLINE = "module://matplotlib_inline.backend_inline"  # of Jupyter and Colab
OWN_STYLE = """
backend: TkAgg
font.size: 20
font.family: serif
mathtext.fontset: stix
text.usetex: True
figure.figsize: 3, 3
figure.facecolor: black
savefig.dpi: 44
savefig.format: pdf
savefig.bbox: tight
savefig.transparent: True
axes.facecolor: black
axes.grid: True
axes.prop_cycle: cycler('color', ['r', 'b'])
axes.formatter.use_locale: True
lines.linewidth: 7
path.sketch: 1, 100, 2
svg.fonttype: path
"""
DRAW = """
import hashlib, sys
from pathlib import Path
from wasp_cli.report.canvas import drawn, figure_files

with drawn((3, 2)) as figure:
    panel = figure.subplots()
    panel.plot([1, 2000.5], [1, 2], label="$x^2$")
    panel.legend()
    figure.suptitle(sys.argv[2])
    for path in figure_files(figure, Path(sys.argv[1]), "figure"):
        print(hashlib.sha256(path.read_bytes()).hexdigest())
"""
ABSENT_LETTERS = "\u65e5\u672c"  # in no font of matplotlib


def drawing(folder: Path, title: str = "title", **variables: str) -> list[str]:
    """Digests of a PNG and an SVG that a process with these variables draws in a folder."""
    folder.mkdir(exist_ok=True)
    done = run(
        [sys.executable, "-c", DRAW, folder, title],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT), **variables},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "atplotlib" not in done.stderr  # what it says of a user's files is not ours to show
    return done.stdout.split()


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    return drawing(tmp_path_factory.mktemp("plain"))


@pytest.mark.parametrize(
    "variables",
    [
        {"MPLBACKEND": INLINE},
        {"MPLBACKEND": "module://not.here"},
        {"MPLBACKEND": "nonsense"},
        {"PYTHONWARNINGS": "error"},
        {"PYTHONOPTIMIZE": "2"},
        {"HOME": "/nowhere/at/all"},
        {"TERM": "dumb", "COLUMNS": "20", "LC_ALL": "C"},
    ],
    ids=lambda variables: next(iter(variables)),
)
def test_variables_change_no_byte(
    variables: dict[str, str], plain: list[str], tmp_path: Path
) -> None:
    assert drawing(tmp_path, **variables) == plain


@pytest.mark.parametrize("place", ["the file", "its folder", "MPLCONFIGDIR", "working directory"])
def test_a_style_of_the_users_own_changes_no_byte(
    place: str, plain: list[str], tmp_path: Path
) -> None:
    own = tmp_path / ("here" if place == "working directory" else "own")
    own.mkdir()
    (own / "matplotlibrc").write_text(OWN_STYLE)
    variables = {
        "the file": {"MATPLOTLIBRC": str(own / "matplotlibrc")},
        "its folder": {"MATPLOTLIBRC": str(own)},
        "MPLCONFIGDIR": {"MPLCONFIGDIR": str(own)},
        "working directory": {},
    }
    assert drawing(tmp_path / "here", **variables[place]) == plain


@pytest.mark.parametrize("kind", ["latin-1", "a file"])
def test_settings_that_cannot_be_read_change_no_byte(
    kind: str, plain: list[str], tmp_path: Path
) -> None:
    (tmp_path / "matplotlibrc").write_bytes(b"# caf\xe9\nfont.size: 20\n")
    folder = tmp_path if kind == "latin-1" else tmp_path / "matplotlibrc"
    assert drawing(tmp_path / "here", MPLCONFIGDIR=str(folder)) == plain


def test_a_letter_that_no_font_has_is_no_error(tmp_path: Path) -> None:
    assert len(drawing(tmp_path, ABSENT_LETTERS, PYTHONWARNINGS="error::UserWarning")) == 2


def test_what_a_notebook_has_set_changes_nothing_and_is_there_afterwards(tmp_path: Path) -> None:
    def draw(name: str) -> list[bytes]:
        with drawn((3, 2)) as figure:
            figure.subplots().plot([1, 2000.5], [1, 2])
        return [path.read_bytes() for path in figure_files(figure, tmp_path, name)]

    plain = draw("plain")
    own = {"axes.facecolor": "black", "lines.linewidth": 9.0, "font.size": 30.0, "axes.grid": True}
    with matplotlib.rc_context(own):
        before = dict(matplotlib.rcParams.copy())
        assert draw("own") == plain
        assert dict(matplotlib.rcParams.copy()) == before


def test_pyplot_is_left_alone(tmp_path: Path) -> None:
    code = f"{DRAW}\nassert 'matplotlib.pyplot' not in sys.modules"
    assert python(tmp_path, "-c", code, str(tmp_path), "title").returncode == 0


SPEC = """
name: drawn
preset: smoke
task: puddle:Puddle-v0
methods: [human]
operators: {noisy: {moderate: 0.4}}
seeds: [0]
episodes: 2
"""


def test_a_task_that_draws_with_matplotlib_can_be_used_in_a_notebook(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    puddle = (ROOT / "docs" / "examples" / "puddle.py").read_text(encoding="utf-8")
    module = puddle + "\nimport matplotlib.pyplot\n"
    (tmp_path / "puddle.py").write_text(module, encoding="utf-8")
    (tmp_path / "drawn.yaml").write_text(SPEC, encoding="utf-8")
    monkeypatch.setenv("MPLBACKEND", INLINE)
    done = python(tmp_path, "-m", "wasp_cli", "check", "drawn.yaml")
    assert done.returncode == 0, done.stderr


def files(folder: Path) -> dict[str, str]:
    return {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest()
        for ending in ("png", "svg", "html", "md")
        for path in folder.rglob(f"*.{ending}")
    }


@pytest.mark.slow
def test_a_report_is_the_same_in_a_notebook_with_a_style_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    results = shutil.copytree(STORE, tmp_path / "results")
    report = ("-m", "wasp_cli", "report", str(results), "--out")
    python(tmp_path, *report, "plain", code=0)
    (tmp_path / "matplotlibrc").write_text(OWN_STYLE)
    monkeypatch.setenv("MPLBACKEND", INLINE)
    python(tmp_path, *report, "own", code=0)
    found = files(tmp_path / "plain")
    assert {"report.html", "cost_return.png", "learning.svg"} <= set(found)
    assert files(tmp_path / "own") == found


DRAW_FIGURE3 = """
import hashlib, sys
from pathlib import Path
from tests.report.golden_store import report_of
from wasp_cli.report.figures import necessity_figure

for path in necessity_figure(report_of(Path(sys.argv[1])).frame, Path(sys.argv[1])):
    print(hashlib.sha256(path.read_bytes()).hexdigest())
"""


@pytest.mark.slow
def test_every_process_writes_the_same_bytes(tmp_path: Path) -> None:
    results = shutil.copytree(STORE, tmp_path / "results")
    drawn = [python(tmp_path, "-c", DRAW_FIGURE3, str(results), code=0).stdout for _ in range(8)]
    assert len(set(drawn)) == 1
