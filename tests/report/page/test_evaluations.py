"""What a report says of the evaluations behind it."""

from __future__ import annotations

from pathlib import Path

import pytest

from wasp_cli.report.page.evaluations import evaluations_of
from wasp_cli.store.artifact import commit, staging_folder
from wasp_cli.store.layout import Layout
from wasp_cli.store.tables import CellIdentity

KEYS = {CellIdentity("goal1", "wasp", "full", "noisy", 0.4, seed): f"{seed + 1:020x}"[::-1] for seed in range(3)}


@pytest.fixture
def layout(tmp_path: Path) -> Layout:
    """Two of three evaluations: one says by which version it was computed, one does not."""
    layout = Layout(tmp_path / "my results")
    layout.prepare()
    provenance = {"wasp": "0.1.0", "started_at": "2026-01-02T03:04:05+00:00"}
    for key, said in zip(KEYS.values(), ({"label": "goal1 s0 wasp noisy=0.4", "provenance": provenance}, {}), strict=False):
        staging = staging_folder(layout, key)
        staging.mkdir(parents=True, exist_ok=True)
        commit(layout, "evaluate", key, staging, {"kind": "evaluate", "key": key, **said})
    return layout


def test_each_has_its_date_its_version_and_commands_that_a_shell_reads(layout: Layout) -> None:
    first, second = evaluations_of(layout, KEYS, 9)
    assert (first.label, first.date) == ("goal1 s0 wasp noisy=0.4", "2026-01-02 03:04")
    assert first.version.startswith("wasp 0.1.0")
    place = f"--results '{layout.root}'"
    assert first.commands == tuple(f"wasp {name} {first.key[:8]} --episode 0 {place}" for name in ("explain", "replay"))
    assert (second.label, second.date, second.version) == (second.key, "", "not known")


def test_only_as_many_are_read_as_are_asked_for(layout: Layout) -> None:
    assert [each.key for each in evaluations_of(layout, KEYS, 1)] == [next(iter(KEYS.values()))]
