"""The server of `wasp view`: who may ask, which address is which page, and what is sent back.

A browser that opens the address with the token gets a cookie; links then need no token. It only reads: what begins to draw a film, which
takes time and changes no result, is a POST from one of our own pages.
"""

from __future__ import annotations

import sys
import time
import traceback
import webbrowser
from collections.abc import Awaitable, Callable
from contextlib import suppress
from importlib.resources import files
from typing import Any
from urllib.parse import quote

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, RedirectResponse, Response
from starlette.routing import Route

from wasp_cli.console import plain, say
from wasp_cli.errors import UsageError, WaspError, described
from wasp_cli.store.plain import open_plain
from wasp_cli.view import pages
from wasp_cli.view.episode import episode_page, load, step_part
from wasp_cli.view.films import KINDS, Films
from wasp_cli.view.site import REPORT, Site
from wasp_cli.web.server import LocalServer, local, own_origin, page

POLICY = (  # what a page may load: nothing but from this server. It has no form to send.
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'"
)
STRANGER = (  # a report: no origin of its own, so no cookie, and nothing to load
    "sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:; "
    "frame-ancestors 'none'"
)
FILES = {
    "view.js": ("wasp_cli.view", "page/view.js", "text/javascript"),
    "sort.js": ("wasp_cli.report", "page/sort.js", "text/javascript"),
    "view.css": ("wasp_cli.view", "page/view.css", "text/css"),
    "style.css": ("wasp_cli.report", "page/style.css", "text/css"),
}
REFERRER = "same-origin"

Answer = Callable[[Request], str | Response]  # a page, or what else is sent back


