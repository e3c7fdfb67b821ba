"""What `wasp drive` does with its options: it finds the spec, serves the page, prints the end of a
session, and deletes the data of a participant.
"""

from __future__ import annotations

import asyncio
import shutil
import threading
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wasp_cli.console import count_table, plain, say
from wasp_cli.drive.block import SHOWN, How
from wasp_cli.drive.check import TOLERATED, Habits, drive, warning
from wasp_cli.drive.desk import END, Desk
from wasp_cli.drive.participants import (
    cells_of,
    driven,
    driven_by,
    drivers,
    free_session,
    ordered,
    participants,
)
from wasp_cli.drive.prepare import prepared, shipped
from wasp_cli.drive.server import Server
from wasp_cli.drive.session import Session
from wasp_cli.errors import Interrupted, StoreError, UnknownName, UsageError
from wasp_cli.methods.registry import METHODS
from wasp_cli.plan.grid import together
from wasp_cli.plan.node import Cell, Node, with_upstream
from wasp_cli.plan.plan import plan_against
from wasp_cli.plan.reuse import lay_out_over
from wasp_cli.report.tables import who_title
from wasp_cli.run.cores import cores
from wasp_cli.run.record import new_run
from wasp_cli.run.session import RunOptions
from wasp_cli.spec.load import Loaded, load, sized
from wasp_cli.spec.shipped import SUFFIX, shipped_names, spec_path
from wasp_cli.store.artifact import discard, exists, read_manifest, stored_keys, stored_kinds
from wasp_cli.store.layout import Layout
from wasp_cli.store.lock import is_held
from wasp_cli.store.people import SESSION_FILE
from wasp_cli.store.reached import reached
from wasp_cli.store.records import read_record
from wasp_cli.tasks.registry import TASKS, is_foreign

if TYPE_CHECKING:
    from rich.table import Table

NONE = "none"
WAITED = 20.0  # ms that decisions may begin after their beat (median) without a warning


