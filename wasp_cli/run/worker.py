"""Computes one node in a worker: with its lock, threads, log and folders. It never raises; the
result says how the node ended.
"""

from __future__ import annotations

import ctypes
import io
import math
import os
import platform
import re
import sys
import time
import traceback
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout, suppress
from dataclasses import replace
from datetime import UTC, datetime
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TextIO

from threadpoolctl import threadpool_limits

from wasp_cli import seeds
from wasp_cli.config import Config
from wasp_cli.console import duration
from wasp_cli.errors import (
    ArtifactError,
    EnvironmentDied,
    SourceChanged,
    StoreError,
    TrainingError,
    WaspError,
)
from wasp_cli.operators.clones import PlacedClone, placed
from wasp_cli.operators.registry import PERSON
from wasp_cli.plan.grid import OPERATOR_CLONE
from wasp_cli.plan.source import changed_since
from wasp_cli.registry import load_target, search_beside
from wasp_cli.run.heartbeat import Heartbeat
from wasp_cli.run.job import NodeJob, NodeResult, State
from wasp_cli.run.limit import interruptible
from wasp_cli.spec.model import Spec
from wasp_cli.stages.base import Job, Progress, Stage
from wasp_cli.store import artifact, records
from wasp_cli.store.layout import SESSION_FILE, Layout
from wasp_cli.store.lock import Busy, held
from wasp_cli.store.provenance import cuda_devices, machine
from wasp_cli.store.published import EARLIER
from wasp_cli.store.severities import SEVERITY, with_severity
from wasp_cli.store.slim import WITHOUT_STEPS, without_steps
from wasp_cli.tasks.declared import ENVIRONMENT, declare_from
from wasp_cli.tasks.foreign.closing import environments

DEATHS = 2
KILLED = "its process was killed twice (out of memory, or by a signal)"


def execute(job: NodeJob, *, own_process: bool = True) -> NodeResult:
    """Compute one node, or find that another run has. It never raises: the result says how it
    ended.

    Args:
        own_process: whether the process does nothing else, so that the log gets all of its output.
    """
    return Envelope(job, own_process).execute()


def execute_here(job: NodeJob) -> NodeResult:
    """Compute one node like `execute`, in a process that does other things too."""
    return execute(job, own_process=False)


def is_seen(layout: Layout, run_id: str) -> bool:
    """Return whether this machine sees the results folder of a run: it has the run's journal. A
    folder that is not seen must not be created.
    """
    return layout.journal(run_id).exists()


def unseen(root: Path | str, run_id: str) -> StoreError:
    """Return the error of a machine that does not see the results folder of a run."""
    message = (
        f"{platform.node()} does not see the results folder '{root}': "
        f"runs/{run_id}/journal.jsonl is not there"
    )
    why = (
        "it was moved, or this machine does not share it; every worker needs it under the same path"
    )
    return StoreError(message, f"{why}. Then run again: finished nodes are kept")


