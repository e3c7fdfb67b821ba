"""Which assistants a results folder has, and which one a text means; no model is loaded here.

    stored = the_assistant(Layout(Path("results")), "goal1 s1 wasp")
    stored = the_assistant(layout, "goal1 s1 wasp/no-case2 tau_c=0.5")

An assistant is a method with its settings, and the trained parts that it reads. Manifests alone say
so: those of cells (of whatever operator, which changes nothing in the assistant), or where there is
no cell, those of its operating point and its calibration. No run and no plan is needed.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from wasp_cli.cells.words import KnownWords, Words, fits, read_words
from wasp_cli.errors import ArtifactError, StoreError, UnknownName, UsageError, WaspError, first
from wasp_cli.methods.registry import METHODS
from wasp_cli.plan.grid import ALONE, CALIBRATED_VARIANT, OPERATING, OPERATOR_CLONE
from wasp_cli.report.node import upstream_of
from wasp_cli.spec.shipped import published_folder
from wasp_cli.store.artifact import exists, stored_keys
from wasp_cli.store.find import KIND
from wasp_cli.store.layout import Layout, is_key
from wasp_cli.store.named import LEAST, SHOWN
from wasp_cli.store.published import BEHIND, manifest_of
from wasp_cli.store.severities import SEVERITY, severity_of

CALIBRATION = "calibration"
NOT_ITS_OWN = (OPERATOR_CLONE, ALONE, "heldout", SEVERITY)
"""What a cell, an operating point or a calibration reads, and an assistant does not: the clone of a
person who drives, held-out episodes, and the severity of the operator.
"""
_PREFIX = re.compile(rf"[0-9a-f]{{{LEAST},64}}")


@dataclass(frozen=True)
class Source:
    """A stored node that says how an assistant is built."""

    kind: str  # evaluate, operating or calibration
    key: str
    label: str  # as `wasp run` prints it
    seed: int  # of its worlds; the training may have another one
    operator: str | None  # None: of no cell
    value: float | None
    date: str


@dataclass(frozen=True)
class StoredAssistant:
    """A method with its settings, and what it reads by the name under which it reads it."""

    task: str
    seed: int  # of the training
    method: str
    settings: Mapping[str, Any]  # the method's resolved configuration
    inputs: Mapping[str, tuple[str, str]]  # kind and key
    shared: Mapping[str, Any]  # the spec's settings that its cells have: `action_repeat`, `returns`
    published: bool  # whether it comes from the published layer
    sources: tuple[Source, ...] = field(default=(), compare=False)

    @property
    def variant(self) -> str:
        """The ablation; `full` for the whole method."""
        return str(self.settings.get("variant", CALIBRATED_VARIANT))

    @property
    def label(self) -> str:
        """Task, training seed and method, as `load_assistant` takes them."""
        who = self.method if self.variant == CALIBRATED_VARIANT else f"{self.method}/{self.variant}"
        return f"{self.task} s{self.seed} {who}"

    @property
    def cells(self) -> int:
        """How many cells it was evaluated in."""
        return sum(source.kind == KIND for source in self.sources)

    @property
    def identity(self) -> str:
        """What tells it apart from all others."""
        parts = (self.task, self.seed, self.method, self.settings, self.inputs, self.shared)
        return json.dumps(parts, sort_keys=True)

    def folders(self, layout: Layout) -> tuple[dict[str, Path], list[tuple[str, str]]]:
        """Find the folders of what it reads, by name, in a store or else in the published layer;
        and kind and key of what is in neither.
        """
        found: dict[str, Path] = {}
        missing: list[tuple[str, str]] = []
        for name, (kind, key) in self.inputs.items():
            place = _place(layout, kind, key)
            if place is None:
                missing.append((kind, key))
            else:
                found[name] = place.artifact(kind, key)
        return found, missing


def the_assistant(layout: Layout, text: str | None) -> StoredAssistant:
    """Return the one assistant that a text means; None: the only one of the folder.

    Args:
        layout: of a results folder, of a published one, or of any folder with a `store`.
        text: task, seed and method in any order (`goal1 s1 wasp`), the method with its ablation
            (`wasp/no-case2`), settings of the method (`tau_c=0.5`), the label of a cell, or the
            beginning of its key. A part of which there is only one may be left out.

    Raises:
        StoreError: there is no such folder, or nothing is stored in it.
        UnknownName: a word names no task, method or setting.
        UsageError: there is no such assistant, or there are several.
        ArtifactError: what it reads is not there.
    """
    stored = stored_assistants(layout)
    if not stored:
        what = (
            "no such folder" if not layout.root.is_dir() else "nothing in it says how one is built"
        )
        raise StoreError(
            f"no assistant in '{layout.root}': {what}",
            "wasp run SPEC --results DIR trains and evaluates assistants there",
        )
    meant = stored if text is None else _meant(layout, stored, text)
    whole = [one for one in meant if not one.folders(layout)[1]]
    if not whole:
        raise _not_there(layout, meant)
    # What was evaluated is what results are of.
    whole = [one for one in whole if one.cells] or whole
    if len(whole) > 1:
        raise _several(layout, whole, text)
    return whole[0]


def stored_assistants(layout: Layout) -> list[StoredAssistant]:
    """Return every assistant of a store, also those whose parts are not all there; each once."""
    found: dict[str, StoredAssistant] = {}
    seeds: dict[tuple[str, str], int] = {}  # of trainings, by world model
    built: set[tuple[str, str]] = set()  # the points and calibrations that are in an assistant
    for kind in (KIND, OPERATING, CALIBRATION):
        for key in sorted(filter(is_key, stored_keys(layout, kind))):
            if (kind, key) in built:
                continue
            # what is damaged, or of a plugin that is not installed, is none that can be loaded
            with suppress(ArtifactError, UnknownName, LookupError, TypeError, ValueError):
                one = _read(layout, kind, key)
                world_model = one.inputs["world_model"]
                if world_model not in seeds:
                    seeds[world_model] = _seed_of(layout, *world_model, otherwise=one.seed)
                one = replace(one, seed=seeds[world_model])
                if kind != KIND and not METHODS[one.method].intervenes:
                    continue  # how the operators alone drove, with whom others are compared
                identity = one.identity
                before = found[identity].sources if identity in found else ()
                found[identity] = replace(one, sources=(*before, *one.sources))
                built |= set(one.inputs.values())
    return list(found.values())


def _read(layout: Layout, kind: str, key: str) -> StoredAssistant:
    """One assistant from one manifest; a LookupError, TypeError or ValueError where that is of
    another form.
    """
    manifest = manifest_of(layout, kind, key)
    axes = manifest["axes"]
    settings = manifest["settings"]
    method = axes["method"]
    config = dict(axes["method_config"])
    task = str(manifest["task"])
    inputs = upstream_of(manifest)
    if kind != KIND:
        inputs[kind] = (kind, key)
    inputs = {name: one for name, one in inputs.items() if name not in NOT_ITS_OWN}
    value = severity_of(manifest) if "value" in axes else None
    started_at = manifest.get("provenance", {}).get("started_at") or ""
    source = Source(
        kind,
        key,
        str(manifest.get("label", "")),
        int(manifest["seed"]),
        axes.get("operator"),
        value,
        str(started_at)[:16].replace("T", " "),
    )
    # which a folder of models alone has too
    names = ("action_repeat", "returns", "environment")
    return StoredAssistant(
        task,
        source.seed,
        str(method),
        config,
        inputs,
        {name: settings[name] for name in names if name in settings},
        BEHIND in manifest,
        (source,),
    )


def _seed_of(layout: Layout, kind: str, key: str, otherwise: int) -> int:
    """The seed of a training; that of the cell where its model is not there."""
    with suppress(WaspError, LookupError, TypeError, ValueError):
        return int(manifest_of(layout, kind, key)["seed"])
    return otherwise


def _place(layout: Layout, kind: str, key: str) -> Layout | None:
    if exists(layout, kind, key):
        return layout
    # A run copies published rows, and leaves the models where they are.
    with suppress(WaspError, OSError):
        published = published_folder()
        if published is not None and exists(Layout(published), kind, key):
            return Layout(published)
    return None


# -- what a text means -----------------------------------------------------------------------------


def _meant(layout: Layout, stored: list[StoredAssistant], text: str) -> list[StoredAssistant]:
    if _PREFIX.fullmatch(text.strip().lower()):
        prefix = text.strip().lower()
        by_key = [
            one for one in stored if any(source.key.startswith(prefix) for source in one.sources)
        ]
        if by_key:
            return by_key
    known = KnownWords(
        tasks={one.task for one in stored},
        methods={one.method for one in stored},
        settings={name for one in stored for name in one.settings},
    )
    words = read_words(text, known, layout.root)
    fitting = [one for one in stored if _fits(one, words)]
    meant = fitting
    if words.seeds:
        # Labels have the seed of a cell's worlds, which is that of the training unless the spec
        # says otherwise: what a label names comes first.
        by_label = [
            one
            for one in fitting
            if any(source.seed in words.seeds for source in _asked_cells(one, words))
        ]
        meant = by_label or [one for one in fitting if one.seed in words.seeds]
    if not meant:
        raise _none(layout, stored, words, text)
    return words.whole_first(meant, [one.variant for one in meant])


def _fits(one: StoredAssistant, words: Words) -> bool:
    """Whether an assistant is as words ask for it, whatever seed they have."""
    return (
        words.fit_assistant(one.task, one.method, one.variant)
        and words.fit_settings(one.settings)
        and bool(_asked_cells(one, words))
    )


def _asked_cells(one: StoredAssistant, words: Words) -> list[Source]:
    """The cells of an assistant, or what else it is known from, whose operator is asked for."""
    return [source for source in one.sources if words.fit_operator(source.operator, source.value)]


# -- what is said where there is not exactly one ---------------------------------------------------


def _none(layout: Layout, stored: list[StoredAssistant], words: Words, text: str) -> UsageError:
    near = [
        one for one in stored if fits(one.task, words.tasks) and fits(one.method, words.methods)
    ]
    near = near or [one for one in stored if one.task in words.tasks] or stored
    labels = sorted({one.label for one in near})
    lines = [
        f"'{layout.root}' has no assistant '{text}'; it has:",
        *first([f"  {label}" for label in labels], SHOWN),
    ]
    conditions = [
        *(f"task={task}" for task in sorted(words.tasks)),
        *(f"seed={seed}" for seed in sorted(words.seeds)),
        *(f"method={method}" for method in sorted(words.methods)),
        *(f"variant={variant}" for variant in sorted(words.variants)),
    ]
    select = f" --select '{','.join(conditions)}'" if conditions else ""
    return UsageError(
        "\n".join(lines), f"wasp run SPEC{select} --results {layout.root} makes what a spec has"
    )


def _several(layout: Layout, meant: Sequence[StoredAssistant], text: str | None) -> UsageError:
    labels = sorted({one.label for one in meant})
    if len(labels) > 1:
        what = f"'{layout.root}' has {len(labels)} assistants" + (f" '{text}'" if text else "")
        return UsageError(
            "\n".join([f"{what}:", *first([f"  {label}" for label in labels], SHOWN)]),
            "name one of them",
        )
    newest = sorted(meant, key=lambda one: max(source.date for source in one.sources), reverse=True)
    differing = list(_differing(meant))
    lines = [f"'{layout.root}' has {len(meant)} assistants '{labels[0]}', newest first:"]
    for one in newest:
        source = max(one.sources, key=lambda source: source.date)
        settings = [f"{name}={one.settings.get(name)}" for name in differing]
        if not differing:  # other trained parts
            settings = [f"{name} {key[:8]}" for name, (_, key) in sorted(one.inputs.items())]
        about = [*settings, f"{one.cells} cells", f"such as {source.key[:12]} of {source.date}"]
        lines.append(f"  {', '.join(about)}")
    how = "give the beginning of one of these keys"
    if differing:
        how += f", or a setting: '{labels[0]} {differing[0]}={newest[0].settings[differing[0]]}'"
    return UsageError("\n".join(lines), how)


def _differing(meant: Sequence[StoredAssistant]) -> Iterator[str]:
    """The settings in which assistants differ."""
    for name in meant[0].settings:
        if len({json.dumps(one.settings.get(name)) for one in meant}) > 1:
            yield name


def _not_there(layout: Layout, meant: Sequence[StoredAssistant]) -> ArtifactError:
    one = meant[0]
    missing = one.folders(layout)[1]
    named = ", ".join(f"{kind} {key}" for kind, key in missing)
    kinds = "|".join(dict.fromkeys(kind for kind, _ in missing))
    stages = f"task={one.task},seed={one.seed},stage={kinds}"
    if one.published:
        hint = (
            "its rows are published, and its models are not: wasp run SPEC --reuse none --select "
            f"'task={one.task},seed={one.seed},method={one.method}' trains and evaluates one"
        )
    else:
        hint = f"wasp run SPEC --results {layout.root} --select '{stages}' computes them again"
    return ArtifactError(
        f"the assistant '{one.label}' cannot be built: '{layout.root}' has no {named}", hint
    )
