"""Computes stored cells again: do their rows follow from the models beside them, to the bit?

A cell can be computed again if every artifact that it was computed from is in the same folder and
undamaged. The folder is not changed: each cell is written to an empty folder elsewhere, by today's
code. Wall times are not compared, and steps only of the episodes whose steps are stored. Processors
of different makers round differently, after which an episode may take another course, so bits are
compared for one kind of processor. Vector instructions round differently too: a cell that differs
with AVX512 is computed once more with AVX2.

Manifests of the folder import no modules. A cell whose environment or assistant is a module of
one's own is computed again only if a spec of the caller's names the same module.
"""

from __future__ import annotations

import json
import os
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, as_completed
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from wasp_cli.console import duration
from wasp_cli.errors import ArtifactError, UsageError, WaspError, described
from wasp_cli.operators.registry import CLONED, PERSON
from wasp_cli.plan.reasons import library_changes
from wasp_cli.registry import search_beside, searched_beside
from wasp_cli.spec.model import Spec
from wasp_cli.store.artifact import corruption, read_manifest, stored_keys
from wasp_cli.store.layout import Layout
from wasp_cli.store.provenance import processor
from wasp_cli.store.severities import with_severity
from wasp_cli.tasks.declared import ENVIRONMENT, declaration_of, declare_from, text_of
from wasp_cli.tasks.foreign.closing import environments
from wasp_cli.tasks.registry import TASKS

EVALUATE = "evaluate"  # the stage
DEVICE = "WASP_DEVICE"  # the variable that names the device of stages
# the variable of torch's vector instructions, which is read when torch is imported
CAPABILITY = "ATEN_CPU_CAPABILITY"
AVX2 = "avx2"


@dataclass(frozen=True)
class Drawn:
    """The cells that are computed again, and how many are not."""

    cells: tuple[str, ...]
    of: int  # cells that could be computed again
    # of these, cells that another kind of processor computed, and that were left out for that
    elsewhere: int
    # cells of the folder that cannot: something that they were computed from is not there
    others: int


@dataclass(frozen=True)
class Answer:
    """A cell that was computed again."""

    key: str
    label: str
    # names of the columns that are not the same, or `error: ...` if it could not be computed
    differing: tuple[str, ...]
    # libraries of another version than then, which may round differently
    libraries: tuple[str, ...]
    seconds: float
    then: str  # the processor on which the cell was computed; empty if it is not known
    here: str  # the processor on which it was computed again
    # for a cell that differs: return and cost of an episode, then and now
    means: tuple[tuple[str, float, float], ...] = ()
    with_avx2: bool = False


@dataclass(frozen=True)
class OwnCode:
    """The environments and assistants of a spec, which may run because the caller named it."""

    environments: Mapping[str, str]  # by name of a task its declaration, as JSON text
    methods: frozenset[str]

    def has(self, manifest: Mapping[str, Any]) -> bool:
        """Return whether a cell is of a task and a method of the spec, its environment declared
        as there.
        """
        task = manifest["task"]
        method = manifest["axes"]["method"]
        if task not in self.environments or method not in self.methods:
            return False
        stored = manifest["settings"].get(ENVIRONMENT)
        return json.dumps(stored, sort_keys=True) == self.environments[task]


def own_code(spec: Spec) -> OwnCode:
    """Return what a spec that was loaded in this process names."""
    tasks = {name: text_of(declaration_of(name)) for name in spec.tasks}
    return OwnCode(tasks, frozenset(spec.methods))


def draw(
    layout: Layout, cells: int, seed: int, *, anywhere: bool = False, own: OwnCode | None = None
) -> Drawn:
    """Draw from the cells that this kind of processor computed; from all where there is none,
    or with `anywhere`. With `own` only cells of that spec's tasks and methods are drawn.

    Raises:
        UsageError: no cell of the folder can be computed again.
    """
    import numpy as np

    reasons = {key: why_not(layout, key, own) for key in sorted(stored_keys(layout, EVALUATE))}
    keys = list(reasons)
    possible = [key for key, reason in reasons.items() if reason is None]
    if not possible:
        reason = f": {reasons[keys[0]]}" if keys else ""
        raise UsageError(
            f"'{layout.root}' has no cell that can be computed again from what is there{reason}",
            "name a folder with models; --spec SPEC names environments and assistants of your own",
        )
    here = [
        key
        for key in possible
        if kind(computed_on(read_manifest(layout, EVALUATE, key))) == kind(processor())
    ]
    among = possible if anywhere or not here else here
    drawn = np.random.default_rng(seed).choice(len(among), min(cells, len(among)), replace=False)
    return Drawn(
        tuple(among[i] for i in sorted(drawn)),
        len(possible),
        len(possible) - len(among),
        len(keys) - len(possible),
    )


