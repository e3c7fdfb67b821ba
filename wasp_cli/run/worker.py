"""The envelope around one node: lock, threads, log, folders, outcome. It never raises; what it returns says how the node ended."""

from __future__ import annotations

import math
import os
import sys
import time
import traceback
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TextIO

from wasp_cli.config import Config
from wasp_cli.errors import ArtifactError, SourceChanged, StoreError, TrainingError, WaspError
from wasp_cli.memory import keep_memory
from wasp_cli.plan.closure import changed_since
from wasp_cli.registry import load_target
from wasp_cli.run.limit import limited
from wasp_cli.run.order import Order, Outcome
from wasp_cli.run.pulse import Pulse
from wasp_cli.spec.model import Spec
from wasp_cli.stages.base import Job, Progress, Stage
from wasp_cli.store.artifact import (
    condemn,
    corruption,
    discard,
    is_published,
    publish,
    read_manifest,
    read_record,
    staging_folder,
    write_record,
)
from wasp_cli.store.layout import Layout
from wasp_cli.store.lock import Busy, held
from wasp_cli.store.provenance import cuda_devices

DEATHS = 2
"""Killed processes after which a node has failed."""
KILLED = "its process was killed, twice (out of memory, or by a signal)"


def execute(order: Order, *, own_process: bool = True) -> Outcome:
    """Compute one node, or find that another run has.

    Args:
        order: the node.
        own_process: whether this process does nothing else, so that its file descriptors may go to the log.
    """
    started = time.monotonic()
    layout = Layout(Path(order.root))
    log = layout.log(order.run_id, order.label, order.key)
    if layout.stop(order.run_id).exists():
        return Outcome(order.key, "skipped", 0.0)
    try:
        log.parent.mkdir(parents=True, exist_ok=True)
        with ExitStack() as stack:
            stream = stack.enter_context(log.open("a", encoding="utf-8", errors="replace", buffering=1))
            stack.enter_context(_logged(stream, own_process))
            return _locked(order, layout, log, started, own_process)
    except OSError as error:  # the results folder itself is in the way: full, gone, read-only
        return _failed(order, started, log, f"{type(error).__name__}: {error}", None, by_chance=True)
    except Exception as error:
        return _failed(order, started, log, f"{type(error).__name__}: {error}", None)


def _locked(order: Order, layout: Layout, log: Path, started: float, own_process: bool) -> Outcome:
    with Pulse(layout.running(order.run_id, order.key), order) as pulse:
        if pulse.deaths >= DEATHS:
            outcome = _failed(order, started, log, KILLED, None)
            record_failure(layout, order, outcome)
            return outcome

        def waiting() -> bool:
            pulse.tell(0.0, "another run computes it; waiting")
            return order.wait and not layout.stop(order.run_id).exists()

        try:
            with held(layout.lock(order.key), waiting, pulse.fixed):
                if not is_published(layout, order.kind, order.key):
                    return _computed(order, layout, log, started, pulse, own_process)
                summary = read_manifest(layout, order.kind, order.key).get("summary", {})
                return Outcome(order.key, "shared", time.monotonic() - started, summary, log=str(log))
        except Busy:
            return Outcome(order.key, "skipped" if order.wait else "busy", time.monotonic() - started)


def _computed(order: Order, layout: Layout, log: Path, started: float, pulse: Pulse, own_process: bool) -> Outcome:
    staging = staging_folder(layout, order.key)
    started_at = datetime.now(UTC).isoformat(timespec="seconds")
    began = time.monotonic()
    try:
        with limited(order.limit, layout.overdue(order.run_id, order.key), own_process):
            _require_inputs(order, layout)
            stage: Stage = load_target(order.stage)()
            keep_memory()
            _set_threads(getattr(stage, "torch_threads", 1))
            summary = _finite(stage.run(_job(order, layout, stage, staging, pulse.tell)))
        _require_planned_source(order)
        seconds = time.monotonic() - began
        publish(layout, order.kind, order.key, staging, _manifest(order, summary, seconds, started_at))
    except (Exception, SystemExit) as error:
        discard(staging)
        return _recorded_failure(order, layout, log, started, _cause_in_source(order, error) or error)
    except BaseException:  # Ctrl-C in the process that runs nodes itself
        discard(staging)
        raise
    layout.failure(order.key).unlink(missing_ok=True)
    discard(layout.work(order.key))
    return Outcome(order.key, "done", time.monotonic() - started, summary, log=str(log))


def _require_inputs(order: Order, layout: Layout) -> None:
    """See that what the node reads has the bytes that were published; what has not is computed again by the next run."""
    for kind, key in order.inputs.values():
        wrong = corruption(layout, kind, key)
        if wrong is not None:
            condemn(layout, kind, key, wrong)
            raise ArtifactError(f"what it reads is damaged: {wrong}", "run again: what is damaged is computed again")


def _require_planned_source(order: Order) -> None:
    """See that what ran is what the key says: a module may have been saved between planning and its import here."""
    if changed := changed_since(order.sources):
        raise SourceChanged(
            f"the source changed while the run was going: {', '.join(changed)}", "run again; what the change does not touch is kept"
        )


def _cause_in_source(order: Order, error: BaseException) -> SourceChanged | None:
    """A module that was saved meanwhile explains any error, and better than the error does; the log keeps both."""
    if isinstance(error, SourceChanged):
        return None
    try:
        _require_planned_source(order)
    except SourceChanged as changed:
        traceback.print_exception(error)
        return changed
    return None


