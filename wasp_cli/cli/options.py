"""The options that commands share: single ones, and groups of them, which a command takes as one
parameter.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from wasp_cli.cli.completion import (
    method_names,
    preset_names,
    setting_names,
    spec_names,
    task_names,
)
from wasp_cli.cli.parameters import argument, directory, flag, option, parse_duration, parse_folder
from wasp_cli.errors import UnknownName, UsageError

if TYPE_CHECKING:
    from wasp_cli.run.session import RunOptions
    from wasp_cli.spec.load import Loaded


def print_json(value: Any) -> None:
    """Print a value as JSON to stdout."""
    json.dump(value, sys.stdout, indent=1)
    sys.stdout.write("\n")


RESULTS = Path("results")
LOCAL = "loky"  # the backend of this machine
SCHEDULER_VARIABLE = "WASP_SCHEDULER"


def require_extra(extra: str, *packages: str) -> None:
    """Raise UsageError if a package of an extra is not installed."""
    for package in packages:
        try:
            importlib.import_module(package)
        except ImportError as error:
            raise UsageError(
                f"this command needs packages that are not here: {error}",
                f"pip install 'wasp-cli[{extra}]'",
            ) from error


ResultsOption = Annotated[Path, directory("The results folder.", "--results")]
ResultsArgument = Annotated[
    Path | None,
    argument("[DIR]", "The results folder. (default: what --results says)", parser=parse_folder),
]
NodeArgument = Annotated[
    str, argument("NODE", "A label ('goal1 s1 world_model'), or the beginning of a key.")
]
StoredCellArgument = Annotated[
    str,
    argument(
        "CELL",
        "A label ('goal1 s1 wasp laggy=0.7'), the beginning of a key, or an episodes.parquet.",
    ),
]
EpisodeOption = Annotated[int, option("E", "The episode, counted from 0.", "--episode", "-e")]
MethodOption = Annotated[
    list[str] | None,
    option(
        "NAME", "Only this method of the spec (repeatable).", "--method", "-m", among=method_names
    ),
]
PresetOption = Annotated[
    str | None,
    option(
        "NAME",
        "Sizes and budgets, in place of the spec's own. (default: what the spec says)",
        "--preset",
        among=preset_names,
    ),
]
RunOption = Annotated[
    str | None,
    option(
        "ID",
        "A folder name in runs/, its end, or the name of a spec. (default: the newest)",
        "--run",
    ),
]
JobsOption = Annotated[
    int | None,
    option(
        "N",
        "At most N workers, which share N cores; 0: one, in this process. (default: all cores)",
        "--jobs",
        "-j",
        min=0,
    ),
]
SetOption = Annotated[
    list[str] | None,
    option("KEY=VALUE", "Override a value of the spec (repeatable).", "--set", among=setting_names),
]
SelectOption = Annotated[
    list[str] | None,
    option(
        "FIELD=VALUE,...",
        "Only these: 'task=race1,method=wasp|ida', 'stage=world_model' (repeatable).",
        "--select",
    ),
]
ReuseOption = Annotated[
    str | None,
    option(
        "none|published|DIR",
        "Use results of results/published, or of DIR. (default: what the spec says)",
        "--reuse",
    ),
]
JsonOption = Annotated[bool, flag("--json", "Print JSON.")]
PortOption = Annotated[int, option("N", "Port on 127.0.0.1; 0: any free one.", min=0, max=65535)]
BrowserOption = Annotated[
    bool, flag("--browser/--no-browser", "Open a browser, or only print the address.")
]


@dataclass(frozen=True, kw_only=True)
class Folder:
    """A results folder, which a command takes as its argument or as `--results`."""

    folder: ResultsArgument = None
    results: ResultsOption = RESULTS

    @property
    def path(self) -> Path:
        """The results folder. Raises UsageError if the argument and `--results` name different
        ones.
        """
        if self.folder is not None and self.results not in (self.folder, RESULTS):
            raise UsageError(
                f"two results folders: '{self.folder}' and --results '{self.results}'",
                "name one of them",
            )
        if self.folder is None:
            return self.results
        return self.folder


@dataclass(frozen=True, kw_only=True)
class Whereabouts:
    """A results folder, and a run in it."""

    run: RunOption = None
    results: ResultsOption = RESULTS


@dataclass(frozen=True, kw_only=True)
class Sized:
    """The tasks, preset and settings of a spec, and the results folder."""

    task: Annotated[
        list[str] | None,
        option(
            "TASK", "Only this task of the spec (repeatable).", "--task", "-t", among=task_names
        ),
    ] = None
    preset: PresetOption = None
    set_: SetOption = None
    results: ResultsOption = RESULTS

    @property
    def settings(self) -> list[str]:
        """The settings of `--set`, with that of `--preset` before them. Raises UnknownName for an
        unknown preset.
        """
        from wasp_cli.spec.load import sized

        return sized(self.preset, self.set_)


@dataclass(frozen=True, kw_only=True)
class SizedSpec(Sized):
    """A spec with its tasks, preset and settings."""

    spec: Annotated[
        Path, argument("SPEC", "A YAML file, or a name such as quickstart.", among=spec_names)
    ]

    def load(self) -> Loaded:
        """Load and validate the spec. Raises InvalidSpec, or UnknownName for a task that it does
        not have.
        """
        from wasp_cli.spec.load import load, restricted

        return restricted(load(self.spec, self.settings), self.task)


@dataclass(frozen=True, kw_only=True)
class SelectedSpec(SizedSpec):
    """A spec, of which only a part may be run."""

    method: MethodOption = None
    select: SelectOption = None
    limit: Annotated[
        int | None,
        option("N", "Only the first N episodes of each cell, as a quick preview.", min=1),
    ] = None
    failed: Annotated[
        bool, flag("--failed", "Only nodes that failed before, and nodes that wait for them.")
    ] = False
    reuse: ReuseOption = None

    def load(self) -> Loaded:
        """Load and validate the spec with these tasks, methods and episodes. `select` and `failed`
        are applied to its plan later.
        """
        from wasp_cli.spec.load import limited, load, restricted

        whole = load(self.spec, self.settings)
        return limited(restricted(whole, self.task, self.method), self.limit)


@dataclass(frozen=True, kw_only=True)
class Work:
    """How a run is carried out: workers, limits and backend."""

    dry_run: Annotated[
        bool, flag("--dry-run", "Show the plan, as wasp plan does, and run nothing.")
    ] = False
    jobs: JobsOption = None
    timeout: Annotated[
        float | None,
        option(
            "TIME", "Time limit of each node: 90, 30m, 2h. (default: none)", parser=parse_duration
        ),
    ] = None
    retries: Annotated[
        int, option("N", "Retries of a node that fails for a reason which may pass.", min=0, max=9)
    ] = 0
    strict: Annotated[
        bool,
        flag("--strict", "Stop where a stage is not good enough for what builds on it."),
    ] = False
    backend: Annotated[
        str, option("NAME", "Workers: loky (local), dask or slurm.", envvar="WASP_BACKEND")
    ] = LOCAL
    scheduler: Annotated[
        str | None,
        option(
            "URL",
            "Address of dask; of slurm, options of sbatch.",
            envvar=SCHEDULER_VARIABLE,
        ),
    ] = None

    def options(self) -> RunOptions:
        """Return the options of the run. Raises UnknownName for an unknown backend."""
        from wasp_cli.run.cores import cores
        from wasp_cli.run.pools.choice import BACKENDS
        from wasp_cli.run.session import RunOptions

        if self.backend not in BACKENDS:  # checked even if nothing is going to run
            raise UnknownName("backend", self.backend, BACKENDS)
        jobs = cores() if self.jobs is None else self.jobs
        scheduler = self.scheduler
        if self.backend == LOCAL and scheduler == os.environ.get(SCHEDULER_VARIABLE):
            scheduler = None  # the variable counts only for backends with a scheduler
        return RunOptions(
            jobs,
            self.timeout,
            self.retries,
            self.backend,
            scheduler,
            reports=True,
            strict=self.strict,
        )
