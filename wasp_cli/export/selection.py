"""Which datasets and cells of a results folder a text means.

    selected(layout, ["goal1 s1 wasp"])             all cells of one assistant
    selected(layout, ["goal1 s1 wasp laggy=0.7"])   one cell
    selected(layout, ["goal1 dataset"])             the datasets of all trainings on Goal1
    selected(layout, ["person"])                    everything that people drove
    selected(layout, ["611a4993"])                  a node by the beginning of its key
    selected(layout, [], "table1")                  all cells of a spec

The words of a text are those of a label, in any order. What is left out may be anything.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from wasp_cli.cells.runs import RunRecord, named_run, planned_runs
from wasp_cli.errors import ArtifactError, StoreError, UnknownName, UsageError, first
from wasp_cli.export import evaluated, recorded
from wasp_cli.methods.registry import METHODS
from wasp_cli.metrics.severity import AUTO
from wasp_cli.operators.registry import OPERATORS, UNIMPAIRED
from wasp_cli.store.artifact import read_manifest, stored_keys
from wasp_cli.store.find import FoundNode
from wasp_cli.store.layout import Layout, is_key
from wasp_cli.store.named import begins, one_line, same_label
from wasp_cli.store.severities import as_driven, severity_of
from wasp_cli.tasks.registry import TASKS

KINDS = (recorded.KIND, evaluated.KIND)
WHOLE = "full"  # the variant of a whole method
SHOWN = 8  # labels that an error lists
_SEED = re.compile(r"s(?:eed)?=?(\d+)", re.IGNORECASE)
_WORDS = "its words are those of a label, such as '{}'; or give the beginning of a key"


def selected(layout: Layout, texts: Sequence[str], spec: str | None = None) -> list[FoundNode]:
    """Return the nodes that texts mean, each once: datasets first, then cells, by label.

    Args:
        layout: of a results folder, or of a published one.
        texts: as in the module; empty: all cells.
        spec: only what the last run of this spec has; None: everything that is stored. Of several
            nodes with one label that of the newest run is meant.

    Raises:
        StoreError: nothing that can be exported is stored.
        UnknownName: a text means nothing, or there is no such spec.
        UsageError: several nodes have the same label, and no run tells them apart.
    """
    runs = _runs(layout)
    within = None
    if spec is not None:
        if spec not in {run.spec for run in runs}:
            raise UnknownName("spec in these results", spec, [run.spec for run in runs])
        within = named_run(runs, spec).nodes.keys()
    stored = [node for node in _stored(layout) if within is None or node.key in within]
    if not stored:
        raise StoreError(
            f"'{layout.root}' has neither a cell nor a dataset"
            + ("" if spec is None else f" of '{spec}'"),
            "wasp run SPEC --results DIR writes them",
        )
    if not texts:
        chosen = [node for node in stored if node.kind == evaluated.KIND]
    else:
        meant = {node.key for text in texts for node in _meant(layout, stored, text)}
        chosen = [node for node in stored if node.key in meant]
    return _newest(chosen, runs)


def _runs(layout: Layout) -> list[RunRecord]:
    """The runs of a folder, newest first; none of a folder without runs."""
    with suppress(StoreError):
        return planned_runs(layout, values=True)
    return []


def _stored(layout: Layout) -> list[FoundNode]:
    """Every dataset and cell whose manifest reads."""
    nodes: list[FoundNode] = []
    for kind in KINDS:
        for key in filter(is_key, stored_keys(layout, kind)):
            with suppress(ArtifactError):
                manifest = read_manifest(layout, kind, key)
                nodes.append(FoundNode(layout.artifact(kind, key), key, manifest, kind))
    return sorted(nodes, key=lambda node: (KINDS.index(node.kind), node.label or "", node.key))


@dataclass
class _Asked:
    """The conditions that the words of a text make; one that is empty holds for every node."""

    kinds: set[str] = field(default_factory=set)
    tasks: set[str] = field(default_factory=set)
    seeds: set[int] = field(default_factory=set)
    methods: set[str] = field(default_factory=set)
    variants: set[str] = field(default_factory=set)
    operators: set[str] = field(default_factory=set)
    values: set[float] = field(default_factory=set)

    def holds(self, node: FoundNode) -> bool:
        """Whether a node is as it was asked for."""
        about = _about(node)
        return all(not wanted or about[name] in wanted for name, wanted in vars(self).items())


def _about(node: FoundNode) -> dict[str, Any]:
    """What conditions ask of a node, by their names; None of a dataset where only cells have it."""
    about: dict[str, Any] = {
        "kinds": node.kind,
        "tasks": node.setting("task"),
        "seeds": node.setting("seed"),
    }
    of_cells = ("methods", "variants", "operators", "values")
    if node.kind != evaluated.KIND:
        return about | dict.fromkeys(of_cells)
    with suppress(KeyError, TypeError, ValueError):
        about["values"] = severity_of(node.manifest)
    config = node.setting("axes", "method_config")
    return {
        "values": None,
        **about,
        "methods": node.setting("axes", "method"),
        "variants": config.get("variant", WHOLE) if isinstance(config, Mapping) else WHOLE,
        "operators": node.setting("axes", "operator"),
    }


def _meant(layout: Layout, stored: Sequence[FoundNode], text: str) -> list[FoundNode]:
    """The nodes that one text means."""
    line = one_line(text)
    by_key = [node for node in stored if begins(node.key or "", line)]
    if by_key:
        return by_key
    by_label = [
        node
        for node in stored
        if same_label(node.label or "", line)
        or same_label(as_driven(node.label or "", node.manifest), line)
    ]
    if by_label:
        return by_label
    asked = _read_words(layout, stored, line)
    meant = [node for node in stored if asked.holds(node)]
    if asked.methods and not asked.variants:
        # The name of a method alone is the whole method.
        meant = [node for node in meant if _about(node)["variants"] == WHOLE] or meant
    if not meant:
        labels = first([f"  {label}" for label in _labels(stored)], SHOWN)
        raise UsageError(
            "\n".join([f"'{layout.root}' has no '{line}'; it has:", *labels]),
            "wasp run SPEC --results DIR makes what a spec has",
        )
    return meant


def _read_words(layout: Layout, stored: Sequence[FoundNode], line: str) -> _Asked:
    asked = _Asked()
    tasks = _by_name({str(node.setting("task")) for node in stored})
    methods = {str(_about(node)["methods"]) for node in stored} | set(METHODS)
    operators = {str(_about(node)["operators"]) for node in stored} | {*OPERATORS, UNIMPAIRED}
    words = line.split()
    while words:
        word = words.pop(0)
        name, equals, value = word.partition("=")
        seed = _SEED.fullmatch(word)
        if word.casefold() == "seed" and words and words[0].isdecimal():
            asked.seeds.add(int(words.pop(0)))
        elif seed is not None:
            asked.seeds.add(int(seed[1]))
        elif word in KINDS:
            asked.kinds.add(word)
        elif word.casefold() in tasks:
            asked.tasks.add(tasks[word.casefold()])
        elif name in operators:
            asked.operators.add(name)
            if equals and value != AUTO:
                asked.values.add(_number(value))
        elif word.partition("/")[0] in methods:
            method, _, variant = word.partition("/")
            asked.methods.add(method)
            if variant:
                asked.variants.add(variant)
        else:
            raise UnknownName(
                "word of a label",
                word,
                {*tasks.values(), *methods, *operators} - {"None"},
                f"'{line}' means nothing that '{layout.root}' has: '{word}' is no task, seed, "
                "method or operator",
                _WORDS.format(_labels(stored)[0]),
            )
    return asked


def _by_name(tasks: Iterable[str]) -> dict[str, str]:
    """Names of tasks, of ours their titles too, in small letters, and the name each stands for."""
    names = {name.casefold(): name for name in tasks}
    for name in tuple(names.values()):
        if name in TASKS:
            names.setdefault(TASKS[name].title.casefold(), name)
    return names


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise UsageError(f"'{text}' is no severity of an operator", "it is a number") from None


def _labels(nodes: Iterable[FoundNode]) -> list[str]:
    return list(dict.fromkeys(node.label or node.key or "" for node in nodes))


def _newest(nodes: Sequence[FoundNode], runs: Sequence[RunRecord]) -> list[FoundNode]:
    """Keep one node of each label: that of the newest run which has one of them."""
    by_label: dict[str, list[FoundNode]] = {}
    for node in nodes:
        by_label.setdefault(node.label or node.key or "", []).append(node)
    kept: list[FoundNode] = []
    for label, alike in by_label.items():
        of_run = alike
        for run in runs:
            of_run = [node for node in alike if node.key in run.nodes]
            if of_run:
                break
        if len(of_run or alike) > 1:
            listed = [f"  {node.key}  {node.date}".rstrip() for node in alike]
            raise UsageError(
                "\n".join([f"{len(alike)} results are called '{label}':", *first(listed, SHOWN)]),
                "give the first characters of one of these keys, or --spec NAME",
            )
        kept += of_run or alike
    return kept
