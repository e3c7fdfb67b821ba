"""The folders of `results/`: every path that wasp writes is made here, from checked names.

results/
  store/<kind>/<key>/   an artifact: what the stage wrote, and _manifest.json; whole, or not there
  failures/<key>.json   why a node failed last; removed when it succeeds
  work/<key>/           checkpoints of a node that can resume; removed when it is done
  locks/<key>           held by the process that computes a node
  locks/planning        held while runs are planned, or results are removed
  tmp/                  artifacts that are being written; on the same file system, so that
                        publishing one is a rename
  runs/<run>/           spec.yaml, spec.json, plan.json, order, journal.jsonl, running/, logs/
  reports/<spec>/       tables and figures
  published/            results that lie in git: store/ and reports/ as above, and packs/, which are
                        unpacked to store/
"""

from __future__ import annotations

import os
import re
import tempfile
from dataclasses import dataclass
from pathlib import Path

from wasp_cli.errors import StoreError
from wasp_cli.store.packs import unpack

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.=+-]{0,127}")
_KEY = re.compile(r"[0-9a-f]{8,64}")
MANIFEST = "_manifest.json"  # begins as what readers of Parquet folders leave alone
# what only the cell of a person has, finished or not; see `store.people`
SESSION_FILE = "_session.json"


@dataclass(frozen=True)
class Layout:
    """The paths below one results folder. To make one unpacks the packs of the folder.

    Methods that take a key, a kind or another name raise StoreError where it has not the form of
    one.
    """

    root: Path

    def __post_init__(self) -> None:
        unpack(self.root)

    @property
    def store(self) -> Path:
        """Where the artifacts are."""
        return self.root / "store"

    @property
    def tmp(self) -> Path:
        """Where artifacts are written."""
        return self.root / "tmp"

    @property
    def runs(self) -> Path:
        """Where every run has a folder."""
        return self.root / "runs"

    @property
    def failures(self) -> Path:
        """Where failed nodes have a record."""
        return self.root / "failures"

    @property
    def works(self) -> Path:
        """Where unfinished nodes have checkpoints."""
        return self.root / "work"

    @property
    def locks(self) -> Path:
        """Where the locks are."""
        return self.root / "locks"

    @property
    def published(self) -> Path:
        """Another such folder, which only `wasp publish` writes to."""
        return self.root / "published"

    @property
    def publishing(self) -> Path:
        """Held by `wasp publish` while it writes to a published layer, and removed afterwards."""
        return self.root / ".publishing"

    @property
    def planning(self) -> Path:
        """Held, shared, by a run from looking into the store until its plan is written; and held
        alone while results are removed that no plan reaches.
        """
        return self.locks / "planning"

    def kind(self, kind: str) -> Path:
        """Return the folder of all artifacts of a kind."""
        return self.store / _name(kind)

    def artifact(self, kind: str, key: str) -> Path:
        """Return the folder of an artifact."""
        return self.root.joinpath("store", _name(kind), _key(key))

    def manifest(self, kind: str, key: str) -> Path:
        """Return the manifest of an artifact."""
        # in one call of `joinpath`: a plan asks for thousands
        return self.root.joinpath("store", _name(kind), _key(key), MANIFEST)

    def failure(self, key: str) -> Path:
        """Return the record of a node's last failure."""
        return self.failures / f"{_key(key)}.json"

    def work(self, key: str) -> Path:
        """Return where a node keeps what survives an interruption."""
        return self.works / _key(key)

    def lock(self, key: str) -> Path:
        """Return the lock of a node."""
        return self.locks / _key(key)

    def reports(self, spec: str) -> Path:
        """Return the folder of the report of a spec."""
        return self.root / "reports" / _name(spec)

    def run(self, run_id: str) -> Path:
        """Return the folder of a run."""
        return self.runs / _name(run_id)

    def log(self, run_id: str, label: str, key: str) -> Path:
        """Return the log of a node in a run."""
        return self.run(run_id) / "logs" / f"{slug(label)}-{_key(key)[:8]}.log"

    def journal(self, run_id: str) -> Path:
        """Return the events of a run."""
        return self.run(run_id) / "journal.jsonl"

    def order(self, run_id: str) -> Path:
        """Return the file that says which of all runs this is."""
        return self.run(run_id) / "order"

    def reporting(self, run_id: str) -> Path:
        """Return the file that is there, with a process, until the report of a run is written."""
        return self.run(run_id) / "reporting.json"

    def stop(self, run_id: str) -> Path:
        """Return the file that is there when a run was asked to end."""
        return self.run(run_id) / "stop"

    def running(self, run_id: str, key: str) -> Path:
        """Return what a running node says of its progress."""
        return self.run(run_id) / "running" / f"{_key(key)}.json"

    def overdue(self, run_id: str, key: str) -> Path:
        """Return the file that is not empty when a node's process was ended because it did not
        react to its time limit.
        """
        return self.run(run_id) / "running" / f"{_key(key)}.overdue"

    def needed(self) -> tuple[Path, ...]:
        """Return the folders that a run writes to."""
        return self.store, self.tmp, self.runs, self.failures, self.works, self.locks

    def require_own_folders(self) -> None:
        """Check that none of the folders is a link: what is written or removed there would be
        written or removed elsewhere. Raises StoreError.
        """
        for folder in (*self.needed(), self.root / "reports"):
            self.within(folder)

    def within(self, path: Path) -> Path:
        """Return a path below the results folder as it is, after a check that there is no link on
        the way. Raises StoreError.
        """
        reached = str(self.root)
        for part in path.parts[len(self.root.parts) :]:
            reached = f"{reached}/{part}"
            if os.path.islink(reached):
                raise StoreError(
                    f"'{reached}' is a link; results hold plain files and folders",
                    "link the whole results folder instead",
                )
        return path

    def prepare(self) -> None:
        """Make the folders, and check that they can be written. Raises StoreError."""
        self.require_own_folders()
        try:
            for folder in self.needed():
                folder.mkdir(parents=True, exist_ok=True)
            # A file of its own: another run may be trying the same folder now.
            with tempfile.TemporaryFile(dir=self.tmp):
                pass
        except OSError as error:
            reason = (error.strerror or str(error)).lower()
            if os.path.isfile(self.root):
                reason = "it is a file"
            raise StoreError(
                f"cannot write results to '{self.root}': {reason}",
                "choose another folder with --results DIR",
            ) from error


def slug(text: str) -> str:
    """Return a text as a part of a file's name: other characters become dashes; at most 100."""
    return re.sub(r"[^A-Za-z0-9_.=+-]+", "-", text).strip("-.")[:100] or "node"


def is_key(text: str) -> bool:
    """Return whether a text has the form of a key."""
    return bool(_KEY.fullmatch(text))


def is_name(text: str) -> bool:
    """Return whether a text can name a folder of the results."""
    return bool(_NAME.fullmatch(text))


def _name(name: str) -> str:
    if not is_name(name):
        raise StoreError(f"'{name}' cannot name a folder of the results")
    return name


def _key(key: str) -> str:
    if not is_key(key):
        raise StoreError(f"'{key}' is not a key")
    return key
