"""Warnings about datasets whose costs are unusual."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

from wasp_cli.report.trained.artifacts import UNREADABLE, Trained, read_json
from wasp_cli.store.layout import Layout

ALL = "all"  # the row of a dataset's contents that has all behaviours
COSTLY_SHARE = (0.03, 0.15)
"""Shares of costly decision steps between which a dataset should be: with fewer a model does not
learn costs, with more it does not learn to drive well.
"""
Document = Mapping[str, Any]


def dataset_warnings(contents: Document) -> list[str]:
    """Return a sentence for each thing that is unusual about the costs of a dataset. Raises one of
    UNREADABLE if its contents have another form.
    """
    sources = contents[ALL]["sources"]
    share = contents[ALL]["costly_share"]
    if not sources:
        return []
    warnings = [f"no step costs by {kind}" for kind, part in sources.items() if part == 0.0]
    low, high = COSTLY_SHARE
    if not low <= share <= high:
        warnings.append(f"{share:.1%} of the steps cost, not {low:.0%} to {high:.0%}")
    return warnings


def with_warnings(layout: Layout, trained: Iterable[Trained]) -> tuple[Trained, ...]:
    """Return the artifacts; datasets with unusual costs have a `warning` in their summary."""

    def judged(artifact: Trained) -> Trained:
        if artifact.kind != "dataset":
            return artifact
        try:
            warnings = dataset_warnings(read_json(layout, artifact, "contents.json"))
        except UNREADABLE:
            return artifact
        if not warnings:
            return artifact
        return replace(artifact, summary={**artifact.summary, "warning": "; ".join(warnings)})

    return tuple(map(judged, trained))
