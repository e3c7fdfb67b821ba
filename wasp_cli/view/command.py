"""What `wasp view` does with its options: the folder, the server until Ctrl-C, the browser."""

from __future__ import annotations

import time
import webbrowser
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from wasp_cli.console import following, plain, say
from wasp_cli.errors import StoreError, UsageError
from wasp_cli.store.layout import Layout
from wasp_cli.view.cells import Cells
from wasp_cli.view.films import Films
from wasp_cli.view.links import Links
from wasp_cli.view.server import ViewServer
from wasp_cli.view.site import Site


def site_of(folder: Path, *, films: bool = True) -> Site:
    """Return a results folder as pages.

    Raises:
        StoreError: the folder has no results, or links in it.
    """
    layout = Layout(folder)
    layout.require_own_folders()
    if not layout.store.is_dir() and not layout.runs.is_dir():
        raise StoreError(f"no results in '{folder}': it has neither runs nor a store", "wasp run SPEC --results DIR writes there")
    return Site(layout, Cells(layout), Links(), Films(layout) if films else None)


def write_bundle(site: Site, folder: Path, cells: Sequence[str], episodes: str) -> None:
    """Write the pages to a folder, and say what is in it.

    Args:
        site: what is shown.
        folder: where the files go.
        cells: labels or keys of those whose episodes have pages; none: of all.
        episodes: their numbers, as `0,3`.

    Raises:
        UsageError: these are no numbers, the folder holds something else, or there is no such cell.
        StoreError: it cannot be written.
    """
    from wasp_cli.view.bundle import bundle

    try:
        numbers = sorted({int(part) for part in episodes.split(",")})
    except ValueError:
        raise UsageError(f"'{episodes}' are no episodes", "numbers with commas between them: 0,3") from None
    with following("bundle") as progress:
        made = bundle(site, folder, cells, numbers, progress)
    for problem in made.problems[:LISTED]:
        plain(problem)
    if len(made.problems) > LISTED:
        plain(f"and {len(made.problems) - LISTED} more")
    say(f"{folder / 'index.html'}: {made.cells} cells, {made.episodes} episodes, {made.films} films")


LISTED = 12
"""Problems that are named."""


def view(site: Site, port: int, place: str, *, open_browser: bool) -> None:
    """Serve pages until Ctrl-C.

    Args:
        site: what is shown.
        port: 0 for any free one.
        place: which page the browser opens, such as `/cell/goal1 s1 wasp laggy=0.7/episode/3?step=100`.
        open_browser: otherwise the address is only printed.

    Raises:
        UsageError: the port is taken, or the place is none.
    """
    if not place.startswith("/"):
        raise UsageError(f"'{place}' is no place", "places begin with a slash: /cells, /cell/LABEL/episode/3?step=100")
    server = ViewServer(site, port)
    server.start()
    site.cells.numbers()  # read while the browser starts
    address = server.opening(place)
    say(f"view here: {address}")
    plain(
        f"from another machine: ssh -L {server.port}:127.0.0.1:{server.port} THIS-MACHINE, then open the same address there; Ctrl-C ends it"
    )
    if open_browser:
        with suppress(webbrowser.Error):
            webbrowser.open(address)
    try:
        while True:
            time.sleep(0.5)
    except KeyboardInterrupt:
        pass  # how it ends
    finally:
        server.stop()