class Envelope:
    """Runs the stage of a node with its log, lock and time limit, and turns errors into results."""

    def __init__(self, job: NodeJob, own_process: bool) -> None:
        self.job = job
        self.own_process = own_process
        self.layout = Layout(Path(job.root))
        self.log = self.layout.log(job.run_id, job.label, job.key)
        self.started = time.monotonic()

    def execute(self) -> NodeResult:
        """Compute the node, or say why not. Whatever a stage raises becomes a result."""
        job = self.job
        layout = self.layout
        if layout.stop(job.run_id).exists():
            return self._result("skipped")
        result = None
        if is_seen(layout, job.run_id):
            try:
                with ExitStack() as stack:
                    stream = stack.enter_context(
                        self.log.open("a", encoding="utf-8", errors="replace", buffering=1)
                    )
                    stack.enter_context(_logged(stream, self.own_process))
                    result = self._locked()
            except Exception as error:
                # an OSError where the results folder itself is in the way: full, read-only
                result = self._failed(
                    f"{type(error).__name__}: {error}", by_chance=isinstance(error, OSError)
                )
        if result is None or (result.state == "failed" and not is_seen(layout, job.run_id)):
            why = unseen(job.root, job.run_id)
            return self._result("unseen", message=why.message, hint=why.hint)
        return result

    def _result(self, state: State, **facts: Any) -> NodeResult:
        return NodeResult(
            self.job.key, state, time.monotonic() - self.started, log=str(self.log), **facts
        )

    def _locked(self) -> NodeResult:
        job = self.job
        layout = self.layout
        with Heartbeat(layout.running(job.run_id, job.key), job) as heartbeat:
            if heartbeat.deaths >= DEATHS:
                return self._failed(KILLED)
            try:
                with held(layout.lock(job.key), lambda: False):
                    if not artifact.exists(layout, job.kind, job.key):
                        return self._computed(heartbeat.tell)
                    manifest = artifact.read_manifest(layout, job.kind, job.key)
                    return self._result("shared", summary=manifest.get("summary", {}))
            except Busy:
                return self._result("busy")

    def _computed(self, progress: Progress) -> NodeResult:
        """Compute the node, then close its environments. The result is stored by then, so that it
        is not lost if closing them fails.
        """
        last_words = unclosed_file(self.layout, self.job) if self.own_process else None
        with environments(last_words) as scope:
            result = self._stored(progress)
        return replace(result, unclosed=tuple(scope.troubles))

    def _stored(self, progress: Progress) -> NodeResult:
        job = self.job
        layout = self.layout
        staging = artifact.staging_folder(layout, job.key)
        started_at = datetime.now(UTC).isoformat(timespec="seconds")
        began = time.monotonic()
        self._note(f"{job.label}: begun {started_at}, process {os.getpid()} on {platform.node()}")
        try:
            with interruptible(job.limit, layout.overdue(job.run_id, job.key), self.own_process):
                require_whole(layout, job.inputs.values())
                search_beside(job.folders)
                declare_from(job.task, job.settings)
                stage: Stage = load_target(job.stage)()
                keep_memory()
                set_threads(getattr(stage, "torch_threads", 1))
                given = _stage_job(job, layout, stage, staging, progress)
                with placed(_clone_of(job, layout)):
                    summary = finite(dict(stage.run(given) or {}))
                if given.axes is not job.axes:  # the severity of the job is `auto`
                    summary[SEVERITY] = given.axes["value"]
            changed = _change_of_source(job)
            if changed is not None:
                raise changed
            seconds = time.monotonic() - began
            artifact.commit(
                layout, job.kind, job.key, staging, manifest_of(job, summary, seconds, started_at)
            )
        except (Exception, SystemExit) as error:
            artifact.discard(staging)
            # If a module was saved meanwhile, that explains the error better than the error itself;
            # the log has both.
            changed = _change_of_source(job, error)
            if changed is not None:
                traceback.print_exception(error)
                error = changed
            return self._explained(error)
        except BaseException:  # Ctrl-C in the process that runs nodes itself
            artifact.discard(staging)
            raise
        layout.failure(job.key).unlink(missing_ok=True)
        artifact.discard(layout.work(job.key))
        self._note(f"{job.label}: done in {duration(seconds)}")
        return self._result("done", summary=summary)

    def _note(self, text: str) -> None:
        """Add a line to the log. If the disk is full, the node does not fail here, but when it
        stores its result.
        """
        _flush()
        with suppress(OSError), self.log.open("a", encoding="utf-8") as file:
            file.write(f"{text}\n")

    def _explained(self, error: BaseException) -> NodeResult:
        """The failure of a stage as one message; the log has the traceback."""
        if isinstance(error, WaspError):
            print(f"error: {error.message}", file=sys.stderr)
            if error.hint:
                print(error.hint, file=sys.stderr)
            by_chance = isinstance(error, StoreError | EnvironmentDied)
            return self._failed(error.message, error.hint, by_chance=by_chance)
        traceback.print_exception(error)
        frames = traceback.extract_tb(error.__traceback__)
        place = f" ({Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""
        text = " ".join(str(error).split()) or "no message"
        return self._failed(f"{type(error).__name__}: {text[:300]}{place}", by_chance=True)

    def _failed(
        self, message: str, hint: str | None = None, *, by_chance: bool = False
    ) -> NodeResult:
        result = self._result("failed", message=message, hint=hint, by_chance=by_chance)
        record_failure(self.layout, self.job, result)
        return result


def unclosed_file(layout: Layout, job: NodeJob) -> Path:
    """Return the path of the file that is not empty if a node's process was ended because an
    environment did not come back from its `close()`.
    """
    return layout.overdue(job.run_id, job.key).with_suffix(".unclosed")


