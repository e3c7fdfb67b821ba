"""Which settings are sizes, and which of them a preset replaces in a spec that has another preset.

Sizes belong together: a preset that is named over a spec (by `--preset`, `--set preset=...` or a
file that extends it) replaces all of them, also those that the spec sets for one task.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping
from functools import cache
from typing import Any, NamedTuple

from wasp_cli.spec.model import Spec
from wasp_cli.spec.presets import PRESETS, preset_values

Document = Mapping[str, Any]
Path = tuple[str, ...]  # the names on the way to a value

BY_TASK = "by_task"
NO_SIZES = frozenset({"quantile", "vote", "return_share"})
"""Operating points and thresholds of quality, which are no sizes. `smoke` and `quick` set some of
them; only these presets replace what a spec says there.
"""
OUT_OF_REACH: Mapping[str, frozenset[Path]] = {
    "smoke": frozenset({("expert", "bars")}),
    "quick": frozenset({("expert", "bars")}),
}
"""Settings that are removed under a preset, since its training does not reach them and would be
extended (`expert.extension`).
"""
SHOWN = 6


class Resized(NamedTuple):
    """A document without the settings that a preset replaces, and these settings."""

    document: dict[str, Any]  # without what the preset replaces
    replaced: dict[Path, Any]  # what that was


def resized(document: Document, preset: str) -> Resized:
    """Take out of a document the settings that a preset replaces. Nothing is taken if the document
    has this preset already, or there is no preset of this name.
    """
    if preset not in PRESETS or preset == document.get("preset", "cpu"):
        return Resized(dict(document), {})
    names = replaced_by(preset)
    replaced: dict[Path, Any] = {}
    rest = _without(document, names, (), replaced)
    tasks = document.get(BY_TASK)
    if isinstance(tasks, Mapping):
        by_task = dict(tasks)
        for task, sections in tasks.items():
            if isinstance(sections, Mapping):
                by_task[task] = _without(sections, names, (BY_TASK, task), replaced)
        rest[BY_TASK] = by_task
    return Resized(rest, replaced)


def _without(
    sections: Document, names: Collection[Path], above: Path, removed: dict[Path, Any]
) -> dict[str, Any]:
    """Sections without the named settings, which are put into `removed` by their places below
    `above`.
    """

    def rest_of(part: Document, place: Path) -> dict[str, Any]:
        rest: dict[str, Any] = {}
        for name, value in part.items():
            here = (*place, name)
            if here in names:
                removed[(*above, *here)] = value
            elif isinstance(value, Mapping):
                rest[name] = rest_of(value, here)
            else:
                rest[name] = value
        return rest

    return rest_of(sections, ())


@cache
def replaced_by(preset: str) -> frozenset[Path]:
    """Return the places of the settings that a preset replaces: all sizes, and what it sets
    besides.
    """
    sizes = {
        place
        for name in PRESETS
        for place in _places(preset_values(name))
        if place[-1] not in NO_SIZES
    }
    return frozenset(sizes) | set(_places(preset_values(preset))) | OUT_OF_REACH.get(preset, set())


def _places(document: Document, above: Path = ()) -> Iterator[Path]:
    for name, value in document.items():
        if isinstance(value, Mapping):
            yield from _places(value, (*above, name))
        else:
            yield (*above, name)


def told(spec: Spec, replaced: Mapping[Path, Any], sections: Collection[str]) -> str | None:
    """Return a line that names the sizes which the preset of a spec has replaced; None if nothing
    has changed for its tasks.

    Args:
        replaced: what the files had, by place.
        sections: the stages and methods that the spec asks for; others are not named.
    """
    changes = []
    for place, before in replaced.items():
        task = None
        name, *fields = place
        if place[0] == BY_TASK:
            task = place[1]
            name, *fields = place[2:]
        if (task is not None and task not in spec.tasks) or (fields and name not in sections):
            continue
        now = _value(spec, name, fields, task)
        if now != before:
            where = "" if task is None else f"{task}: "
            changes.append(f"{where}{'.'.join((name, *fields))} {_change(before, now)}")
    if not changes:
        return None
    more = f" and {len(changes) - SHOWN} more" if len(changes) > SHOWN else ""
    return f"preset {spec.preset} replaces sizes of the spec: {', '.join(changes[:SHOWN])}{more}"


def _value(spec: Spec, name: str, fields: Collection[str], task: str | None) -> Any:
    if not fields:
        return getattr(spec, name)
    value: Any = spec.stage(name, task).model_dump(mode="json")
    for part in fields:
        value = value[part]
    return value


def _change(before: Any, now: Any) -> str:
    if isinstance(before, Mapping):
        return "-> none"
    return f"{json.dumps(before)} -> {json.dumps(now)}"
