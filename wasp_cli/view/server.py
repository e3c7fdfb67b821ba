"""How the pages of `wasp view` reach a browser: a server, or a folder of files.

The server says who may ask, which address is which page, and what is sent back. A browser that
opens the address with the token gets a cookie; links then need no token. It only reads: what begins
to draw a film, which takes time and changes no result, is a POST from one of our own pages. The
files have relative links, no films on demand, and no pages of runs.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
import time
import traceback
from collections.abc import Awaitable, Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from subprocess import run
from typing import Any
from urllib.parse import quote

from markupsafe import escape
from starlette.concurrency import run_in_threadpool
from starlette.convertors import IntegerConvertor, register_url_convertor
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, RedirectResponse, Response
from starlette.routing import Route

from wasp_cli.cells.cell import RecordedCell
from wasp_cli.console import following, plain, say
from wasp_cli.errors import StoreError, UsageError, WaspError, described, first
from wasp_cli.store.find import KIND
from wasp_cli.store.plain import open_plain
from wasp_cli.store.tables import cell_file
from wasp_cli.view import pages
from wasp_cli.view.episode import branches_of, episode_page, load, step_part
from wasp_cli.view.films import FILM, KINDS, Films, drawing, problem_of, read_state
from wasp_cli.view.site import REPORT, Links, Site
from wasp_cli.web import REFERRER, LocalServer, local, own_origin, page, static

STRANGER = (  # a report: no origin of its own, so no cookie, and nothing to load
    "sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline'; style-src "
    "'unsafe-inline'; img-src data:; "
    "frame-ancestors 'none'"
)
ROOM = Path(__file__).parents[1]
FILES = {
    **{name: ROOM / "view" / "page" / name for name in ("view.js", "view.css")},
    # tables and timelines are the report's own
    **{name: ROOM / "report" / "page" / name for name in ("sort.js", "style.css")},
}

Answer = Callable[[Request], str | Response]  # a page, or what else is sent back


class _Whole(IntegerConvertor):
    regex = "[0-9]{1,18}"  # Python refuses to read numbers of thousands of digits


register_url_convertor("whole", _Whole())


class ViewServer(LocalServer):
    """Serves the pages of a results folder to this machine alone, to whoever has the token."""

    def __init__(self, site: Site, port: int = 0) -> None:
        self.site = site
        film = "/film/{key}/{number:whole}/{kind}"
        answers: dict[str, Answer] = {
            "/": lambda _: pages.home_page(site),
            "/static/{name}": lambda request: static(FILES, request.path_params["name"]),
            "/cells": lambda _: pages.cells_page(site),
            "/cells/numbers": lambda request: _json(pages.numbers(site)),
            "/cell/{cell:path}/episode/{number:whole}/explain": self._explain,
            "/cell/{cell:path}/episode/{number:whole}": lambda request: episode_page(
                site,
                request.path_params["cell"],
                request.path_params["number"],
                _number(request, "step"),
            ),
            "/cell/{cell:path}": lambda request: pages.cell_page(site, request.path_params["cell"]),
            "/compare/cells": self._beside,
            film: lambda request: _json(self._films(request).state(*_film(request))),
            film + "/frame/{frame:whole}": self._frame,
            "/report/{spec}": self._report,
            "/run/{run}": lambda request: pages.run_page(site, request.path_params["run"]),
            "/run/{run}/now": lambda request: str(pages.run_now(site, request.path_params["run"])),
            "/run/{run}/log/{key}": lambda request: page(
                pages.log_text(site, **request.path_params).encode(), "text/plain"
            ),
        }
        drawn = Route(
            film,
            self._guard(
                lambda request: _json(self._films(request).ask(*_film(request))), draws=True
            ),
            methods=["POST"],
        )
        routes = [
            Route(place, self._guard(answer), methods=["GET"]) for place, answer in answers.items()
        ]
        super().__init__([*routes, drawn], port, "view")
        self._cookie = f"wasp_view_{self.port}"

    def opening(self, place: str = "/") -> str:
        """Return the address that opens a page, with the token."""
        path, mark, query = place.partition("?")
        joined = quote(path, "/=+%") + "?" + (f"{quote(query, '/=+%&')}&" if mark and query else "")
        return f"http://127.0.0.1:{self.port}{joined}token={self.token}"

    def stop(self) -> None:
        """End the server, and the films that are being drawn."""
        super().stop()
        if self.site.films is not None:
            self.site.films.close()

    def _guard(
        self, answer: Answer, *, draws: bool = False
    ) -> Callable[[Request], Awaitable[Response]]:
        """Wrap an answer: Host and token first, for what begins to draw Origin too; what goes
        wrong becomes a page.
        """

        async def guarded(request: Request) -> Response:
            if not local(request.headers.get("host")):
                return self.forbidden()
            given = request.query_params.get("token")
            if self.known(given) and request.method == "GET":
                return self._entered(request)
            if not self.known(request.cookies.get(self._cookie)):
                return self.forbidden()
            origin = request.headers.get("origin")
            if draws and (origin is None or not own_origin(request.headers.get("host"), origin)):
                return self.forbidden()
            return await run_in_threadpool(self._answered, answer, request)

        return guarded

    def _entered(self, request: Request) -> Response:
        """The token is right: a cookie has it from now on, and the address is one without it."""
        rest = "&".join(
            part for part in request.url.query.split("&") if part and not part.startswith("token=")
        )
        answer = RedirectResponse(
            quote(request.url.path, "/=+%") + (f"?{rest}" if rest else ""), 303
        )
        answer.set_cookie(self._cookie, self.token, httponly=True, samesite="lax", path="/")
        answer.headers["Referrer-Policy"] = REFERRER
        return answer

    def _answered(self, answer: Answer, request: Request) -> Response:
        try:
            content = answer(request)
        except WaspError as error:
            return self._problem(
                error.message, error.hint, 404 if isinstance(error, UsageError) else 409
            )
        except Exception as error:
            # a damaged file may hold what nobody thought of: the page says so, and the server goes
            # on
            traceback.print_exc(file=sys.stderr)
            return self._problem(described(error)[:300], "the terminal shows where", 500)
        return content if isinstance(content, Response) else _html(content)

    def _problem(self, message: str, hint: str | None, status: int) -> Response:
        return _html(
            self.site.render("problem.html", "This cannot be shown", message=message, hint=hint),
            status,
        )

    def _report(self, request: Request) -> Response:
        """Return the report of a spec, which is one file. It may come from elsewhere: it runs
        as a stranger to these pages.
        """
        path = self.site.layout.within(
            self.site.layout.reports(request.path_params["spec"]) / REPORT
        )
        try:
            with open_plain(path) as file:
                return page(file.read(), "text/html", STRANGER)
        except OSError as error:
            raise UsageError(
                f"this report cannot be read: {error.strerror or error}",
                "wasp report DIR writes it",
            ) from error

    def _explain(self, request: Request) -> str:
        cell, artifact = self.site.one(request.path_params["cell"])
        stored = load(artifact, request.path_params["number"])
        # the page has said what is wrong with them
        branches, _ = branches_of(self.site.layout, cell)
        return str(step_part(self.site, cell, stored, _number(request, "step") or 0, branches))

    def _beside(self, request: Request) -> str:
        a, b = (request.query_params.get(name, "") for name in ("a", "b"))
        return pages.beside_page(
            self.site, a, b, _number(request, "world"), _number(request, "step")
        )

    def _films(self, request: Request) -> Films:
        key = request.path_params["key"]
        listed, _ = self.site.cells.find(key)
        if (
            self.site.films is None
            or request.path_params["kind"] not in KINDS
            or [cell.key for cell in listed] != [key]
        ):
            raise UsageError("there is no such film")
        return self.site.films

    def _frame(self, request: Request) -> Response:
        key, number, kind, step = _film(request)
        frame = self._films(request).frame(key, number, kind, request.path_params["frame"], step)
        return PlainTextResponse("not found", 404) if frame is None else page(frame, "image/webp")


def serve(site: Site, port: int, place: str, *, open_browser: bool) -> None:
    """Serve pages until Ctrl-C; the browser opens a place such as `/cell/goal1 s1 wasp
    laggy=0.7/episode/3?step=100`.
    """
    if not place.startswith("/"):
        raise UsageError(
            f"'{place}' is no place",
            "places begin with a slash: /cells, /cell/LABEL/episode/3?step=100",
        )
    server = ViewServer(site, port)
    server.start()
    site.cells.known()  # read while the browser starts
    server.announce("view", server.opening(place), opened=open_browser, more="; Ctrl-C ends it")
    try:
        with suppress(KeyboardInterrupt):  # how it ends
            while True:
                time.sleep(0.5)
    finally:
        server.stop()


def _film(request: Request) -> tuple[str, int, str, int]:
    place = request.path_params
    return place["key"], place["number"], place["kind"], _number(request, "step") or 0


def _number(request: Request, name: str) -> int | None:
    text = request.query_params.get(name, "")
    if text and not (text.isascii() and text.isdigit() and len(text) < 19):
        raise UsageError(
            f"{name}='{text}' is no number", "all numbers in addresses are whole ones from 0"
        )
    return int(text) if text else None


def _html(text: str, status: int = 200) -> Response:
    return page(text.encode("utf-8", "replace"), "text/html", status=status)


def _json(value: Any) -> Response:
    return JSONResponse(
        value, headers={"Cache-Control": "no-store", "X-Content-Type-Options": "nosniff"}
    )


MARK = "wasp-bundle.txt"  # stands in a folder that we wrote, so that we may write it again
FRAMES = 125  # of a film at most (about): some hundred kilobytes
LISTED = 12  # problems that are named


def bundle(site: Site, folder: Path, cells: Sequence[str], episodes: str) -> None:
    """Write the pages of a results folder to a new folder, an empty one or an earlier bundle, and
    say what is in them.

    All cells are in the table and have a page; the episodes numbered `0,3` of the named `cells`
    (none: of all) have pages too.
    """
    try:
        numbers = sorted({int(part) for part in episodes.split(",")})
    except ValueError:
        raise UsageError(
            f"'{episodes}' are no episodes", "numbers with commas between them: 0,3"
        ) from None
    listed = {cell.key: cell for cell in site.cells.listed() if _is_there(site, cell)}
    chosen = {site.one(text)[0].key for text in cells} if cells else set(listed)
    missing = sorted(chosen - listed.keys())
    if missing:
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
        raise StoreError(
            f"the bundle cannot be written to '{folder}': {(error.strerror or str(error)).lower()}"
        ) from error
    for line in first(problems, LISTED):
        plain(line)
    say(
        f"{folder / 'index.html'}: {len(listed)} cells, {sum(map(len, readable.values()))} "
        f"episodes, {films} films"
    )


def _is_there(site: Site, cell: RecordedCell) -> bool:
    with suppress(StoreError):
        return site.layout.within(cell_file(site.layout.artifact(KIND, cell.key))).is_file()
    return False


def _reports(site: Site, folder: Path) -> dict[str, str]:
    """Where the pages of reports are for a bundle that lies in the results folder. One that lies
    elsewhere names them without an address.

    They are not copied: whoever made the results wrote them, with whatever script.
    """
    target = folder.resolve()
    if not target.is_relative_to(site.layout.root.resolve()):
        return {}
    paths = [report / REPORT for report in pages.reports(site)]
    return {
        str(path): Path(os.path.relpath(path.resolve(), target)).as_posix()
        for path in paths
        if path.is_file() and not path.is_symlink()
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
        "Written by wasp view --bundle; index.html is where to begin. Everything here is "
        "replaced when it is written again.\n"
    )


def _write(
    site: Site,
    folder: Path,
    listed: Mapping[str, RecordedCell],
    episodes: Mapping[str, Collection[int]],
    problems: list[str],
) -> int:
    # messages name files, and a bundle is for others
    way = escape(f"{site.layout.root.absolute()}/")

    def write(name: str, text: str) -> None:
        text = text.replace(way, escape(f"{site.name}/"))
        (folder / name).write_text(text, encoding="utf-8", errors="replace")

    for name, path in FILES.items():
        (folder / name).write_bytes(path.read_bytes())
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
            write(
                site.links.episode(cell, number), episode_page(site, cell.key, number, film=state)
            )
    return films


def _drawn(site: Site, cell: RecordedCell, number: int, folder: Path) -> tuple[dict[str, Any], str]:
    """Draw a film in a process of its own, as the server does; what it says of the film, and
    what went wrong.
    """
    target = folder / site.links.film(cell, number, FILM)
    target.mkdir(parents=True, exist_ok=True)
    every = max(1, -(-load(site.one(cell.key)[1], number).decisions // FRAMES))
    with tempfile.TemporaryFile() as log:
        run(
            drawing(site.layout, cell.key, number, FILM, 0, target, every),
            stdout=log,
            stderr=log,
            check=False,
        )
    state = read_state(target) or {"state": "failed", "ready": 0, "problem": "its process ended"}
    for path in target.glob("*[!p]"):  # all but .webp: what the process says, and what it had begun
        path.unlink()
    return state, "" if state["state"] == "done" else str(state.get("problem", "it is not whole"))