@dataclass(frozen=True)
class Wanted:
    """The options of `wasp drive`, as they were given; None is not given."""

    what: str
    method: str | None
    participant: int | None
    episodes: int | None
    session: int | None
    speed: float | None
    hide: tuple[str, ...]
    preset: str | None
    settings: tuple[str, ...]
    results: Path
    jobs: int | None
    simulated: bool = False

    @property
    def _is_task(self) -> bool:
        return self.what in TASKS and not Path(self.what).is_file()

    def prepared(self, *, recorded: bool = True) -> Session:
        """Return a session with its cells and models ready (`prepare.prepared`, which explains
        `recorded`). Raises UnknownName if something to hide is unknown.
        """
        for name in self.hide:
            if name not in SHOWN:
                raise UnknownName("thing to hide", name, SHOWN)
        loaded = self.loaded()
        study = loaded.spec.study
        shown = frozenset(SHOWN if study is None else study.shown) - set(self.hide)
        speed = self.speed or (1.0 if study is None else study.speed)
        options = RunOptions(cores() if self.jobs is None else self.jobs)
        how = How(speed, shown, simulated=self.simulated)
        trains = not self._is_task or self.preset is not None
        return prepared(
            loaded, self.results, options, self.participant, how, recorded=recorded, trains=trains
        )

    def everyone(self) -> list[Wanted]:
        """Return one of these for each participant of a spec; if it names a task or a participant,
        only itself. Raises UsageError if nobody drives.
        """
        if self._is_task or self.participant is not None:
            return [self]
        return [replace(self, participant=number) for number in sorted(drivers(self.loaded().spec))]

    def orders(self) -> Table:
        """Return the order in which each participant drives their cells, as a table. Nothing is
        computed.
        """
        loaded = self.loaded()
        grid = lay_out_over(loaded.spec, Layout(self.results.absolute()), None)
        orders = {
            number: ordered(cells_of(grid, number), number)
            for number in sorted(drivers(loaded.spec))
        }
        table = count_table(
            "participant", *(str(place + 1) for place in range(max(map(len, orders.values()))))
        )
        for number, cells in orders.items():
            several = len({(cell.task, cell.seed) for cell, _ in cells}) > 1
            names = []
            for cell, _ in cells:
                name = who_title(cell.method, cell.variant)
                if several:
                    name = f"{cell.task} s{cell.seed} {name}"
                names.append(name)
            table.add_row(participants(loaded.spec)[number], *names)
        return table

    def loaded(self) -> Loaded:
        """Return the spec that is meant: the file, or the shipped one with the task, method,
        participant and session.

        Raises:
            UsageError: an option is only for tasks, or the task has no published models.
            UnknownName: there is no such task, spec or method.
        """
        if not self._is_task:
            self._require_spec()
            for name, value in (("--method", self.method), ("--session", self.session)):
                if value is not None:
                    raise UsageError(
                        f"{name} is for a task, but '{self.what}' is a spec, which sets it",
                        "change the spec, or use --set",
                    )
            episodes = [] if self.episodes is None else [f"episodes={self.episodes}"]
            return load(Path(self.what), [*episodes, *sized(self.preset, self.settings)])
        session = self.session
        if session is None:
            layout = Layout(self.results.absolute())
            session = free_session(layout, lambda number: self._of([number]))
        return self._of([session])

    def _require_spec(self) -> None:
        if spec_path(Path(self.what)).exists():
            return
        if is_foreign(Path(self.what).name):
            raise UsageError(
                f"'{self.what}' is an environment of another package: wasp ships no models for it",
                "write a spec that trains them, with operators: {person: {p1: 1}} and "
                f"side_by_side: 1, and drive that; tasks with models: {', '.join(TASKS)}",
            )
        if Path(self.what).name == self.what and not self.what.endswith(SUFFIX):
            raise UnknownName("task or spec", self.what, [*TASKS, *shipped_names()])

    def _of(self, seeds: Sequence[int]) -> Loaded:
        """The shipped spec with this task, method and participant, and sessions as seeds."""
        number = self.participant or 0
        method = "human" if self.method == NONE else self.method or "wasp"
        if method not in METHODS or not METHODS[method].impaired:
            raise UnknownName(
                "method to drive with",
                method,
                [*(name for name in METHODS if METHODS[name].impaired), NONE],
            )
        if any(setting.partition("=")[0].strip() == "seeds" for setting in self.settings):
            raise UsageError(
                "the seed of a session is its number",
                "leave out --set seeds=..., and choose the session with --session N",
            )
        episodes = [] if self.episodes is None else [f"episodes={self.episodes}"]
        return shipped(self.what, [method], number, seeds, self.preset, [*episodes, *self.settings])

    def record(self, session: Session) -> None:
        """Write a run with everything that anybody drove on tasks with these settings so far, for
        reports: a report shows the last run. A spec has a run of its own.
        """
        if not self._is_task:
            return
        layout = session.layout

        # The sessions that were driven outside of studies: by episodes, task, method and
        # participant.
        sessions = defaultdict[tuple[Any, ...], set[int]](set)
        for key, manifest in driven(layout):
            axes = manifest["axes"]
            facts = read_record(layout.artifact("evaluate", key) / SESSION_FILE) or {}
            if manifest["task"] in TASKS and axes["method"] in METHODS and not facts.get("study"):
                condition = (
                    manifest["config"]["episodes"],
                    manifest["task"],
                    axes["method"],
                    int(axes["value"]),
                )
                sessions[condition].add(manifest["seed"])

        # Their cells. They are sorted by episodes, so that a whole sitting replaces its first part.
        grids = []
        cells = dict[Cell, Node]()
        for (episodes, task, method, number), seeds in sorted(sessions.items()):
            asked = replace(
                self, what=task, method=method, participant=number, episodes=episodes
            )._of(sorted(seeds))
            grids.append(lay_out_over(asked.spec, layout, None))
            cells |= {
                cell: node for cell, node in grids[-1].cells if exists(layout, node.kind, node.key)
            }
        if not cells:
            return

        # A run of all of them.
        grid = replace(
            together(grids),
            cells=tuple(cells.items()),
            nodes=tuple(with_upstream(cells.values())),
        )
        everything = {
            "tasks": tuple(dict.fromkeys(cell.task for cell in cells)),
            "methods": tuple(dict.fromkeys(cell.method for cell in cells)),
            "seeds": tuple(dict.fromkeys(cell.seed for cell in cells)),
        }
        spec = session.loaded.spec.model_copy(update=everything)
        new_run(layout, replace(session.loaded, spec=spec), plan_against(grid, layout))