class ViewServer(LocalServer):
    """Serves the pages of a results folder, from a thread of its own until it is stopped."""

    def __init__(self, site: Site, port: int = 0) -> None:
        self.site = site
        film = "/film/{key}/{number:int}/{kind}"
        answers: dict[str, Answer] = {
            "/": lambda _: pages.home_page(site),
            "/static/{name}": self._file,
            "/cells": lambda _: pages.cells_page(site),
            "/cells/numbers": lambda request: _json(pages.numbers(site, _number(request, "after") or 0)),
            "/cell/{cell:path}/episode/{number:int}/explain": self._explain,
            "/cell/{cell:path}/episode/{number:int}": lambda request: episode_page(
                site, request.path_params["cell"], request.path_params["number"], _number(request, "step")
            ),
            "/cell/{cell:path}": lambda request: pages.cell_page(site, request.path_params["cell"]),
            "/compare/cells": self._beside,
            film: lambda request: _json(self._films(request).state(*_film(request))),
            film + "/frame/{frame:int}": self._frame,
            "/report/{spec}": self._report,
            "/run/{run}": lambda request: pages.run_page(site, request.path_params["run"]),
            "/run/{run}/now": lambda request: str(pages.run_now(site, request.path_params["run"])),
            "/run/{run}/log/{key}": lambda request: page(
                pages.log_text(site, request.path_params["run"], request.path_params["key"]).encode(), "text/plain", POLICY
            ),
        }
        drawn = Route(film, self._guard(lambda request: _json(self._films(request).ask(*_film(request))), draws=True), methods=["POST"])
        routes = [Route(place, self._guard(answer), methods=["GET"]) for place, answer in answers.items()]
        super().__init__([*routes, drawn], port, "view")

    def opening(self, place: str = "/") -> str:
        """Return what a browser opens to see a place, with the token."""
        path, mark, query = place.partition("?")
        joined = quote(path, "/=+%") + "?" + (f"{query}&" if mark and query else "")
        return f"http://127.0.0.1:{self.port}{joined}token={self.token}"

    def stop(self) -> None:
        super().stop()
        if self.site.films is not None:
            self.site.films.close()

    @property
    def _cookie(self) -> str:
        return f"wasp_view_{self.port}"

    def _guard(self, answer: Answer, *, draws: bool = False) -> Callable[[Request], Awaitable[Response]]:
        """Wrap an answer: Host and token first, for what begins to draw Origin too; what goes wrong becomes a page."""

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
        rest = "&".join(part for part in request.url.query.split("&") if part and not part.startswith("token="))
        answer = RedirectResponse(quote(request.url.path, "/=+%") + (f"?{rest}" if rest else ""), 303)
        answer.set_cookie(self._cookie, self.token, httponly=True, samesite="strict", path="/")
        answer.headers["Referrer-Policy"] = REFERRER
        return answer

    def _answered(self, answer: Answer, request: Request) -> Response:
        try:
            content = answer(request)
        except WaspError as error:
            return self._problem(error.message, error.hint, 404 if isinstance(error, UsageError) else 409)
        except Exception as error:  # a damaged file may hold what nobody thought of: the page says so, and the server goes on
            traceback.print_exc(file=sys.stderr)
            return self._problem(described(error)[:300], "the terminal shows where", 500)
        return content if isinstance(content, Response) else _html(content)

    def _problem(self, message: str, hint: str | None, status: int) -> Response:
        return _html(self.site.render("problem.html", "This cannot be shown", message=message, hint=hint), status)

    def _file(self, request: Request) -> Response:
        # By name among FILES: what was asked for never becomes a path.
        known = FILES.get(request.path_params["name"])
        if known is None:
            return PlainTextResponse("not found", 404)
        package, name, kind = known
        return page((files(package) / name).read_bytes(), kind, POLICY, referrer=REFERRER)

    def _report(self, request: Request) -> Response:
        """Return the report of a spec, which is one file. It may come from elsewhere: it runs as a stranger to these pages."""
        path = self.site.layout.within(self.site.layout.reports(request.path_params["spec"]) / REPORT)
        try:
            with open_plain(path) as file:
                return page(file.read(), "text/html", STRANGER, referrer=REFERRER)
        except OSError as error:
            raise UsageError(f"this report cannot be read: {error.strerror or error}", "wasp report DIR writes it") from error

    def _explain(self, request: Request) -> str:
        cell, artifact = self.site.one(request.path_params["cell"])
        stored = load(artifact, request.path_params["number"])
        return str(step_part(self.site, cell, stored, _number(request, "step") or 0))

    def _beside(self, request: Request) -> str:
        a, b = (request.query_params.get(name, "") for name in ("a", "b"))
        return pages.beside_page(self.site, a, b, _number(request, "world"), _number(request, "step"))

    def _films(self, request: Request) -> Films:
        """The films, where a listed cell is asked for and such a film can be."""
        key = request.path_params["key"]
        listed, _ = self.site.cells.find(key)
        if self.site.films is None or request.path_params["kind"] not in KINDS or [cell.key for cell in listed] != [key]:
            raise UsageError("there is no such film")
        return self.site.films

    def _frame(self, request: Request) -> Response:
        key, number, kind, step = _film(request)
        frame = self._films(request).frame(key, number, kind, request.path_params["frame"], step)
        return PlainTextResponse("not found", 404) if frame is None else page(frame, "image/webp", POLICY)


def serve(site: Site, port: int, place: str, *, open_browser: bool) -> None:
    """Serve pages until Ctrl-C; the browser opens a place such as `/cell/goal1 s1 wasp laggy=0.7/episode/3?step=100`."""
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


def _film(request: Request) -> tuple[str, int, str, int]:
    place = request.path_params
    return place["key"], place["number"], place["kind"], _number(request, "step") or 0


def _number(request: Request, name: str) -> int | None:
    text = request.query_params.get(name, "")
    if text and not (text.isascii() and text.isdigit() and len(text) < 20):
        raise UsageError(f"'{text}' is no decision", "decisions are numbered from 0")
    return int(text) if text else None


def _html(text: str, status: int = 200) -> Response:
    return page(text.encode("utf-8", "replace"), "text/html", POLICY, status, REFERRER)


def _json(value: Any) -> Response:
    return JSONResponse(value, headers={"Cache-Control": "no-store", "X-Content-Type-Options": "nosniff"})
