from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from wasp_cli.report.figures.by_axis import severity_figure
from wasp_cli.report.figures.methods import latency_figure
from wasp_cli.report.stats.frame import Frame, Wanted, read_frame


def test_same_numbers_same_bytes(frame: Frame, tmp_path: Path) -> None:
    written = []
    for name in ("a", "b"):
        folder = tmp_path / name
        folder.mkdir()
        files = [*severity_figure(frame, folder), *latency_figure(frame, folder)]
        assert [path.name for path in files] == ["severity.png", "severity.svg", "latency.png", "latency.svg"]
        written.append([path.read_bytes() for path in files])
    assert written[0] == written[1]


def test_every_operator_with_its_severities_and_every_method(frame: Frame, tmp_path: Path) -> None:
    severity = severity_figure(frame, tmp_path)[1].read_text(encoding="utf-8")
    for text in ("Noisy 0.2", "Noisy 0.6", "Laggy 0.5", "Laggy 0.85", "Goal1: Return", "Goal1: Cost", "Goal1: Int.", "Human-only", "WASP"):
        assert text in severity
    assert "Expert" not in severity  # it has no severity
    latency = latency_figure(frame, tmp_path)[1].read_text(encoding="utf-8")
    assert all(text in latency for text in ("Human-only", "IDA", "Diffusion", "SafeRL-Res", "WASP", "Expert"))


def test_one_condition_is_no_curve(grid: Callable[..., list[Wanted]], tmp_path: Path) -> None:
    one = [cell for cell in grid(seeds=(0,)) if cell.identity.operator == "noisy" and cell.identity.value == 0.2]
    assert severity_figure(read_frame(one), tmp_path) == []
    assert severity_figure(Frame(()), tmp_path) == latency_figure(Frame(()), tmp_path) == []