def _clone_of(job: NodeJob, layout: Layout) -> PlacedClone | None:
    """The clone of a person that a node needs, with the person's commands if they drove the cell;
    None if it needs none.
    """
    if OPERATOR_CLONE not in job.inputs:
        return None
    folder = layout.artifact(*job.inputs[OPERATOR_CLONE])
    if job.axes.get("operator") != PERSON:
        return PlacedClone(folder)
    # Imported here: plans import this module, and do not need pyarrow.
    from wasp_cli.store.recorded import read_recorded
    from wasp_cli.store.tables import cell_file

    commands = read_recorded(cell_file(layout.artifact(*job.inputs["evaluate"])))["a_h"]
    by_seed = {
        seeds.operator_seed(job.task, PERSON, job.seed, e): of_episode
        for e, of_episode in enumerate(commands)
    }
    return PlacedClone(folder, by_seed)


def require_whole(layout: Layout, inputs: Iterable[tuple[str, str]]) -> None:
    """Check that inputs (kind and key) have the bytes of their manifests. Inputs that do not are
    taken out of use, so that the next run computes them again; what a person drove stays.

    Raises:
        ArtifactError: an input is damaged, or lacks steps.
    """
    for kind, key in inputs:
        what = "damaged"
        why = artifact.corruption(layout, kind, key)
        if why is None and without_steps(artifact.read_manifest(layout, kind, key)):
            what = "not whole"
            why = WITHOUT_STEPS
        if why is None:
            continue
        if (layout.artifact(kind, key) / SESSION_FILE).exists():
            raise ArtifactError(
                f"what a person drove is {what}: {why}",
                "bring it back from a copy of the results folder",
            )
        artifact.invalidate(layout, kind, key, why)
        raise ArtifactError(
            f"an input is {what}: {why}", f"run again: what is {what} is computed again"
        )


def _change_of_source(job: NodeJob, error: BaseException | None = None) -> SourceChanged | None:
    """The error if the code that ran is not that of the key: a module may have been saved between
    planning and its import here. None if `error` is this one already, or says that the modules are
    not here at all.
    """
    changed = changed_since(job.sources)
    if isinstance(error, SourceChanged):
        return None
    tops = {re.split(r"[.:]", name)[0] for name in changed}
    if isinstance(error, WaspError) and not any(map(find_spec, tops)):
        return None
    if not changed:
        return None
    return SourceChanged(
        f"the source changed during the run: {', '.join(changed)}",
        "run again; results that the change does not affect are kept",
    )


def _stage_job(
    job: NodeJob, layout: Layout, stage: Stage, staging: Path, progress: Progress
) -> Job:
    work = layout.work(job.key)
    work.mkdir(exist_ok=True)
    inputs = {name: layout.artifact(kind, key) for name, (kind, key) in job.inputs.items()}
    earlier = None
    # The first episodes of a cell, unless they were removed or damaged since the plan, or lack
    # steps.
    if job.earlier is not None and artifact.corruption(layout, job.kind, job.earlier) is None:
        manifest = artifact.read_manifest(layout, job.kind, job.earlier)
        if not without_steps(manifest):
            earlier = layout.artifact(job.kind, job.earlier)
    return Job(
        job.kind,
        job.task,
        job.seed,
        stage.config.model_validate(job.config),
        settings_of(job.settings),
        with_severity(job.axes, inputs),
        inputs,
        staging,
        work,
        progress,
        earlier,
        job.threads,
    )


