"""`wasp doctor`: what this machine has, and what that means for a run."""

from __future__ import annotations

import os
import platform
import warnings
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, NamedTuple

from wasp_cli.cli.command import command
from wasp_cli.cli.options import RESULTS, ResultsOption
from wasp_cli.console import out
from wasp_cli.errors import DrawingError, StoreError, UsageError, WaspError, refusal
from wasp_cli.registry import Registry, load_target
from wasp_cli.store.layout import Layout
from wasp_cli.store.provenance import installed, memory_gb, processor

NEEDED = (
    "torch",
    "mujoco",
    "gymnasium",
    "numpy",
    "stable-baselines3",
    "joblib",
    "pyarrow",
    "safetensors",
)
SMALL_MEMORY_GB = 4.0
# stages that compute on a GPU where there is one; a test holds this against their code
ON_DEVICE = ("world_model", "latents", "severity", "operating", "evaluate")


@command("wasp doctor", codes="0 all is there, 1 something is missing or broken, 2 usage")
def doctor(results: ResultsOption = RESULTS) -> None:
    """Check this machine: libraries, cores, memory, GPU.

    And whether the results folder can be written.
    """
    from rich.table import Table
    from rich.text import Text

    findings = list(examine(results))
    table = Table(box=None, padding=(0, 2), show_header=False)
    colours = {
        "ok": "green",
        "missing": "bold red",
        "broken": "bold red",
        "low": "yellow",
        "limited": "yellow",
        "optional": "yellow",
    }
    for finding in findings:
        state = Text(
            "none" if finding.state == "optional" else finding.state, style=colours[finding.state]
        )
        table.add_row(
            Text(finding.what), state, Text(finding.found), Text(finding.meaning, style="dim")
        )
    out().print(table)
    require(findings)


State = Literal["ok", "missing", "broken", "low", "limited", "optional"]


class Finding(NamedTuple):
    """A row of the table: what was examined, its state, what was found, and what that means."""

    what: str
    state: State
    found: str
    meaning: str = ""


def examine(results: Path) -> Iterator[Finding]:
    """Examine this machine and yield a finding for each thing: Python, libraries, plugins, cores,
    memory, GPU, and the folders that are written to. Nothing is created.
    """
    from wasp_cli.run.cores import cores, memory_limit, thread_limit

    yield Finding("Python", "ok", platform.python_version())
    for name in NEEDED:
        try:
            # Warnings are hidden, such as joblib's about shared memory, which has a row of its own.
            with warnings.catch_warnings(action="ignore"):
                import_module(name.replace("-", "_"))
        except Exception as error:
            # OSError: a shared library is missing. Any other error: it is there, but fails.
            state: State = "missing" if isinstance(error, ImportError | OSError) else "broken"
            yield Finding(
                name, state, str(error).partition("\n")[0], f"required: pip install {name}"
            )
        else:
            yield Finding(name, "ok", installed(name) or "found")
    yield _figures()
    yield from _plugins()
    yield Finding(
        "cores",
        "ok",
        f"{cores()} ({processor()})",
        "`wasp run` starts as many workers; -j N sets their number",
    )
    limit = thread_limit()
    if limit is not None:
        name, count = limit
        yield Finding(name, "ok", str(count), "threads of a node at most")
    memory = memory_gb()
    most = memory_limit()
    if memory is None:
        yield Finding("memory", "optional", "unknown", "the preset cpu needs about 2 GB per worker")
    else:
        if most is not None:
            memory = min(memory, round(most / 1e9, 1))
        small = memory < SMALL_MEMORY_GB
        yield Finding(
            "memory",
            "low" if small else "ok",
            f"{memory:g} GB",
            "use -j 1 and the preset quick" if small else "",
        )
    yield _shared_memory()
    yield _gpu()
    yield _cache()
    yield _temporary()
    yield _writable(results)


def registries() -> tuple[Registry[Any], ...]:
    """Return the registries that other packages can add to. They are imported here, since `wasp
    --help` imports this module.
    """
    from wasp_cli.methods.registry import METHODS
    from wasp_cli.operators.registry import OPERATORS
    from wasp_cli.stages.registry import STAGES
    from wasp_cli.tasks.registry import TASKS

    return (TASKS, METHODS, OPERATORS, STAGES)