def _job(order: Order, layout: Layout, stage: Stage, staging: Path, progress: Progress) -> Job:
    work = layout.work(order.key)
    work.mkdir(parents=True, exist_ok=True)
    return Job(
        kind=order.kind,
        task=order.task,
        seed=order.seed,
        config=stage.config.model_validate(order.config),
        settings=_settings(order.settings),
        axes=order.axes,
        inputs={name: layout.artifact(kind, key) for name, (kind, key) in order.inputs.items()},
        out_dir=staging,
        work_dir=work,
        progress=progress,
        threads=order.threads,
    )


def _settings(values: Mapping[str, Any]) -> dict[str, Any]:
    """Shared settings as the spec holds them: sections are models again."""
    settings = dict(values)
    for name, value in values.items():
        annotation = Spec.model_fields[name].annotation
        if isinstance(annotation, type) and issubclass(annotation, Config):
            settings[name] = annotation.model_validate(value)
    return settings


def _manifest(order: Order, summary: Mapping[str, Any], seconds: float, started_at: str) -> dict[str, Any]:
    return {
        "kind": order.kind,
        "key": order.key,
        "label": order.label,
        "task": order.task,
        "seed": order.seed,
        "axes": order.axes,
        "config": order.config,
        "settings": order.settings,
        "upstream": {name: key for name, (_, key) in order.inputs.items()},
        "upstream_kinds": {name: kind for name, (kind, _) in order.inputs.items()},
        "sources": order.sources,
        "summary": summary,
        "provenance": {
            **order.provenance,
            **({"cuda": devices} if (devices := cuda_devices()) else {}),
            "run": order.run_id,
            "attempt": order.attempt,
            "threads": order.threads,
            "started_at": started_at,
            "seconds": round(seconds, 3),
        },
    }


def _recorded_failure(order: Order, layout: Layout, log: Path, started: float, error: BaseException) -> Outcome:
    if isinstance(error, WaspError):
        message, hint = error.message, error.hint
        print(f"error: {message}" + (f"\n{hint}" if hint else ""), file=sys.stderr)
    else:
        message, hint = _cause(error), None
        traceback.print_exception(error)
    by_chance = not isinstance(error, WaspError) or isinstance(error, StoreError)
    outcome = _failed(order, started, log, message, hint, by_chance=by_chance)
    record_failure(layout, order, outcome)
    return outcome


def record_failure(layout: Layout, order: Order, outcome: Outcome) -> None:
    """Keep why a node failed, so that the next plan can say so."""
    record = {"kind": order.kind, "label": order.label, "message": outcome.message, "hint": outcome.hint, "log": outcome.log}
    with suppress(OSError):  # a full disk: the outcome and the journal of a living run tell it
        write_record(layout.failure(order.key), {**record, "attempt": order.attempt, "run": order.run_id})


def attempts(layout: Layout, key: str) -> int:
    """How often a node has failed since it last succeeded."""
    try:
        record = read_record(layout.failure(key))
    except ArtifactError:  # it failed; how often is lost
        return 1
    attempt = 0 if record is None else record.get("attempt", 1)
    return attempt if isinstance(attempt, int) else 1


def _failed(order: Order, started: float, log: Path, message: str, hint: str | None, *, by_chance: bool = False) -> Outcome:
    seconds = time.monotonic() - started
    return Outcome(order.key, "failed", seconds, message=message, hint=hint, log=str(log), by_chance=by_chance)


def _cause(error: BaseException) -> str:
    """One line that names an unexpected error and where it was raised."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""
    text = " ".join(str(error).split()) or "no message"
    return f"{type(error).__name__}: {text[:300]}{place}"


def _finite(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Summary numbers as JSON values: numpy's become Python's, and what is not finite becomes null."""
    return {str(name): _plain(value, str(name)) for name, value in summary.items()}


def _plain(value: Any, name: str) -> Any:
    if isinstance(value, Mapping):
        return _finite(value)
    if isinstance(value, list | tuple):
        return [_plain(item, name) for item in value]
    if hasattr(value, "item"):  # a scalar of numpy or torch
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if value is None or isinstance(value, str | int | float):
        return value
    raise TrainingError(f"the stage returned {type(value).__name__} as '{name}', which has no JSON form")


def _set_threads(count: int) -> None:
    """Threads of linear algebra: a constant of the stage, since another number may give other bytes."""
    os.environ.update(OMP_NUM_THREADS=str(count), MKL_NUM_THREADS=str(count), OPENBLAS_NUM_THREADS="1")
    if (torch := sys.modules.get("torch")) is not None:
        torch.set_num_threads(count)


@contextmanager
def _logged(stream: TextIO, own_process: bool) -> Iterator[None]:
    """Send everything that is printed to the log, from C libraries too where the process is ours."""
    if not own_process:
        with redirect_stdout(stream), redirect_stderr(stream):
            yield
        return
    saved = [(number, os.dup(number)) for number in (1, 2)]
    try:
        _flush()
        for number, _ in saved:
            os.dup2(stream.fileno(), number)
        yield
    finally:
        _flush()
        for number, copy in saved:
            os.dup2(copy, number)
            os.close(copy)


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:
            stream.flush()
