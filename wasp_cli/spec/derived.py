"""Specs that are made from another one: the ablation of a method, the check of the operators, a sweep.

A sweep is one spec, once for each value of one of its settings.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from wasp_cli.errors import UnknownName, UsageError
from wasp_cli.methods.registry import METHODS
from wasp_cli.spec.load import Loaded, Override, chain_of, load, loaded, override, path_of, value_of
from wasp_cli.spec.model import Spec, method_sections, preset_names
from wasp_cli.spec.names import assistant_variants, spec_name
from wasp_cli.spec.read import InvalidSpec, Problem, read
from wasp_cli.spec.shipped import spec_path
from wasp_cli.tasks.registry import TASKS

WHOLE, AS_PRINTED = "full", "as-printed"  # of the variants; and what `wasp ablate` calls the paper's WASP, which is a method of its own


def sized(preset: str | None, settings: Sequence[str] | None = None) -> list[str]:
    """Return settings as `--set` takes them, with a preset before them."""
    if preset is not None and preset not in preset_names():
        raise UnknownName("preset", preset, preset_names())
    return [*([] if preset is None else [f"preset={preset}"]), *(settings or ())]


def restricted(loaded: Loaded, tasks: Sequence[str] | None, methods: Sequence[str] | None = None) -> Loaded:
    """Return the spec with some of its tasks and methods only, in its own order; without names of either, with all of them."""
    update: dict[str, tuple[str, ...]] = {}
    for what, chosen, there in (("task", tasks, loaded.spec.tasks), ("method", methods, loaded.spec.methods)):
        for name in chosen or ():
            if name not in there:
                raise UnknownName(f"{what} of this spec", name, there)
        if chosen:
            update[f"{what}s"] = tuple(name for name in there if name in chosen)
    return replace(loaded, spec=loaded.spec.model_copy(update=update)) if update else loaded


def with_episodes(spec: Spec, episodes: int) -> Spec:
    evaluate = spec.stage("evaluate").model_copy(update={"episodes": episodes})
    return spec.model_copy(update={"episodes": episodes, "evaluate": evaluate})


def limited(loaded: Loaded, episodes: int | None) -> Loaded:
    """Return the spec with so many episodes in each cell at most (or as it is). These are the first ones of the whole cell."""
    if episodes is None:
        return loaded
    return replace(loaded, spec=with_episodes(loaded.spec, min(episodes, loaded.spec.episodes)))


def ablation(
    path: Path, variant: str, tasks: Sequence[str] | None = None, preset: str | None = None, settings: Sequence[str] = ()
) -> Loaded:
    """Return the spec at `path` with the method that has `variant`, run whole and as that variant, beside the operators alone."""
    known = [*assistant_variants(), AS_PRINTED]
    if variant not in known:
        raise UnknownName("assistant variant", variant, known)
    if variant == AS_PRINTED:
        narrowed = [f"name=ablate-{variant}", "methods=[human, wasp, printed]", f"variants=[{WHOLE}]"]
    else:
        # The whole method is in every ablation; for `full` itself, it is the method that can be ablated.
        method = next(info.name for info in METHODS.values() if variant in info.variants and len(info.variants) > 1)
        narrowed = [f"name=ablate-{variant}", f"methods=[human, {method}]", f"variants=[{', '.join(dict.fromkeys((WHOLE, variant)))}]"]
    if tasks:
        narrowed.append(f"tasks=[{', '.join(TASKS[task].name for task in tasks)}]")
    return load(path, [*narrowed, *sized(preset, settings)])


OPTION = "--vary"
EXAMPLE = "for example --vary diffusion.ratio=0.2,0.4,0.6"
UNIMPAIRED_REFERENCE = "human"  # runs beside the method whose setting varies: what that method adds is seen against it
CELLS = {
    "name": "a sweep names its own reports",
    "task": "name one with --task; without it every task of the spec has its rows",
    "tasks": "name one with --task; without it every task of the spec has its rows",
    "methods": "name them with --method; every method has its rows",
    "seeds": "list them in the spec: a row is the mean over all seeds",
    "operators": "list the severities in the spec: the table per operator has rows for each",
    "variants": "list them in the spec: each has its rows",
}
"""Settings that say which cells there are, and what to do instead of varying them."""


@dataclass(frozen=True)
class Point:
    text: str
    value: Any
    loaded: Loaded  # the spec with it, under a name of its own


@dataclass(frozen=True)
class Sweep:
    """A spec under several values of one setting."""

    name: str  # of the reports
    spec: str  # the name of the spec without any of the values
    key: str
    points: tuple[Point, ...]


def read_sweep(
    path: Path, vary: str, methods: Sequence[str] = (), settings: Sequence[str] = (), tasks: Sequence[str] | None = None
) -> Sweep:
    """Read and validate a spec file under every value of `vary`, which is a text `a.b=v1,v2`.

    Without `methods` the setting of a method runs this method and Human-only, and any other setting all that the spec lists.
    """
    options = values_of(vary)
    overrides = [override(number, text) for number, text in enumerate(settings, start=1)]
    chain = chain_of(read(spec_path(path)))
    specs: list[Loaded] = []
    problems: dict[Problem, None] = {}  # what is wrong with all values is said once
    for option in options:
        try:
            specs.append(loaded(chain, (*overrides, option)))
        except InvalidSpec as error:
            problems |= dict.fromkeys(error.problems)
    if problems:
        raise InvalidSpec(list(problems))
    key = ".".join(options[0].path)
    name = specs[0].spec.name
    points: list[Point] = []
    for option, valid in zip(options, specs, strict=True):
        text = shown(option.value)
        taken = [point.loaded.spec.name for point in points]
        # Not validated again: what is listed for other methods (`variants`) is no mistake here.
        update: dict[str, Any] = {"name": spec_name(name, f"{key}-{text}", taken)}
        if not methods and options[0].path[0] in method_sections():
            update["methods"] = tuple(dict.fromkeys((UNIMPAIRED_REFERENCE, options[0].path[0])))
        points.append(Point(text, option.value, restricted(replace(valid, spec=valid.spec.model_copy(update=update)), tasks, methods)))
    return Sweep(spec_name(name, f"sweep-{key}"), name, key, tuple(points))


def values_of(vary: str) -> list[Override]:
    key, equals, rest = vary.partition("=")
    path = path_of(key)
    if not equals or not all(path):
        raise UsageError(f"{OPTION}: '{vary}' is not of the form KEY=V1,V2,...", EXAMPLE)
    if path[0] in CELLS:
        raise UsageError(f"{OPTION}: '{path[0]}' decides which cells there are; a sweep compares the same ones", CELLS[path[0]])
    name = ".".join(path)
    values = value_of(f"[{rest}]", rest, OPTION)
    if not values or rest.rstrip().endswith(","):
        raise UsageError(f"{OPTION}: '{rest}' has an empty value", "write null where no value is meant")
    if len(values) < 2:
        raise UsageError(f"{OPTION}: '{vary}' has one value; a sweep compares at least two", EXAMPLE)
    texts = [json.dumps(value, sort_keys=True) for value in values]  # 1 and true are equal to Python
    for place, text in enumerate(texts):
        if text in texts[:place]:
            raise UsageError(f"{OPTION}: the value {text} stands there twice", "write each value once")
    return [Override(f"{name}={shown(value)}", path, value, OPTION) for value in values]


def shown(value: Any) -> str:
    """Return a value as people write it in a spec, on one line."""
    return value if isinstance(value, str) and value.isprintable() else json.dumps(value)