def _plugins() -> Iterator[Finding]:
    """A finding for each plugin. A plugin that cannot be used stops other commands, but not this
    one.
    """
    from wasp_cli.methods.registry import MethodInfo
    from wasp_cli.spec.model import check_plugin

    for registry in registries():
        for point, added in registry.plugins():
            package = f"{point.dist.name} {point.dist.version}" if point.dist else point.module
            what = f"plugin {point.name} ({registry.kind})"
            try:
                if isinstance(added, WaspError):
                    raise added
                check_plugin(registry, added, load_target(added.target))
                if isinstance(added, MethodInfo):
                    added.config_model()
            except Exception as error:  # its code is another's
                cause = error if error.__cause__ is None else error.__cause__
                reason = f"{type(cause).__name__}: {cause}"
                if isinstance(cause, WaspError):
                    reason = cause.message
                yield Finding(
                    what,
                    "broken",
                    f"{package}: {reason}".partition("\n")[0],
                    "repair or uninstall it",
                )
            else:
                yield Finding(what, "ok", package)


def _gpu() -> Finding:
    try:
        import torch

        from wasp_cli.learning.device import VARIABLE, training_device
    except (ImportError, OSError):
        return Finding("GPU", "optional", "unknown without torch")
    stages = ", ".join(ON_DEVICE)
    name = torch.cuda.get_device_name(0) if torch.cuda.is_available() else "none that torch can use"
    try:
        device = training_device()
    except UsageError as error:
        return Finding(
            "GPU",
            "missing",
            str(error),
            f"{error.hint}: the stages {stages} would end with this error",
        )
    asked = f" ({VARIABLE}={os.environ[VARIABLE]})" if os.environ.get(VARIABLE) else ""
    if device.type == "cpu":
        state: Literal["ok", "optional"] = "ok" if asked else "optional"
        return Finding("GPU", state, name, f"not needed: every stage computes on the CPU{asked}")
    meaning = (
        f"the stages {stages} compute on {device}{asked}, the others on the CPU; "
        f"{VARIABLE}=cpu keeps all off it"
    )
    return Finding("GPU", "ok", name, meaning)


def _shared_memory() -> Finding:
    from wasp_cli.run.cores import cores
    from wasp_cli.run.shared_memory import PLACE, REMEDY, refusal_of_semaphores

    reason = refusal_of_semaphores(cores())
    if reason is None:
        return Finding("shared memory", "ok", f"'{PLACE}' has room for worker processes")
    if cores() == 1:
        return Finding("shared memory", "limited", reason, "`wasp run` starts no worker process")
    return Finding("shared memory", "missing", reason, REMEDY)


def _cache() -> Finding:
    from wasp_cli.spec.cache import REMEDY, place, temporary_folder
    from wasp_cli.spec.shipped import packaged_folder

    root = packaged_folder()
    if root is None:
        return Finding("cache", "ok", "not needed", "this package has no published results")
    try:
        folder = place(root)
    except StoreError as error:
        return Finding("cache", "missing", error.message, REMEDY)
    if folder is None:
        return Finding("cache", "ok", "not needed", f"published results are in '{root}'")
    if folder == temporary_folder():
        meaning = "XDG_CACHE_HOME names a folder that lasts: published results are unpacked there"
        return Finding("cache", "limited", f"'{folder}', which is temporary", meaning)
    return Finding("cache", "ok", f"'{folder}' can be written")


def _temporary() -> Finding:
    import tempfile

    try:
        return Finding("temporary files", "ok", f"'{tempfile.gettempdir()}' can be written")
    except OSError as error:
        meaning = "set TMPDIR to a folder that can be written"
        return Finding("temporary files", "missing", refusal(error).message, meaning)


def _figures() -> Finding:
    from wasp_cli.report.canvas import load_matplotlib

    try:
        return Finding("matplotlib", "ok", str(load_matplotlib().__version__))
    except DrawingError as error:
        return Finding("matplotlib", "broken", error.message, error.hint or "")
    except ImportError as error:
        return Finding("matplotlib", "missing", str(error), "required: pip install matplotlib")


def _writable(results: Path) -> Finding:
    layout = Layout(results.absolute())
    try:
        layout.require_own_folders()
    except StoreError as error:
        return Finding("results", "missing", error.message, error.hint or "")
    for folder in (layout.root, *layout.needed()):
        # Nothing is created: the nearest existing folder tells whether it could be.
        place = next(path for path in (folder, *folder.parents) if os.path.lexists(path))
        if not os.path.isdir(place) or not os.access(place, os.W_OK | os.X_OK):
            return Finding(
                "results",
                "missing",
                f"'{place}' is no folder that can be written",
                "choose another folder with --results DIR",
            )
    return Finding("results", "ok", f"'{results}' can be written")


def require(findings: list[Finding]) -> None:
    """Raise WaspError if anything is missing or broken."""
    missing = [finding.what for finding in findings if finding.state in ("missing", "broken")]
    if missing:
        raise WaspError(
            f"wasp cannot run here: {', '.join(missing)}",
            "the last column of the table says what to do",
        )
