"""Write the pictures and pages of trained parts into the folder of a report, a folder for each part."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from wasp_cli.report.trained.artifacts import UNREADABLE, Trained
from wasp_cli.report.trained.contact_sheet import draw_contact_sheet
from wasp_cli.report.trained.images import draw_open_loop, draw_open_loop_film, draw_reconstructions
from wasp_cli.report.trained.pages import write_contents, write_open_loop, write_quality
from wasp_cli.report.trained.part_figures import (
    draw_cost_reliability,
    draw_horizon,
    draw_learning_curve,
    draw_value_reliability,
)
from wasp_cli.store.layout import Layout, slug

FOLDER = "trained"
"""Below the folder of a report."""
Draw = Callable[[Layout, Trained, Path], None]
"""Writes a file from an artifact, or nothing where that has nothing to show."""
EVIDENCE: dict[str, tuple[tuple[str, Draw], ...]] = {
    "expert": (("curve.png", draw_learning_curve),),
    "dataset": (("contents.md", write_contents), ("contact_sheet.png", draw_contact_sheet)),
    "diagnostics": (
        ("open_loop.md", write_open_loop),
        ("horizon.png", draw_horizon),
        ("reliability.png", draw_cost_reliability),
        ("reconstruction.png", draw_reconstructions),
        ("open_loop.png", draw_open_loop),
        ("open_loop.gif", draw_open_loop_film),
    ),
    "critics": (("critics.png", draw_value_reliability),),
    "ida_q": (("q.png", draw_value_reliability),),
    "denoiser": (("quality.md", write_quality),),
    "consistency": (("quality.md", write_quality),),
    "residual": (("curve.png", draw_learning_curve),),
}
"""By the kind of the artifact: the files and what writes each."""
KNOWN = frozenset(name for files in EVIDENCE.values() for name, _ in files)


def part_folder(artifact: Trained) -> str:
    """Name the folder of a part: task, seed, stage, and the beginning of its key."""
    return slug(f"{artifact.task} s{artifact.seed} {artifact.kind} {artifact.key[:8]}")


def write_evidence(layout: Layout, trained: Sequence[Trained], report: Path, tell: Callable[[str], None] = lambda text: None) -> list[Path]:
    """Write what there is to see of trained parts; those of an earlier report go.

    A file whose artifact is damaged is left out.

    Args:
        layout: the results folder.
        trained: the parts.
        report: folder of the report.
        tell: told which part is being drawn.

    Returns:
        The written files.
    """
    shown = {part_folder(artifact): artifact for artifact in trained if artifact.kind in EVIDENCE}
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
