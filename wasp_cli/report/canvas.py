"""Empty figures, and the files of drawn ones: the same bytes whatever matplotlib is set to.

A user's matplotlibrc (also one in the working directory), the backend of a notebook and what a
program has set in `matplotlib.rcParams` change no figure of ours, and ours change none of them.
pyplot is not used.
"""

from __future__ import annotations

import logging
import os
import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wasp_cli.errors import DrawingError, described
from wasp_cli.store.records import replace_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ENDINGS = ("png", "svg")
LOOK: dict[str, Any] = {  # settings of matplotlib for every figure
    "font.size": 9,
    "svg.hashsalt": "wasp",
    "svg.fonttype": "none",
    "axes.spines.top": False,
    "axes.spines.right": False,
}


@contextmanager
def drawn(
    size: tuple[float, float], look: Mapping[str, Any] = LOOK, dpi: float = 160
) -> Iterator[Figure]:
    """Yield an empty figure of `size` (inches), to be filled inside the block, where matplotlib's
    own defaults and `look` are in force.
    """
    load_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with _settings(look):
        figure = Figure(figsize=size, layout="constrained", dpi=dpi)
        FigureCanvasAgg(figure)
        yield figure


def figure_files(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write a figure as `name.png` and `name.svg`. Without dates and versions, the same numbers
    give the same bytes.
    """
    png, svg = (folder / f"{name}.{ending}" for ending in ENDINGS)
    save(figure, png)
    # what has been laid out stays where it is: doing it again takes as long as drawing
    figure.set_layout_engine("none")
    _round_places(figure)
    save(figure, svg)
    return [png, svg]


def _round_places(figure: Figure) -> None:
    """Round where the panels are: the solver of the layout differs in the last bits from process
    to process, and the names of clip paths in an SVG are digests of all bits.
    """
    for panel in figure.axes:
        left, bottom, width, height = panel.get_position().bounds
        panel.set_position((round(left, 9), round(bottom, 9), round(width, 9), round(height, 9)))


def save(figure: Figure, path: Path) -> None:
    """Write a figure: whole, or not at all where the process is killed meanwhile."""
    drawing = BytesIO()
    dated = ("Software",) if path.suffix == ".png" else ("Date", "Creator")
    with _settings(LOOK):
        figure.savefig(drawing, format=path.suffix[1:], metadata=dict.fromkeys(dated))
    replace_file(path, drawing.getvalue())


@contextmanager
def _settings(look: Mapping[str, Any]) -> Iterator[None]:
    """Put matplotlib's own defaults and `look` in force, and afterwards what was before."""
    matplotlib = load_matplotlib()
    with matplotlib.rc_context(), warnings.catch_warnings():
        warnings.simplefilter("ignore", matplotlib.MatplotlibDeprecationWarning)
        # a letter that the font lacks is told, and is no error where somebody asks for errors
        warnings.simplefilter("default", UserWarning)
        matplotlib.rcParams.update(_defaults())
        matplotlib.rcParams.update(look)
        yield


@cache
def _defaults() -> dict[str, Any]:
    defaults = load_matplotlib().rcParamsDefault
    # The backend is the one setting that `rc_context` does not put back.
    return {name: defaults[name] for name in defaults if name != "backend"}


@cache
def load_matplotlib() -> Any:
    """Import matplotlib, whatever the user has set, and return it.

    What it says of files and folders of the user is not shown: none of them is used. Raises
    DrawingError where it cannot be imported.
    """
    log = logging.getLogger("matplotlib")
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        return _imported()
    except (OSError, ValueError) as error:
        raise DrawingError(
            f"no figure can be drawn, since matplotlib does not begin: {described(error)}",
            "repair or remove 'matplotlibrc' in the working directory, and let MPLCONFIGDIR name a "
            "folder that can be written",
        ) from error
    finally:
        log.setLevel(level)


def _imported() -> Any:
    try:
        import matplotlib
    except (OSError, ValueError):
        # Jupyter and Colab name a backend that is a package of theirs; a matplotlibrc may be of
        # another encoding, or not be for us to read.
        _forget("matplotlib")
        with _environment(MPLBACKEND=None, MATPLOTLIBRC=os.devnull):
            import matplotlib
    import matplotlib.backends.backend_agg
    import matplotlib.figure

    return matplotlib


def _forget(package: str) -> None:
    """Take out of `sys.modules` what an import that failed has left there."""
    for name in list(sys.modules):
        if name == package or name.startswith(f"{package}."):
            del sys.modules[name]


@contextmanager
def _environment(**variables: str | None) -> Iterator[None]:
    """Set variables, or with None remove them, and put back afterwards what was there."""
    before = {name: os.environ.get(name) for name in variables}
    _set(variables)
    try:
        yield
    finally:
        _set(before)


def _set(variables: Mapping[str, str | None]) -> None:
    for name, value in variables.items():
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value
