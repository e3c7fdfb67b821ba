"""Empty figures, and the files of drawn ones: the same bytes with any settings of matplotlib.

Figures here do not depend on a user's matplotlibrc (also one in the working directory), on the
backend of a notebook or on `matplotlib.rcParams`, and they change none of these. pyplot is not
used.
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
    png = folder / f"{name}.png"
    svg = folder / f"{name}.svg"
    save(figure, png)
    # The layout is kept for the second file, since computing it takes as long as drawing.
    figure.set_layout_engine("none")
    _round_places(figure)
    save(figure, svg)
    return [png, svg]


def _round_places(figure: Figure) -> None:
    """Round the places of the panels: the layout differs in its last bits from process to process,
    and the names of clip paths in an SVG are digests of all bits.
    """
    for panel in figure.axes:
        left, bottom, width, height = panel.get_position().bounds
        panel.set_position((round(left, 9), round(bottom, 9), round(width, 9), round(height, 9)))


def save(figure: Figure, path: Path) -> None:
    """Write a figure, as a whole or not at all if the process is killed meanwhile."""
    drawing = BytesIO()
    dated = ("Software",) if path.suffix == ".png" else ("Date", "Creator")
    with _settings(LOOK):
        figure.savefig(drawing, format=path.suffix[1:], metadata=dict.fromkeys(dated))
    replace_file(path, drawing.getvalue())


@contextmanager
def _settings(look: Mapping[str, Any]) -> Iterator[None]:
    """Within the block, use matplotlib's own defaults and `look`; restore the settings after it."""
    matplotlib = load_matplotlib()
    with matplotlib.rc_context(), warnings.catch_warnings():
        warnings.simplefilter("ignore", matplotlib.MatplotlibDeprecationWarning)
        # A letter that the font lacks is a warning, even if warnings are turned into errors.
        warnings.simplefilter("default", UserWarning)
        matplotlib.rcParams.update(_defaults())
        matplotlib.rcParams.update(look)
        yield


@cache
def _defaults() -> dict[str, Any]:
    defaults = load_matplotlib().rcParamsDefault
    # The backend is the one setting that `rc_context` does not restore.
    return {name: defaults[name] for name in defaults if name != "backend"}


@cache
def load_matplotlib() -> Any:
    """Import matplotlib, whatever the user's settings are, and return it.

    Its messages about files and folders of the user are hidden, since none of them is used.

    Raises:
        DrawingError: it cannot be imported.
    """
    log = logging.getLogger("matplotlib")
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        return _imported()
    except (OSError, ValueError) as error:
        raise DrawingError(
            f"no figure can be drawn, since matplotlib cannot be imported: {described(error)}",
            "repair or remove 'matplotlibrc' in the working directory, and let MPLCONFIGDIR name a "
            "folder that can be written",
        ) from error
    finally:
        log.setLevel(level)


def _imported() -> Any:
    try:
        import matplotlib
    except (OSError, ValueError):
        # Jupyter and Colab set a backend from a package of their own; a matplotlibrc may have
        # another encoding, or not be readable.
        _forget("matplotlib")
        with _environment(MPLBACKEND=None, MATPLOTLIBRC=os.devnull):
            import matplotlib
    import matplotlib.backends.backend_agg
    import matplotlib.figure

    return matplotlib


def _forget(package: str) -> None:
    """Remove from `sys.modules` what a failed import has left there."""
    for name in list(sys.modules):
        if name == package or name.startswith(f"{package}."):
            del sys.modules[name]


@contextmanager
def _environment(**variables: str | None) -> Iterator[None]:
    """Within the block, set variables, or remove them for None; restore them after it."""
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