def drive_session(
    session: Session, port: int, *, open_browser: bool, scripted: Habits | None = None
) -> dict[str, Any]:
    """Serve the page until the session is over, and print what was recorded to stderr.

    Args:
        scripted: drives in place of a person; None: a person.

    Returns:
        Run, participant and blocks, as JSON values.

    Raises:
        Interrupted: Ctrl-C ended it; finished episodes are kept.
    """
    # Is this machine fast enough?
    if scripted is None:
        text = warning(session)
        if text is not None:
            plain(f"warning: {text}")

    # The session runs in the clock's thread, and the page in the server's.
    desk = Desk()
    server = Server(desk, port)
    server.start()

    def lead() -> None:
        """Run in the clock's thread; an error there is raised again in the main one."""
        try:
            session.run(desk)
        except BaseException as error:
            session.failure = error
            desk.state(
                "over",
                text="Something went wrong; the terminal says what. Finished episodes are kept.",
                blocks=[],
            )

    clock = threading.Thread(target=lead, daemon=True, name="clock")
    clock.start()
    interrupted = False
    try:
        if scripted is None:
            server.announce("drive", server.address, opened=open_browser)
        else:
            asyncio.run(drive(server.address, scripted.keys, scripted.answers))
        while clock.is_alive():
            clock.join(0.2)
    except KeyboardInterrupt:
        interrupted = True
        desk.ask(END)
        clock.join(30.0)
    finally:
        if desk.present and not interrupted:
            time.sleep(1.0)  # the page shows the end
        server.stop()

    # What was recorded.
    for block in session.done:
        _tell_block(block, session.how.speed)
    if session.failure is not None:
        raise session.failure
    if interrupted:
        raise Interrupted(
            "interrupted: finished episodes are kept", "the same command goes on where it was"
        )
    return {"run": session.run_id, "participant": session.participant, "blocks": session.done}


def _tell_block(block: Mapping[str, Any], speed: float) -> None:
    """Print what was recorded of a block, and warnings if the assistant or the world was slow."""
    episodes = "1 episode" if block["episodes"] == 1 else f"{block['episodes']} episodes"
    if block["episodes"] != block["of"]:
        episodes += f" of {block['of']}: the session ended early"
    late = f"{block['late']} of {block['decisions']} decisions late"
    plain(f"{block['label']}: {episodes}; {late} ({block['key']})")
    if block["late"] > TOLERATED * block["decisions"]:
        plain(
            "warning: nobody assisted in the late ones, and the report says so; try "
            f"--speed {speed / 2:g}"
        )
    behind_ms = block["behind_p50_ms"] or 0.0
    if behind_ms > WAITED:
        plain(
            f"warning: the world slowed down, half of the time by {behind_ms:.0f} ms or more; try "
            f"--speed {speed / 2:g}"
        )


def withdrawn(wanted: Wanted) -> int:
    """Delete everything that a participant drove in the cells of a spec or a task, in any session:
    also their clones and all results computed from any of these.

    Returns:
        How many results and unfinished sessions were deleted.

    Raises:
        UsageError: no participant is named, or they are driving now.
        StoreError: there are no results.
    """
    # Whose data, and where.
    loaded = wanted.loaded()
    layout = Layout(wanted.results.absolute())
    spec = loaded.spec
    number = wanted.participant
    numbers = [*participants(spec)]
    if number is None and len(numbers) == 1:
        (number,) = numbers
    if number is None:
        raise UsageError("no participant is named", "say whose data with --participant N")
    layout.require_own_folders()
    if not layout.store.is_dir() and not layout.works.is_dir():
        raise StoreError(f"no results in '{wanted.results}'", "name the folder with --results DIR")

    # Sessions that are not finished, of which none may be going on.
    unfinished = []
    for folder in layout.works.glob("*/"):
        facts = read_record(folder / SESSION_FILE) or {}
        if facts.get("number") == number and facts.get("task") in spec.tasks:
            unfinished.append(folder)
    if any(is_held(layout.lock(folder.name)) for folder in unfinished):
        raise UsageError(f"participant {number} is driving now", "end that session, then withdraw")

    # Their cells, and everything that was computed from these.
    stored = [
        (kind, key, read_manifest(layout, kind, key))
        for kind in stored_kinds(layout)
        for key in sorted(stored_keys(layout, kind))
    ]
    own = [
        key
        for _, key, manifest in stored
        if driven_by(manifest, number) and manifest.get("task") in spec.tasks
    ]

    def computed_from(read: str) -> list[str]:
        return [key for _, key, manifest in stored if read in manifest.get("upstream", {}).values()]

    of_them = reached(own, computed_from)
    deleted = [
        (kind, key, manifest.get("label")) for kind, key, manifest in stored if key in of_them
    ]
    for kind, key, label in sorted(deleted, key=lambda artifact: artifact[1] not in own):
        discard(layout.artifact(kind, key))
        # Films that `wasp view` has drawn of it.
        for film in (layout.root / ".wasp-view" / "films").glob(f"{key}-*"):
            shutil.rmtree(film, ignore_errors=True)
        say(f"{label}: deleted ({key})")
    for folder in unfinished:
        shutil.rmtree(folder)
        say(f"{folder.name}: an unfinished session, deleted")
    number_deleted = len(deleted) + len(unfinished)
    if number_deleted:
        results = "1 result" if number_deleted == 1 else f"{number_deleted} results"
        say(
            f"participant {number} has withdrawn: {results} deleted; reports that were made before "
            "still hold their numbers"
        )
    else:
        say(
            f"nothing was deleted: participant {number} drove nothing of this in '{wanted.results}'"
        )
    return number_deleted
