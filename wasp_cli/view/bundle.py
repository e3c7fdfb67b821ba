"""The same pages as a folder of files, with relative links, for any host or none: without films on demand, notes to write and live runs."""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from subprocess import run
from typing import Any

from wasp_cli.errors import StoreError, UsageError, WaspError
from wasp_cli.notebook.cells import ListedCell
from wasp_cli.report.address import open_command
from wasp_cli.report.explain.stored import Episode
from wasp_cli.store.find import KIND
from wasp_cli.store.tables import cell_file
from wasp_cli.view import pages, runs
from wasp_cli.view.cells import problem_of
from wasp_cli.view.episode import load, summary
from wasp_cli.view.films import FILM, read_state
from wasp_cli.view.links import BundleLinks
from wasp_cli.view.server import FILES
from wasp_cli.view.site import Site

MARK = "wasp-bundle.txt"
"""Stands in a folder that we wrote, so that we may write it again."""
FRAMES = 125
"""Of a film at most (about): some hundred kilobytes."""


@dataclass(frozen=True)
class Bundled:
    """What was written."""

    cells: int
    episodes: int
    films: int
    problems: tuple[str, ...]
    """films that could not be drawn, and episodes whose steps are not here"""


def bundle(site: Site, folder: Path, cells: Sequence[str], episodes: Sequence[int], tell: Callable[[float, str], None]) -> Bundled:
    """Write the pages of a results folder.

    Args:
        site: the folder, as the server shows it.
        folder: where the files go: a new folder, an empty one, or an earlier bundle.
        cells: labels or keys of those whose episodes have pages; none: of all. All cells are in the table and have a page.
        episodes: their numbers.
        tell: told the share that is done.

    Raises:
        UsageError: the folder holds something else, or there is no such cell.
        StoreError: it cannot be written.
    """
    listed = {cell.key: cell for cell in site.cells.listed() if _there(site, cell)}
    chosen = {site.one(text)[0].key for text in cells} if cells else set(listed)
    if missing := [key for key in chosen if key not in listed]:
        raise UsageError(f"the cell {missing[0]} has no rows")
    problems: list[str] = []
    wanted: dict[str, set[int]] = {}
    for key in listed:
        if key not in chosen:
            continue
        for number in episodes:
            try:
                load(site.one(key)[1], number)
            except WaspError as error:
                problems.append(f"{listed[key].label}, episode {number}: {problem_of(error)}")
            else:
                wanted.setdefault(key, set()).add(number)
    _prepare(folder)
    try:
        still = Site(site.layout, site.cells, BundleLinks(listed, wanted, _reports(site, folder)))
        films = _write(still, folder, listed, wanted, problems, tell)
    except OSError as error:
        raise StoreError(f"the bundle cannot be written to '{folder}': {(error.strerror or str(error)).lower()}") from error
    return Bundled(len(listed), sum(map(len, wanted.values())), films, tuple(problems))


def _there(site: Site, cell: ListedCell) -> bool:
    try:
        return site.layout.within(cell_file(site.layout.artifact(KIND, cell.key))).is_file()
    except StoreError:
        return False


def _reports(site: Site, folder: Path) -> dict[str, str]:
    """Where the pages of reports are for a bundle that lies in the results folder. One that lies elsewhere names them without an address.

    They are not copied: whoever made the results wrote them, with whatever script.
    """
    found: dict[str, str] = {}
    if not folder.resolve().is_relative_to(site.layout.root.resolve()):
        return found
    for path in (each / "report.html" for each in runs.reports(site)):
        if not path.is_file() or path.is_symlink():
            continue
        found[str(path)] = Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()
    return found


def _prepare(folder: Path) -> None:
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise UsageError(f"'{folder}' is no folder of its own")
    if folder.is_dir() and any(folder.iterdir()):
        if not (folder / MARK).is_file():
            raise UsageError(f"'{folder}' holds something else", "name a new folder")
        for path in folder.iterdir():
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink()
    folder.mkdir(parents=True, exist_ok=True)
    (folder / MARK).write_text(
        "Written by wasp view --bundle; index.html is where to begin. Everything here is replaced when it is written again.\n"
    )


def _write(
    site: Site,
    folder: Path,
    listed: dict[str, ListedCell],
    wanted: dict[str, set[int]],
    problems: list[str],
    tell: Callable[[float, str], None],
) -> int:
    def page(name: str, text: str) -> None:
        (folder / name).write_text(text, encoding="utf-8", errors="replace")

    for name, (package, place, _) in FILES.items():
        (folder / name).write_bytes((files(package) / place).read_bytes())
    page("index.html", runs.home_page(site))
    page("cells.html", pages.cells_page(site))
    for key in listed:
        try:
            text = pages.cell_page(site, key)
        except WaspError as error:
            text = site.render("problem.html", listed[key].label, message=error.message, hint=error.hint)
        page(site.links.cell(key), text)
    todo = [(key, number) for key in wanted for number in sorted(wanted[key])]
    films = 0
    with ThreadPoolExecutor(2) as threads:
        drawn = threads.map(lambda each: _film(site, each[0], each[1], folder / site.links.film(each[0], each[1], FILM)), todo)
        for count, ((key, number), (state, problem)) in enumerate(zip(todo, drawn, strict=True)):
            tell(count / len(todo), f"{listed[key].label}, episode {number}")
            if problem:
                problems.append(f"{listed[key].label}, episode {number}: no film: {problem}")
            films += not problem
            page(site.links.episode(key, number), episode_page(site, listed[key], number, state))
    return films


def episode_page(site: Site, cell: ListedCell, number: int, film: dict[str, Any]) -> str:
    """Return the page of an episode with everything in it: the explanation of every decision, and what is known of its film."""
    found = site.one(cell.key)[1]
    stored: Episode = load(found, number)
    view = pages.episode_view(site, cell, found, stored)
    view |= {"frames": {name: film.get(name) for name in ("state", "ready", "frames", "every", "ending")}, "legend": film.get("legend", [])}
    place = f"/cell/{cell.label}/episode/{number}"
    notes = [note for note in site.notes() if note.key == cell.key and note.episode in (None, number)]
    return site.render(
        "episode.html", f"{cell.label}, episode {number}", view=view, cell=cell, number=number, place=place, notes=notes,
        summary=summary(stored, f"wasp explain {cell.key[:8]}"), command=open_command(site.name, place),
        around={"up": site.links.cell(cell.key), "before": "", "after": ""},
    )  # fmt: skip


def _film(site: Site, key: str, number: int, folder: Path) -> tuple[dict[str, Any], str]:
    """Draw a film in a process of its own, as the server does; what it says of the film, and what went wrong."""
    folder.mkdir(parents=True, exist_ok=True)
    decisions = load(site.one(key)[1], number).decisions
    every = max(1, -(-decisions // FRAMES))
    with tempfile.TemporaryFile() as log:
        command = [
            sys.executable,
            "-P",  # the working directory may be the results themselves: their modules are not ours
            "-m",
            "wasp_cli.view.draw",
            str(site.layout.root.absolute()),
            key,
            str(number),
            FILM,
            "0",
            str(folder),
            str(every),
        ]
        run(command, stdout=log, stderr=log, check=False)
    state = read_state(folder) or {"state": "failed", "ready": 0, "problem": "its process ended"}
    for name in ("film.json", "film.json.part", "frame.part"):
        with suppress(OSError):
            (folder / name).unlink()
    return state, "" if state["state"] == "done" else str(state.get("problem", "it is not whole"))