def computed_on(manifest: Mapping[str, Any]) -> str:
    """Return the processor that a manifest names; empty if it names none."""
    provenance = manifest.get("provenance")
    return str(provenance.get("processor", "")) if isinstance(provenance, dict) else ""


def kind(name: str) -> str:
    """Return the name of a processor without its vector instructions."""
    return name.partition(",")[0]


def why_not(layout: Layout, key: str, own: OwnCode | None = None) -> str | None:
    """Return why a cell cannot be computed again from its folder; None if it can."""
    try:
        manifest = read_manifest(layout, EVALUATE, key)
        if manifest["axes"]["operator"] in (PERSON, CLONED):
            return "a person drove in it"
        if own is not None and not own.has(manifest):
            return "the spec has no such task or method, or declares the environment otherwise"
        # Such a module could be part of the folder, which may be untrusted.
        is_module = ":" in manifest["axes"]["method"] or manifest["task"] not in TASKS
        if own is None and is_module:
            return "its assistant or its task is a module of one's own"
        for name, upstream in manifest["upstream"].items():
            damage = corruption(layout, manifest["upstream_kinds"][name], upstream)
            if damage is not None:
                return damage
    except (ArtifactError, LookupError, TypeError, AttributeError) as error:
        return str(error)
    return None


def verify(
    layout: Layout, keys: Sequence[str], jobs: int, own: OwnCode | None = None
) -> Iterator[Answer]:
    """Compute cells again in up to `jobs` processes, and yield each as it ends. With `own` they are
    cells of that spec, and its modules run.

    Raises:
        WaspError: a worker process was killed.
    """
    with_avx512: list[str] = []  # cells that differ, perhaps because of these instructions
    beside = None if own is None else searched_beside()
    try:
        for answer in _answers(layout, keys, jobs, {}, beside):
            may_try_avx2 = "AVX512" in answer.here and CAPABILITY not in os.environ
            if answer.means and kind(answer.then) == kind(answer.here) and may_try_avx2:
                with_avx512.append(answer.key)
            else:
                yield answer
        if with_avx512:
            for answer in _answers(layout, with_avx512, jobs, {CAPABILITY: AVX2}, beside):
                yield replace(answer, with_avx2=True)
    except BrokenExecutor as error:
        raise WaspError(
            "a worker process was killed (out of memory, or by a signal)",
            "-j N computes fewer cells at once",
        ) from error


def _answers(
    layout: Layout,
    keys: Sequence[str],
    jobs: int,
    environment: dict[str, str],
    beside: Sequence[str] | None,
) -> Iterator[Answer]:
    """Compute cells in processes that end when the caller stops asking; with one job, in this
    process.
    """
    from joblib.externals.loky import ProcessPoolExecutor

    from wasp_cli.run.pools.local import start_worker
    from wasp_cli.run.shared_memory import require_semaphores
    from wasp_cli.run.signals import signals_wait

    with tempfile.TemporaryDirectory(prefix="wasp-verify-") as folder:
        if jobs == 1 and not environment:
            yield from (again(layout.root, key, Path(folder), beside) for key in keys)
            return
        require_semaphores(jobs)
        workers = ProcessPoolExecutor(
            jobs, env=environment, initializer=start_worker, initargs=(os.getpid(),)
        )
        try:
            with signals_wait():
                running = [
                    workers.submit(again, layout.root, key, Path(folder), beside) for key in keys
                ]
            for done in as_completed(running):
                yield done.result()
        finally:
            workers.shutdown(kill_workers=True)


