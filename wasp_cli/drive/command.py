"""What `wasp drive` does with its options: which spec is meant, the server, the browser, the
end of a session.
"""

from __future__ import annotations

import asyncio
import shutil
import threading
import time
from collections import defaultdict
from collections.abc import Sequence
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
WAITED = 20.0  # milliseconds after their beat at which decisions may begin without a warning


@dataclass(frozen=True)
class Wanted:
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
        """Find the cells and what they need; `recorded` is said by `session.prepared`."""
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
        """Return one for each participant of a spec; where a task or a participant is meant,
        this one. UsageError where nobody drives.
        """
        if self._is_task or self.participant is not None:
            return [self]
        return [replace(self, participant=number) for number in sorted(drivers(self.loaded().spec))]

    def orders(self) -> Table:
        """Return who drives what in which order, without computing anything."""
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
            names = (
                f"{cell.task} s{cell.seed} " * several + who_title(cell.method, cell.variant)
                for cell, _ in cells
            )
            table.add_row(participants(loaded.spec)[number], *names)
        return table

    def loaded(self) -> Loaded:
        if not self._is_task:
            self._require_spec()
            for name, value in (("--method", self.method), ("--session", self.session)):
                if value is not None:
                    raise UsageError(
                        f"{name} is for a task; '{self.what}' is a spec, which says it",
                        "change the spec, or use --set",
                    )
            episodes = [] if self.episodes is None else [f"episodes={self.episodes}"]
            return load(Path(self.what), [*episodes, *sized(self.preset, self.settings)])
        layout = Layout(self.results.absolute())
        return self._of(
            [
                free_session(layout, lambda number: self._of([number]))
                if self.session is None
                else self.session
            ]
        )

    def _require_spec(self) -> None:
        if spec_path(Path(self.what)).exists():
            return
        if is_foreign(Path(self.what).name):
            raise UsageError(
                f"'{self.what}' is somebody else's environment: there are no models of it that "
                "ship with wasp",
                "write a spec that trains them, with operators: {person: {p1: 1}} and "
                f"side_by_side: 1, and drive that; these need none: {', '.join(TASKS)}",
            )
        if Path(self.what).name == self.what and not self.what.endswith(SUFFIX):
            raise UnknownName("task or spec", self.what, [*TASKS, *shipped_names()])

    def _of(self, seeds: Sequence[int]) -> Loaded:
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
                "a session's number is its seed",
                "leave out --set seeds=..., and choose with --session N",
            )
        episodes = [] if self.episodes is None else [f"episodes={self.episodes}"]
        return shipped(self.what, [method], number, seeds, self.preset, [*episodes, *self.settings])

    def record(self, session: Session) -> None:
        """Make a run of all that was driven of tasks so far with these settings, by whomever: a
        report shows the last run.
        """
        if not self._is_task:
            return
        layout = session.layout
        driven_of = defaultdict[tuple[Any, ...], set[int]](set)
        for key, manifest in driven(layout):
            axes = manifest["axes"]
            told = read_record(layout.artifact("evaluate", key) / SESSION_FILE) or {}
            if manifest["task"] in TASKS and axes["method"] in METHODS and not told.get("study"):
                driven_of[
                    manifest["config"]["episodes"],
                    manifest["task"],
                    axes["method"],
                    int(axes["value"]),
                ].add(manifest["seed"])
        grids = []
        cells = dict[Cell, Node]()
        # the whole of a sitting after its beginning
        for (episodes, task, method, number), seeds in sorted(driven_of.items()):
            asked = replace(
                self, what=task, method=method, participant=number, episodes=episodes
            )._of(sorted(seeds))
            grids.append(lay_out_over(asked.spec, layout, None))
            cells |= {
                cell: node for cell, node in grids[-1].cells if exists(layout, node.kind, node.key)
            }
        if cells:
            grid = replace(
                together(grids),
                cells=tuple(cells.items()),
                nodes=tuple(with_upstream(cells.values())),
            )
            several = {
                name: tuple(dict.fromkeys(getattr(cell, name[:-1]) for cell in cells))
                for name in ("tasks", "methods", "seeds")
            }
            everything = replace(
                session.loaded, spec=session.loaded.spec.model_copy(update=several)
            )
            new_run(layout, everything, plan_against(grid, layout))


