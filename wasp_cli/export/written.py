"""What every format is given, and what it answers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from wasp_cli.errors import ArtifactError, UsageError, first
from wasp_cli.export import evaluated, recorded
from wasp_cli.export.episode import Episode
from wasp_cli.export.evaluated import Told
from wasp_cli.export.folders import size_of
from wasp_cli.store.artifact import corruption
from wasp_cli.store.find import FoundNode
from wasp_cli.store.layout import Layout
from wasp_cli.tasks.declared import declare_from


@dataclass(frozen=True)
class Source:
    """Nodes of one task, whose episodes make one dataset."""

    layout: Layout
    nodes: tuple[FoundNode, ...]
    task: str
    action_repeat: int  # env steps of a decision
    observations: bool
    limit: int | None = None  # episodes of each node
    threads: int = 1
    told: Told = lambda text: None

    @property
    def labels(self) -> list[str]:
        """The labels of the nodes, as `wasp run` prints them."""
        return [node.label or node.key or "" for node in self.nodes]

    def episodes(self) -> Iterator[Episode]:
        """Read the episodes of all nodes, one after the other.

        Raises:
            ArtifactError: an artifact is damaged, or an episode that is played again is not the
                recorded one.
            UsageError: a cell has no steps.
        """
        for node in self.nodes:
            wrong = corruption(self.layout, node.kind, node.key or "")
            if wrong is not None:
                raise ArtifactError(wrong, "run the spec again: what is damaged is computed again")
            if node.kind == recorded.KIND:
                yield from recorded.recorded_episodes(
                    node, observations=self.observations, limit=self.limit
                )
            else:
                yield from evaluated.evaluated_episodes(
                    node,
                    observations=self.observations,
                    limit=self.limit,
                    threads=self.threads,
                    told=self.told,
                )


def source_of(
    layout: Layout,
    nodes: Sequence[FoundNode],
    *,
    observations: bool = True,
    limit: int | None = None,
    threads: int = 1,
    told: Told = lambda text: None,
) -> Source:
    """Return the source of one dataset.

    Args:
        layout: of the results folder.
        nodes: from `selection.selected`.
        observations: whether what was seen is exported.
        limit: only the first episodes of each node; None: all.
        threads: of physics and cameras, where episodes are played again.
        told: called with a sentence where something is left out.

    Raises:
        UsageError: the nodes are of several tasks, or decide after other numbers of env steps.
    """
    tasks = sorted({str(node.setting("task")) for node in nodes})
    if len(tasks) > 1:
        lines = first([f"  {task}" for task in tasks], 12)
        raise UsageError(
            "\n".join([f"a dataset is of one task, and these are of {len(tasks)}:", *lines]),
            "name the task as well, and export each to a folder of its own",
        )
    repeats = sorted({int(node.setting("settings", "action_repeat")) for node in nodes})
    if len(repeats) > 1:
        numbers = " and ".join(map(str, repeats))
        raise UsageError(
            f"in a dataset all decisions take equally long, and these take {numbers} env steps",
            "export them to folders of their own",
        )
    declare_from(tasks[0], nodes[0].setting("settings"))
    return Source(layout, tuple(nodes), tasks[0], repeats[0], observations, limit, threads, told)


@dataclass(frozen=True)
class Written:
    """A dataset that was written."""

    folder: Path
    episodes: int
    decisions: int
    load: str  # the line of Python that loads it

    @property
    def size(self) -> int:
        """Bytes of all its files."""
        return size_of(self.folder)


def nothing_written(source: Source) -> UsageError:
    """Return the error of a selection without any episode."""
    return UsageError(f"no episodes: {', '.join(first(source.labels, 3))}", "--limit is at least 1")
