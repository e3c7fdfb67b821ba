"""Write the pictures and pages of trained parts into the folder of a report, a folder for each part."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wasp_cli.report.figures.style import save
from wasp_cli.report.trained.artifacts import UNREADABLE, Trained, read_json
from wasp_cli.report.trained.figures import draw_horizon, draw_learning, draw_reliability, draw_value_reliability
from wasp_cli.report.trained.pictures import draw_contact_sheet, draw_open_loop, draw_open_loop_film, draw_reconstructions
from wasp_cli.report.trained.tables import contents_markdown, open_loop_markdown, quality_markdown
from wasp_cli.store.artifact import replace_file
from wasp_cli.store.layout import Layout, slug

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FOLDER = "trained"  # below the folder of a report
Draw = Callable[[Layout, Trained, Path], None]
"""Writes a file from an artifact, or nothing where that has nothing to show."""


def _figure(draw: Callable[[Layout, Sequence[Trained]], Figure | None]) -> Draw:
    def write(layout: Layout, artifact: Trained, path: Path) -> None:
        figure = draw(layout, [artifact])
        if figure is not None:
            save(figure, path)

    return write


def _page(render: Callable[[Any], str], source: str) -> Draw:
    return lambda layout, artifact, path: replace_file(path, render(read_json(layout, artifact, source)))


EVIDENCE: dict[str, tuple[tuple[str, Draw], ...]] = {
    "expert": (("curve.png", _figure(draw_learning)),),
    "dataset": (("contents.md", _page(contents_markdown, "contents.json")), ("contact_sheet.png", draw_contact_sheet)),
    "diagnostics": (
        ("open_loop.md", _page(open_loop_markdown, "diagnostics.json")),
        ("horizon.png", _figure(draw_horizon)),
        ("reliability.png", _figure(draw_reliability)),
        ("reconstruction.png", draw_reconstructions),
        ("open_loop.png", draw_open_loop),
        ("open_loop.gif", draw_open_loop_film),
    ),
    "critics": (("critics.png", _figure(draw_value_reliability)),),
    "ida_q": (("q.png", _figure(draw_value_reliability)),),
    "denoiser": (("quality.md", _page(quality_markdown, "quality.json")),),
    "consistency": (("quality.md", _page(quality_markdown, "quality.json")),),
    "residual": (("curve.png", _figure(draw_learning)),),
}
"""By the kind of the artifact: the files and what writes each."""
KNOWN = frozenset(name for files in EVIDENCE.values() for name, _ in files)


def write_evidence(layout: Layout, trained: Sequence[Trained], report: Path, tell: Callable[[str], None] = lambda text: None) -> list[Path]:
    """Write what there is to see of trained parts, and forget what an earlier report had; of a damaged artifact a file is left out."""
    # The folder of a part names task, seed, stage, and the beginning of its key.
    shown = {slug(f"{part.task} s{part.seed} {part.kind} {part.key[:8]}"): part for part in trained if part.kind in EVIDENCE}
    root = report / FOLDER
    written: list[Path] = []
    for name, artifact in shown.items():
        tell(name)
        folder = _own_folder(root, name)
        for file, draw in EVIDENCE[artifact.kind]:
            path = folder / file
            path.unlink(missing_ok=True)  # a link would lead elsewhere, and an old file would pass for a new one
            try:
                draw(layout, artifact, path)
            except UNREADABLE:
                path.unlink(missing_ok=True)
            if path.is_file():
                written.append(path)
    _forget(root, written)
    return written


def _own_folder(root: Path, name: str) -> Path:
    """Make a folder that is no link, nor below one."""
    for folder in (root, root / name):
        if folder.is_symlink() or folder.is_file():
            folder.unlink()
        folder.mkdir(exist_ok=True)
    return root / name


def _forget(root: Path, written: Sequence[Path]) -> None:
    """Remove the files of earlier reports, and folders that are empty then."""
    if root.is_symlink() or not root.is_dir():
        return
    for folder in root.iterdir():
        if folder.is_symlink() or not folder.is_dir():
            continue
        for path in folder.iterdir():
            if path.name in KNOWN and path not in written and not path.is_dir():
                path.unlink()
        if not any(folder.iterdir()):
            folder.rmdir()