def drive_session(
    session: Session, port: int, *, open_browser: bool, scripted: Habits | None = None
) -> dict[str, Any]:
    """Serve the page until the session is over, and say on stderr what was recorded; `scripted`
    drives in the place of a person.
    """
    if scripted is None and (told := warning(session)) is not None:
        plain(f"warning: {told}")
    desk = Desk()
    server = Server(desk, port)
    server.start()

    def lead() -> None:
        """Run in the clock's thread: what goes wrong there is told in the main one."""
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
    for block in session.done:
        whole = (
            ""
            if block["episodes"] == block["of"]
            else f" of {block['of']}: the session ended early"
        )
        late = f"{block['late']} of {block['decisions']} decisions late"
        plain(
            f"{block['label']}: {block['episodes']} "
            f"episode{'' if block['episodes'] == 1 else 's'}{whole}; {late} "
            f"({block['key']})"
        )
        if block["late"] > TOLERATED * block["decisions"]:
            plain(
                "warning: nobody assisted in the late ones, and the report says so; try "
                f"--speed {session.how.speed / 2:g}"
            )
        if (waited := block["behind_p50_ms"] or 0.0) > WAITED:
            plain(
                f"warning: the world slowed down, half of the time by {waited:.0f} ms or "
                f"more; try --speed {session.how.speed / 2:g}"
            )
    if session.failure is not None:
        raise session.failure
    if interrupted:
        raise Interrupted(
            "interrupted: finished episodes are kept", "the same command goes on where it was"
        )
    return {"run": session.run_id, "participant": session.participant, "blocks": session.done}


def withdrawn(wanted: Wanted) -> int:
    """Delete everything that a participant drove in the cells of a spec or a task, whatever the
    session; returns how many results went.

    With the cells go the participant's clones, and everything that was computed from any of them.
    """
    loaded = wanted.loaded()
    layout = Layout(wanted.results.absolute())
    spec = loaded.spec
    number = wanted.participant
    numbers = [*participants(spec)]
    if number is None and len(numbers) == 1:
        (number,) = numbers
    if number is None:
        raise UsageError(
            "whose data are to be deleted?", "name the participant with --participant N"
        )
    layout.require_own_folders()
    if not layout.store.is_dir() and not layout.works.is_dir():
        raise StoreError(f"no results in '{wanted.results}'", "name the folder with --results DIR")
    sessions = [
        (folder, read_record(folder / SESSION_FILE) or {}) for folder in layout.works.glob("*/")
    ]
    unfinished = [
        folder
        for folder, told in sessions
        if told.get("number") == number and told.get("task") in spec.tasks
    ]
    if any(is_held(layout.lock(folder.name)) for folder in unfinished):
        raise UsageError(f"participant {number} is driving now", "end that session, then withdraw")
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
    of_them = reached(
        own,
        lambda read: [
            key for _, key, manifest in stored if read in manifest.get("upstream", {}).values()
        ],
    )
    left = [(kind, key, manifest.get("label")) for kind, key, manifest in stored if key in of_them]
    for kind, key, label in sorted(left, key=lambda artifact: artifact[1] not in own):
        discard(layout.artifact(kind, key))
        # Films that `wasp view` has drawn of it.
        for film in (layout.root / ".wasp-view" / "films").glob(f"{key}-*"):
            shutil.rmtree(film, ignore_errors=True)
        say(f"{label}: deleted ({key})")
    for folder in unfinished:
        shutil.rmtree(folder)
        say(f"{folder.name}: an unfinished session, deleted")
    if gone := len(left) + len(unfinished):
        results = f"{gone} result{'' if gone == 1 else 's'} deleted"
        say(
            f"participant {number} has withdrawn: {results}; reports made before still "
            "hold their numbers"
        )
    else:
        say(
            f"nothing was deleted: participant {number} drove nothing of this in '{wanted.results}'"
        )
    return gone
