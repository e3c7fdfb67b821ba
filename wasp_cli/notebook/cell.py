"""One cell of a results folder: its rows, and its episodes played again."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from wasp_cli.errors import UsageError
from wasp_cli.notebook import rows
from wasp_cli.notebook.cells import ListedCell, table_of
from wasp_cli.store.artifact import read_manifest
from wasp_cli.store.find import KIND, FoundCell
from wasp_cli.store.layout import Layout

if TYPE_CHECKING:
    import numpy as np
    import pyarrow as pa
    from numpy.typing import NDArray


@dataclass(frozen=True)
class StoredCell:
    """A computed cell; see `Results.cell`."""

    layout: Layout
    names: ListedCell

    @property
    def key(self) -> str:
        """Name of its folder in `store/evaluate`."""
        return self.names.key

    @property
    def label(self) -> str:
        """As `wasp run` prints it."""
        return self.names.label

    @property
    def manifest(self) -> dict[str, Any]:
        """What is recorded of it: configuration, inputs, versions, time."""
        return read_manifest(self.layout, KIND, self.key)

    def __repr__(self) -> str:
        return f"<wasp cell '{self.label}', {self.key}>"

    def episodes(self) -> pa.Table:
        """Read a row per episode.

        Raises:
            StoreError: the rows are damaged.
        """
        return rows.stacked(self.layout, [self.names], rows.episodes, rows.EPISODE, None)

    def steps(self, episode: int | None = None) -> pa.Table:
        """Read a row per decision, of one episode or of all.

        Raises:
            StoreError: the rows are damaged.
        """
        found = rows.stacked(self.layout, [self.names], rows.steps, rows.STEPS, None)
        if episode is None:
            return found
        import pyarrow.compute as pc

        return found.filter(pc.equal(found["episode"], episode))

    def branches(self) -> pa.Table:
        """Read a row per counterfactually tested decision.

        Raises:
            StoreError: the rows are damaged.
        """
        return rows.stacked(self.layout, [self.names], rows.branches, rows.BRANCH, None)

    def replay(self, episode: int = 0, every: int | None = None) -> Iterator[NDArray[np.uint8]]:
        """Play an episode again and draw the frames of `wasp replay`: map, cameras, imagined futures, gates; uint8 [704, 976, 3] each.

        Needs torch and the cell's models in the results folder.

        Args:
            episode: counted from 0.
            every: decisions between two frames; None: so many that there are at most 125 frames.

        Raises:
            UsageError: no such episode.
            ArtifactError: a model is missing or damaged, or what is played is not what was recorded.
        """
        from wasp_cli.video.replay import replay_frames

        path = table_of(self.layout, self.names)
        assert path is not None  # the cell is computed: `Results.cell` has seen to it
        yield from replay_frames(self.layout, FoundCell(path, self.key, self.manifest), episode, every)

    def to_minari(self, name: str, observation: str = "vision") -> Any:
        """Write the episodes as a Minari dataset, and return it: executed actions, rewards, and infos with cost and the operator's command.

        They are played again in the task's gymnasium environment, decision by decision. Needs the package minari.

        Args:
            name: of the dataset, `namespace/name-v0`.
            observation: what a step sees: `state`, `pixels`, `vision`, `privileged` or `all`.

        Raises:
            UsageError: minari is not installed, or the cell was published without all its steps.
            ArtifactError: what is played is not what was recorded.
        """
        try:
            from wasp_cli.notebook.minari import written
        except ImportError as error:
            raise UsageError(f"the export needs a package that is not here: {error}", "pip install 'minari[create,hdf5]'") from error
        from wasp_cli.learning.rerun import Recorded
        from wasp_cli.store.recorded import read_recorded
        from wasp_cli.store.slim import without_steps
        from wasp_cli.tasks.registry import TASKS

        if without_steps(self.manifest):
            raise UsageError(f"{self.label} was published without all its steps", "wasp run SPEC --reuse none computes it whole")
        path = table_of(self.layout, self.names)
        assert path is not None
        manifest, recorded = self.manifest, Recorded(**read_recorded(path))
        repeat, about = int(manifest["settings"]["action_repeat"]), f"{self.label}, {self.key}"
        return written(name, TASKS[str(manifest["task"])].gym_id, recorded, repeat, observation, about)