def again(root: Path, key: str, within: Path, beside: Sequence[str] | None = None) -> Answer:
    """Compute a cell again in an empty folder below `within`, and compare it with the stored one.
    A cell whose stage fails has `error: ...` in `Answer.differing`.

    Args:
        root: the results folder.
        key: of the cell.
        within: an empty folder elsewhere; nothing of it stays.
        beside: folders in which modules of one's own are looked for; None where none may run.

    Raises:
        ArtifactError: the manifest of the cell cannot be read.
    """
    from wasp_cli.registry import load_target
    from wasp_cli.run.worker import set_threads, settings_of
    from wasp_cli.stages.base import Job, Stage
    from wasp_cli.stages.registry import STAGES

    layout = Layout(root)
    began = time.monotonic()
    asked = os.environ.get(DEVICE, "")
    manifest = read_manifest(layout, EVALUATE, key)
    libraries: tuple[str, ...] = ()
    means: tuple[tuple[str, float, float], ...] = ()
    then = ""
    inputs = {
        name: layout.artifact(manifest["upstream_kinds"][name], upstream)
        for name, upstream in manifest["upstream"].items()
    }
    stage: Stage = load_target(STAGES[EVALUATE].target)()
    set_threads(getattr(stage, "torch_threads", 1))
    with tempfile.TemporaryDirectory(dir=within) as folder:
        out = Path(folder)
        try:
            # A GPU rounds differently: a cell that a CPU has computed is computed on a CPU again.
            # An empty value counts as unset.
            device = "" if manifest["provenance"].get("cuda") else "cpu"
            os.environ[DEVICE] = asked or device
            libraries = tuple(library_changes(manifest))
            then = computed_on(manifest)
            if beside is not None:
                search_beside(beside)
                declare_from(manifest["task"], manifest["settings"])
            job = Job(
                EVALUATE,
                manifest["task"],
                manifest["seed"],
                stage.config.model_validate(manifest["config"]),
                settings_of(manifest["settings"]),
                with_severity(manifest["axes"], inputs),
                inputs,
                out,
                out,
            )
            with environments():
                stage.run(job)
            stored = layout.artifact(EVALUATE, key)
            differing = tuple(differences(stored, out))
            means = tuple(means_of(stored, out)) if differing else ()
        except Exception as error:
            # damaged, of another version, or of a plugin that is not here: one cell ends no draw
            differing = (
                f"error: {error.message if isinstance(error, WaspError) else described(error)}",
            )
        finally:
            os.environ[DEVICE] = asked
    return Answer(
        key,
        str(manifest.get("label", key)),
        differing,
        libraries,
        time.monotonic() - began,
        then,
        processor(),
        means,
    )


def show_answer(answer: Answer, console: Console) -> None:
    """Print whether a cell is the same to the bit, and if not, what differs and where it was
    computed.
    """
    text = f"{'other' if answer.differing else 'same'}   {answer.label}  {duration(answer.seconds)}"
    if answer.with_avx2:
        text += "  with AVX2"
    if answer.differing:
        differing = ", ".join(answer.differing)
        if answer.means:
            means = [f"{name} {then:.2f} then, {now:.2f} now" for name, then, now in answer.means]
            text += f"  {'; '.join(means)}  (differ: {differing})"
        else:
            text += f"  {differing}"
        places = list(answer.libraries)
        if kind(answer.then) != kind(answer.here):
            places.append(f"computed on {answer.then}, here {answer.here}")
        if places:
            text += f"  ({'; '.join(places)})"
    console.print(text, markup=False, highlight=False, soft_wrap=True)


def means_of(stored: Path, computed: Path) -> Iterator[tuple[str, float, float]]:
    """Yield return and cost of an episode of a cell, as they are stored and as they are
    computed.
    """
    import pyarrow.compute as pc

    from wasp_cli.store.tables import cell_file, read_episodes

    then, now = (read_episodes([cell_file(folder)]) for folder in (stored, computed))
    for name in ("return", "cost"):
        yield name, pc.mean(then[name]).as_py(), pc.mean(now[name]).as_py()


def differences(stored: Path, computed: Path) -> list[str]:
    """Return the columns of the rows of a cell, and of its steps as far as they ship, that are
    not the same to the bit.
    """
    import pyarrow.compute as pc

    from wasp_cli.store.tables import (
        TIMING,
        cell_file,
        lacking,
        read_episodes,
        read_steps,
        read_version,
    )

    paths = [cell_file(folder) for folder in (stored, computed)]
    added = lacking(min(map(read_version, paths)))
    then, now = (read_episodes([path]) for path in paths)
    names = [
        name
        for name in then.column_names
        if name not in (*TIMING, *added) and not then[name].equals(now[name])
    ]
    then, now = (read_steps(path) for path in paths)
    now = now.filter(pc.is_in(now["episode"], then["episode"].unique()))
    # Undefined numbers are equal, whatever the chunks.
    return names + [
        f"steps.{name}"
        for name in then.column_names
        if not then[name].combine_chunks().equals(now[name].combine_chunks())
    ]
