"""Which datasets and cells of a results folder a text means.

    selected(layout, ["goal1 s1 wasp"])             all cells of one assistant
    selected(layout, ["goal1 s1 wasp laggy=0.7"])   one cell
    selected(layout, ["goal1 dataset"])             the datasets of all trainings on Goal1
    selected(layout, ["person"])                    everything that people drove
    selected(layout, ["611a4993"])                  a node by the beginning of its key
    selected(layout, [], "table1")                  all cells of a spec

The words of a text are those of a label, in any order (`cells.words`). What is left out may be
anything.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress

from wasp_cli.cells.runs import RunRecord, named_run, planned_runs
from wasp_cli.cells.words import WHOLE, KnownWords, Words, fits, read_words
from wasp_cli.errors import ArtifactError, StoreError, UnknownName, UsageError, first
from wasp_cli.export import evaluated, recorded
from wasp_cli.store.artifact import read_manifest, stored_keys
from wasp_cli.store.find import FoundNode
from wasp_cli.store.layout import Layout, is_key
from wasp_cli.store.named import begins, one_line, same_label
from wasp_cli.store.severities import as_driven, severity_of

KINDS = (recorded.KIND, evaluated.KIND)
SHOWN = 8  # labels that an error lists


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
        chosen = _cells(stored)
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


def _fits(node: FoundNode, words: Words) -> bool:
    """Whether a node is as words ask for it. A dataset has neither method nor operator."""
    value = None
    with suppress(KeyError, TypeError, ValueError):
        value = severity_of(node.manifest)
    return (
        fits(node.kind, words.kinds)
        and fits(node.setting("seed"), words.seeds)
        and words.fit_assistant(
            str(node.setting("task")), node.setting("axes", "method"), _variant_of(node)
        )
        and words.fit_operator(node.setting("axes", "operator"), value)
    )


def _variant_of(node: FoundNode) -> str | None:
    """The ablation of a cell; None of a dataset."""
    if node.kind != evaluated.KIND:
        return None
    variant = node.setting("axes", "method_config", "variant")
    return WHOLE if variant is None else str(variant)


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
    known = KnownWords(
        tasks={str(node.setting("task")) for node in stored},
        methods={str(node.setting("axes", "method")) for node in _cells(stored)},
        operators={str(node.setting("axes", "operator")) for node in _cells(stored)},
        kinds=KINDS,
    )
    words = read_words(line, known, layout.root)
    meant = [node for node in stored if _fits(node, words)]
    meant = words.whole_first(meant, [_variant_of(node) for node in meant])
    if not meant:
        labels = first([f"  {label}" for label in _labels(stored)], SHOWN)
        raise UsageError(
            "\n".join([f"'{layout.root}' has no '{line}'; it has:", *labels]),
            "wasp run SPEC --results DIR makes what a spec has",
        )
    return meant


def _cells(nodes: Sequence[FoundNode]) -> list[FoundNode]:
    return [node for node in nodes if node.kind == evaluated.KIND]


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
