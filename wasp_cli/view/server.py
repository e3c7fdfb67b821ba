"""The server of `wasp view`: who may ask, which address is which page, and what is sent back. It only reads, but for notes and requests.

A browser that opens the address with the token gets a cookie; links then need no token. Everything that changes something is a POST from
one of our own pages.
"""

from __future__ import annotations

import json
import sys
import traceback
from collections.abc import Awaitable, Callable
from importlib.resources import files
from typing import Any
from urllib.parse import parse_qs, quote

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, RedirectResponse, Response
from starlette.routing import Route

from wasp_cli.errors import UsageError, WaspError
from wasp_cli.report.notes import Note, add_note, mark_of
from wasp_cli.view import comparisons, pages, runs
from wasp_cli.view.comparisons import Comparisons
from wasp_cli.view.episode import load
from wasp_cli.view.films import KINDS, Films
from wasp_cli.view.site import Site
from wasp_cli.web.server import LocalServer, local, own_origin, page

POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; base-uri 'none'; "
    "form-action 'self'; frame-ancestors 'none'"
)
"""What a page may load and where it may send something: nothing but this server."""
FILES = {
    "view.js": ("wasp_cli.view", "page/view.js", "text/javascript"),
    "view.css": ("wasp_cli.view", "page/view.css", "text/css"),
    "style.css": ("wasp_cli.report.page", "style.css", "text/css"),
}
REFERRER = "same-origin"
LONGEST = 16_384
"""Bytes of a form."""

Answer = Callable[[Request, Site], Response]


