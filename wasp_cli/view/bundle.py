"""The pages of `wasp view` as a folder of files: relative links, no films on demand, no pages of runs. It works from any host or none."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from importlib.resources import files
from pathlib import Path
from subprocess import run
from typing import Any

from wasp_cli.console import following, plain, say
from wasp_cli.errors import StoreError, UsageError, WaspError, first
from wasp_cli.notebook.cells import ListedCell
from wasp_cli.store.find import KIND
from wasp_cli.store.tables import cell_file
from wasp_cli.view import pages
from wasp_cli.view.episode import episode_page, load
from wasp_cli.view.films import FILM, drawing, problem_of, read_state
from wasp_cli.view.server import FILES
from wasp_cli.view.site import REPORT, Links, Site

MARK = "wasp-bundle.txt"  # stands in a folder that we wrote, so that we may write it again
FRAMES = 125  # of a film at most (about): some hundred kilobytes
LISTED = 12  # problems that are named


def bundle(site: Site, folder: Path, cells: Sequence[str], episodes: str) -> None:
    """Write the pages of a results folder to a new folder, an empty one or an earlier bundle, and say what is in them.

    All cells are in the table and have a page; the episodes numbered `0,3` of the named `cells` (none: of all) have pages too.
    """
    try:
        numbers = sorted({int(part) for part in episodes.split(",")})
    except ValueError:
        raise UsageError(f"'{episodes}' are no episodes", "numbers with commas between them: 0,3") from None
    listed = {cell.key: cell for cell in site.cells.listed() if _is_there(site, cell)}
    chosen = {site.one(text)[0].key for text in cells} if cells else set(listed)
    if missing := sorted(chosen - listed.keys()):
        raise UsageError(f"the cell {missing[0]} has no rows")
    problems: list[str] = []
    readable: dict[str, list[int]] = {key: [] for key in listed}
    for key in listed:
        for number in numbers if key in chosen else ():
            try:
                load(site.one(key)[1], number)
            except WaspError as error:
                problems.append(f"{listed[key].label}, episode {number}: {problem_of(error)}")
            else:
                readable[key].append(number)
    _prepare(folder)
    try:
        still = Site(site.layout, site.cells, Links(site.cells, readable, _reports(site, folder)))
        films = _write(still, folder, listed, readable, problems)
    except OSError as error:
        raise StoreError(f"the bundle cannot be written to '{folder}': {(error.strerror or str(error)).lower()}") from error
    for line in first(problems, LISTED):
        plain(line)
    say(f"{folder / 'index.html'}: {len(listed)} cells, {sum(map(len, readable.values()))} episodes, {films} films")


def _is_there(site: Site, cell: ListedCell) -> bool:
    with suppress(StoreError):
        return site.layout.within(cell_file(site.layout.artifact(KIND, cell.key))).is_file()
    return False


def _reports(site: Site, folder: Path) -> dict[str, str]:
    """Where the pages of reports are for a bundle that lies in the results folder. One that lies elsewhere names them without an address.

    They are not copied: whoever made the results wrote them, with whatever script.
    """
    target = folder.resolve()
    if not target.is_relative_to(site.layout.root.resolve()):
        return {}
    paths = [report / REPORT for report in pages.reports(site)]
    return {
        str(path): Path(os.path.relpath(path.resolve(), target)).as_posix() for path in paths if path.is_file() and not path.is_symlink()
    }


def _prepare(folder: Path) -> None:
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise UsageError(f"'{folder}' is no folder of its own")
    if folder.is_dir() and any(folder.iterdir()):
        if not (folder / MARK).is_file():
            raise UsageError(f"'{folder}' holds something else", "name a new folder")
        shutil.rmtree(folder)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / MARK).write_text(
        "Written by wasp view --bundle; index.html is where to begin. Everything here is replaced when it is written again.\n"
    )


def _write(site: Site, folder: Path, listed: Mapping[str, ListedCell], episodes: Mapping[str, Collection[int]], problems: list[str]) -> int:
    """Write all files; returns how many films there are."""

    def write(name: str, text: str) -> None:
        (folder / name).write_text(text, encoding="utf-8", errors="replace")

    for name, (package, place, _) in FILES.items():
        (folder / name).write_bytes((files(package) / place).read_bytes())
    write("index.html", pages.home_page(site))
    write("cells.html", pages.cells_page(site))
    for key, cell in listed.items():
        try:
            text = pages.cell_page(site, key)
        except WaspError as error:
            text = site.render("problem.html", cell.label, message=error.message, hint=error.hint)
        write(site.links.cell(cell), text)
    todo = [(listed[key], number) for key, numbers in episodes.items() for number in numbers]
    films = 0
    with ThreadPoolExecutor(2) as threads, following("bundle") as tell:
        drawn = threads.map(lambda place: _drawn(site, place[0], place[1], folder), todo)
        for count, ((cell, number), (state, problem)) in enumerate(zip(todo, drawn, strict=True)):
            tell(count / len(todo), f"{cell.label}, episode {number}")
            if problem:
                problems.append(f"{cell.label}, episode {number}: no film: {problem}")
            films += not problem
            write(site.links.episode(cell, number), episode_page(site, cell.key, number, film=state))
    return films


def _drawn(site: Site, cell: ListedCell, number: int, folder: Path) -> tuple[dict[str, Any], str]:
    """Draw a film in a process of its own, as the server does; what it says of the film, and what went wrong."""
    target = folder / site.links.film(cell, number, FILM)
    target.mkdir(parents=True, exist_ok=True)
    every = max(1, -(-load(site.one(cell.key)[1], number).decisions // FRAMES))
    with tempfile.TemporaryFile() as log:
        run(drawing(site.layout, cell.key, number, FILM, 0, target, every), stdout=log, stderr=log, check=False)
    state = read_state(target) or {"state": "failed", "ready": 0, "problem": "its process ended"}
    for name in ("film.json", "film.json.part", "frame.part"):
        (target / name).unlink(missing_ok=True)
    return state, "" if state["state"] == "done" else str(state.get("problem", "it is not whole"))
