"""What a timeline draws: each gate's curve against its threshold, what was done, what it cost."""

import re
from pathlib import Path

import numpy as np

from tests.report.explained import Invented
from wasp_cli.metrics.episode import GATE_METHOD, GATE_SAFETY, GATE_TASK
from wasp_cli.report.explain.episode import CURVE, Episode, timeline
from wasp_cli.report.render import rendered
from wasp_cli.store.tables import Thresholds


def lanes(episode: Episode) -> dict[str, str]:
    drawn = rendered("timeline.html", lanes=timeline(episode), decisions=episode.decisions)
    return dict(re.findall(r'<div class="lane"><span>(.*?)</span>(<svg.*?</svg>)</div>', drawn))


def marks(svg: str) -> list[tuple[str, int, int]]:
    return [(kind, int(x), int(width)) for kind, x, width in re.findall(r'<rect class="(\w+)" x="(\d+)" y="0" width="(\d+)"', svg)]


def heights(svg: str) -> list[tuple[float, float]]:
    """Of every decision with a value: its place and its height from above."""
    found = [points.split() for points in re.findall(r'points="(.*?)"', svg)]
    return [(float(point.split(",")[0]), float(point.split(",")[1])) for line in found for point in line[::2]]


def test_gates_interventions_and_costs(tmp_path: Path) -> None:
    it = Invented()
    it.fire(2, GATE_SAFETY)
    it.fire(3, GATE_SAFETY)
    it.fire(5, GATE_TASK)
    it.pay(0, 6, 7)
    drawn = lanes(it.read(tmp_path))
    assert list(drawn) == ["Ḡᶜ", "ΔG", "acts", "cost"]
    assert marks(drawn["acts"]) == [("safety", 2, 2), ("task", 5, 1)]
    assert marks(drawn["cost"]) == [("cost", 0, 1), ("cost", 6, 2)]
    assert all('viewBox="0 0 8 ' in svg and svg.count('class="cursor"') == 1 for svg in drawn.values())


def test_a_curve_is_above_its_threshold_exactly_where_the_gate_fired(tmp_path: Path) -> None:
    it = Invented()
    it.fire(4, GATE_SAFETY)
    svg = lanes(it.read(tmp_path))["Ḡᶜ"]
    (limit,) = re.findall(r'class="limit" x1="0" x2="8" y1="([\d.]+)"', svg)
    assert [t for t, y in heights(svg) if y < float(limit)] == [4]
    assert all(0 <= y <= CURVE for _, y in heights(svg))


def test_other_methods_show_their_own_signal(tmp_path: Path) -> None:
    it = Invented(method="ida", thresholds=Thresholds(tau_q=0.1), config={"vote": 0.5})
    it.signal = np.linspace(-1, 1, it.steps)
    it.gate[6:] = GATE_METHOD
    it.a[6:] += 0.25
    drawn = lanes(it.read(tmp_path))
    assert list(drawn) == ["vote", "acts", "cost"]
    assert marks(drawn["acts"]) == [("method", 6, 2)]
    (limit,) = re.findall(r'class="limit" x1="0" x2="8" y1="([\d.]+)"', drawn["vote"])
    # It takes over above a share of the votes; tau_Q is the margin of each vote.
    assert [t for t, y in heights(drawn["vote"]) if y < float(limit)] == [6, 7]