class ViewServer(LocalServer):
    """Serves the pages of a results folder, from a thread of its own until it is stopped."""

    def __init__(self, site: Site, port: int = 0) -> None:
        """Take a port, 0 for any free one.

        Raises:
            UsageError: the port is taken, or not allowed.
        """
        self.site = site
        self._comparisons = Comparisons(site)
        routes = [
            Route("/static/{name}", self._guard(self._file)),
            Route("/note", self._guard(self._note, changes=True), methods=["POST"]),
            *self._of(""),
            *(self._of("/with") if site.other is not None else []),
            *self._more(),
        ]
        super().__init__(routes, port, "view")

    def _of(self, prefix: str) -> list[Route]:
        """The pages of the cells of a folder; `prefix` is that of its links."""
        episode, film = prefix + "/cell/{cell:path}/episode/{number:int}", prefix + "/film/{key}/{number:int}/{kind}"
        return [
            Route(f"{prefix}/cells", self._guard(self._cells)),
            Route(f"{prefix}/cells/numbers", self._guard(self._numbers)),
            Route(f"{episode}/explain", self._guard(self._explain)),
            Route(episode, self._guard(self._episode)),
            Route(prefix + "/cell/{cell:path}", self._guard(self._cell)),
            Route(film, self._guard(self._film), methods=["GET"]),
            Route(film, self._guard(self._film, changes=True), methods=["POST"]),
            Route(film + "/frame/{frame:int}", self._guard(self._frame)),
        ]

    def _more(self) -> list[Route]:
        """The pages beside those of cells."""
        return [
            Route("/", self._guard(self._home)),
            Route("/compare/cells", self._guard(self._beside)),
            Route("/compare/stores", self._guard(self._stores)),
            Route("/run/{run}", self._guard(self._run)),
            Route("/run/{run}/now", self._guard(self._now)),
            Route("/run/{run}/state", self._guard(self._state)),
            Route("/run/{run}/log/{key}", self._guard(self._log)),
            Route("/run/{run}/ask", self._guard(self._confirm), methods=["GET"]),
            Route("/run/{run}/ask", self._guard(self._ask, changes=True), methods=["POST"]),
        ]

    def opening(self, place: str = "/") -> str:
        """Return what a browser opens to see a place, with the token."""
        path, mark, query = place.partition("?")
        joined = quote(path, "/=+%") + "?" + (f"{query}&" if mark and query else "")
        return f"http://127.0.0.1:{self.port}{joined}token={self.token}"

    def stop(self) -> None:
        """End the connections, the thread, and what is being drawn."""
        super().stop()
        for site in (self.site, self.site.other):
            if site is not None and site.films is not None:
                site.films.close()

    # -- who may ask ----------------------------------------------------------------------------------------------------------------

    @property
    def _cookie(self) -> str:
        return f"wasp_view_{self.port}"

    def _guard(self, answer: Answer, *, changes: bool = False) -> Callable[[Request], Awaitable[Response]]:
        """Wrap an answer: Host and token first, for what changes something Origin and form too; what goes wrong becomes a page."""

        async def guarded(request: Request) -> Response:
            if not local(request.headers.get("host")):
                return self.forbidden()
            given = request.query_params.get("token")
            if self.known(given) and request.method == "GET":
                return self._entered(request)
            if not self.known(request.cookies.get(self._cookie)):
                return self.forbidden()
            if changes:
                origin = request.headers.get("origin")
                if origin is None or not own_origin(request.headers.get("host"), origin):
                    return self.forbidden()
                request.state.form = await _form(request)
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
        second = self.site.other is not None and request.url.path.startswith("/with/")
        site = self.site.other if second and self.site.other is not None else self.site
        try:
            return answer(request, site)
        except WaspError as error:
            return self._problem(site, error.message, error.hint, 404 if isinstance(error, UsageError) else 409)
        except Exception as error:  # a damaged file may hold what nobody thought of: the page says so, and the server goes on
            traceback.print_exc(file=sys.stderr)
            return self._problem(site, f"{type(error).__name__}: {' '.join(str(error).split())[:300]}", "the terminal shows where", 500)

    def _problem(self, site: Site, message: str, hint: str | None, status: int) -> Response:
        return _html(site.render("problem.html", "This cannot be shown", message=message, hint=hint), status)

    # -- pages ----------------------------------------------------------------------------------------------------------------------

    def _file(self, request: Request, site: Site) -> Response:
        # By name among FILES: what was asked for never becomes a path.
        known = FILES.get(request.path_params["name"])
        if known is None:
            return PlainTextResponse("not found", 404)
        package, name, kind = known
        return page((files(package) / name).read_bytes(), kind, POLICY, referrer=REFERRER)

    def _cells(self, request: Request, site: Site) -> Response:
        return _html(pages.cells_page(site))

    def _numbers(self, request: Request, site: Site) -> Response:
        return _json(pages.numbers(site, pages.require_step(request.query_params.get("after")) or 0))

    def _cell(self, request: Request, site: Site) -> Response:
        return _html(pages.cell_page(site, request.path_params["cell"]))

    def _episode(self, request: Request, site: Site) -> Response:
        step = pages.require_step(request.query_params.get("step"))
        return _html(pages.episode_page(site, request.path_params["cell"], request.path_params["number"], step))

    def _explain(self, request: Request, site: Site) -> Response:
        cell, found = site.one(request.path_params["cell"])
        stored = load(found, request.path_params["number"])
        step, width = (pages.require_step(request.query_params.get(name)) for name in ("step", "width"))
        return _html(str(pages.step_part(site, cell, stored, step or 0, width)))

    def _beside(self, request: Request, site: Site) -> Response:
        asked = request.query_params
        world, step = (pages.require_step(asked.get(name)) for name in ("world", "step"))
        return _html(comparisons.cells_page(site, asked.get("a", ""), asked.get("b", ""), world, step))

    def _stores(self, request: Request, site: Site) -> Response:
        return _html(comparisons.stores_page(site, self._comparisons))

    def _home(self, request: Request, site: Site) -> Response:
        return _html(runs.home_page(site))

    def _run(self, request: Request, site: Site) -> Response:
        return _html(runs.run_page(site, request.path_params["run"]))

    def _now(self, request: Request, site: Site) -> Response:
        return _html(str(runs.run_now(site, request.path_params["run"])))

    def _state(self, request: Request, site: Site) -> Response:
        return _json(runs.run_json(site, request.path_params["run"]))

    def _log(self, request: Request, site: Site) -> Response:
        return _html(runs.log_page(site, request.path_params["run"], request.path_params["key"]))

    def _confirm(self, request: Request, site: Site) -> Response:
        asked = request.query_params
        return _html(runs.confirm_page(site, request.path_params["run"], asked.get("what", ""), asked.get("node", "")))

    def _ask(self, request: Request, site: Site) -> Response:
        form = self._checked(request, site)
        runs.asked(site, request.path_params["run"], form.get("what", ""), form.get("node", ""))
        return RedirectResponse(site.links.run(request.path_params["run"]), 303)

    # -- films and notes ------------------------------------------------------------------------------------------------------------

    def _film(self, request: Request, site: Site) -> Response:
        films, key, number, kind, step = self._film_of(request, site)
        return _json(films.ask(key, number, kind, step) if request.method == "POST" else films.state(key, number, kind, step))

    def _frame(self, request: Request, site: Site) -> Response:
        films, key, number, kind, step = self._film_of(request, site)
        found = films.frame(key, number, kind, request.path_params["frame"], step)
        return PlainTextResponse("not found", 404) if found is None else page(*found, POLICY)

    def _film_of(self, request: Request, site: Site) -> tuple[Films, str, int, str, int]:
        key, kind = request.path_params["key"], request.path_params["kind"]
        listed, _ = site.cells.find(key)
        if site.films is None or kind not in KINDS or [cell.key for cell in listed] != [key]:
            raise UsageError("there is no such film")
        return site.films, key, request.path_params["number"], kind, pages.require_step(request.query_params.get("step")) or 0

    def _note(self, request: Request, site: Site) -> Response:
        form = self._checked(request, site)
        cell, found = site.one(form.get("key", ""))
        episode = pages.require_step(form.get("episode"))
        if episode is not None:
            pages.require_episode(found, episode)
        mark = mark_of(form.get("mark", ""))
        add_note(site.layout, Note(cell.key, cell.label, episode, form.get("text", ""), mark, form.get("author", "")))
        ref = site.ref(cell)
        place = site.links.cell(ref) if episode is None else site.links.episode(ref, episode)
        return RedirectResponse(place, 303)

    def _checked(self, request: Request, site: Site) -> dict[str, str]:
        """The fields of a form of ours.

        Raises:
            UsageError: it is none.
        """
        form: dict[str, str] = request.state.form
        if form.get("form") != site.form:
            raise UsageError("this form is of another server", "load the page again")
        return form


async def _form(request: Request) -> dict[str, str]:
    """The fields of a form; of one that is too long, none."""
    body = b""
    async for part in request.stream():
        body += part
        if len(body) > LONGEST:
            return {}
    try:
        return {name: values[-1] for name, values in parse_qs(body.decode(), keep_blank_values=True, max_num_fields=20).items()}
    except ValueError:
        return {}


def _html(text: str, status: int = 200) -> Response:
    return page(text.encode("utf-8", "replace"), "text/html", POLICY, status, REFERRER)


def _json(value: Any) -> Response:
    return JSONResponse(json.loads(json.dumps(value)), headers={"Cache-Control": "no-store", "X-Content-Type-Options": "nosniff"})