def settings_of(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a node as its stage reads them: sections as config models."""
    settings = dict(values)
    for name, value in values.items():
        if name == ENVIRONMENT:  # of the task, and no field of a spec
            continue
        annotation = Spec.model_fields[name].annotation
        if isinstance(annotation, type) and issubclass(annotation, Config):
            settings[name] = annotation.model_validate(value)
    return settings


def manifest_of(
    job: NodeJob, summary: Mapping[str, Any], seconds: float, started_at: str
) -> dict[str, Any]:
    """Return the manifest of a computed node, except for its files: what it is, what it was
    computed from and by which code, its numbers, and where and when it was computed.
    """
    optional = {"cuda": cuda_devices(), EARLIER: job.earlier}
    return {
        "kind": job.kind,
        "key": job.key,
        "label": job.label,
        "task": job.task,
        "seed": job.seed,
        "axes": job.axes,
        "config": job.config,
        "settings": job.settings,
        "upstream": {name: key for name, (_, key) in job.inputs.items()},
        "upstream_kinds": {name: kind for name, (kind, _) in job.inputs.items()},
        "sources": job.sources,
        "summary": summary,
        "provenance": {
            **job.provenance,
            **machine(),
            **{name: value for name, value in optional.items() if value},
            "run": job.run_id,
            "attempt": job.attempt,
            "threads": job.threads,
            "started_at": started_at,
            "seconds": round(seconds, 3),
        },
    }


def record_failure(layout: Layout, job: NodeJob, result: NodeResult) -> None:
    """Write a record of why a node failed, and how often it was tried."""
    record = {
        "kind": job.kind,
        "label": job.label,
        "message": result.message,
        "hint": result.hint,
        "log": result.log,
    }
    # If the disk is full or the folder was moved, the result and the journal still say why.
    with suppress(OSError):
        records.replace_file(
            layout.failure(job.key),
            records.dumps({**record, "attempt": job.attempt, "run": job.run_id}),
        )


def attempts(layout: Layout, key: str) -> int:
    """Return how often a node was tried without success."""
    try:
        record = records.read_record(layout.failure(key))
        return 0 if record is None else int(record.get("attempt", 1))
    except (ArtifactError, TypeError, ValueError):  # it failed; how often is lost
        return 1


def finite(value: Any, name: str = "summary") -> Any:
    """Return a summary as JSON values: numpy's numbers become Python's, NaN and infinity become
    None.

    Raises:
        TrainingError: it has other values.
    """
    if isinstance(value, Mapping):
        return {str(part): finite(item, str(part)) for part, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item, name) for item in value]
    if hasattr(value, "item"):  # a scalar of numpy or torch
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if value is None or isinstance(value, str | int | float):
        return value
    raise TrainingError(
        f"the stage returned {type(value).__name__} as '{name}'; only JSON values can be stored"
    )


def set_threads(count: int) -> None:
    """Let linear algebra use this number of threads, in libraries that are loaded and in those that
    are loaded later.
    """
    os.environ.update(
        OMP_NUM_THREADS=str(count), MKL_NUM_THREADS=str(count), OPENBLAS_NUM_THREADS="1"
    )
    threadpool_limits({"openmp": count, "blas": 1})
    torch = sys.modules.get("torch")
    if torch is not None:
        torch.set_num_threads(count)


@contextmanager
def _logged(stream: TextIO, own_process: bool) -> Iterator[None]:
    """Send everything that is printed to the log; in a process of its own also what C libraries
    print.
    """
    if not own_process:
        with redirect_stdout(stream), redirect_stderr(stream):
            yield
        return
    saved = [(number, os.dup(number)) for number in (1, 2)]
    printing = [each for each in (sys.stdout, sys.stderr) if isinstance(each, io.TextIOWrapper)]
    line_by_line = [each.line_buffering for each in printing]
    try:
        _flush()
        # A log is read while its node runs, so that lines must not wait in a buffer.
        for each in printing:
            each.reconfigure(line_buffering=True)
        for number, _ in saved:
            os.dup2(stream.fileno(), number)
        yield
    finally:
        _flush()
        for each, buffering in zip(printing, line_by_line, strict=True):
            each.reconfigure(line_buffering=buffering)
        for number, copy in saved:
            os.dup2(copy, number)
            os.close(copy)


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:
            stream.flush()


# parameters of glibc's mallopt(3)
TRIM_THRESHOLD = -1
MMAP_THRESHOLD = -3
LARGEST = 32 * 1024**2  # blocks up to this size, in bytes, come from the heap; glibc allows no more
KEPT = 1024**3  # free bytes at the end of the heap that are not returned


def keep_memory() -> None:
    """Let the C library keep freed memory instead of returning it to the system.

    A planner allocates and frees the same megabytes hundreds of times per second. By default glibc
    returns them each time, and the system has to clear each page again: up to a third of the time
    of a decision.
    """
    if sys.platform.startswith("linux"):
        with suppress(OSError, AttributeError):  # another C library than glibc
            library = ctypes.CDLL(None)
            library.mallopt(MMAP_THRESHOLD, LARGEST)
            library.mallopt(TRIM_THRESHOLD, KEPT)
