"""`wasp view`: results in a browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from wasp_cli.cli import options
from wasp_cli.cli.command import command
from wasp_cli.cli.options import require_extra
from wasp_cli.cli.parameters import directory, option
from wasp_cli.errors import UsageError


@command(
    "wasp view results/",
    "wasp view results/ --page '/cell/goal1 s1 wasp laggy=0.7/episode/3?step=100'",
    codes="0 done, 1 the results cannot be read, 2 usage, or packages of the extra 'web' are "
    "missing",
)
def view(
    results: options.Folder,
    page: Annotated[
        str,
        option("PLACE", "The page that opens: an address as pages and commands print it."),
    ] = "/",
    # the word that `--page` had before, and that commands printed
    open_: Annotated[
        str | None, option("PLACE", "The same as --page.", "--open", hidden=True)
    ] = None,
    port: options.PortOption = 0,
    browser: options.BrowserOption = True,
    bundle: Annotated[
        Path | None,
        directory("Write the pages to a folder that works from any host, and serve nothing."),
    ] = None,
    cell: Annotated[
        list[str] | None,
        option(
            "CELL",
            "With --bundle: a cell whose episodes have pages (repeatable). (default: all cells)",
        ),
    ] = None,
    episodes: Annotated[
        str | None, option("N,N,...", "With --bundle: which of their episodes. (default: 0)")
    ] = None,
) -> None:
    """Walk through results in a browser.

    Cells, episodes, decisions and why; runs as they go on. The pages are served on this machine
    alone, under an address with a token; through an SSH tunnel they work from elsewhere. Nothing of
    the results is executed or changed.
    """
    require_extra("web", "starlette", "uvicorn")
    from wasp_cli.view.server import bundle as write_bundle
    from wasp_cli.view.server import serve
    from wasp_cli.view.site import site_of

    if open_ is not None and page != "/":
        raise UsageError("--page and --open are one option", "leave out --open")
    place = page if open_ is None else open_
    if bundle is not None:
        if port or place != "/":
            raise UsageError(
                "--port and --page are for a server, and --bundle starts none", "leave them out"
            )
        write_bundle(site_of(results.path, films=False), bundle, cell or [], episodes or "0")
        return
    if cell or episodes:
        raise UsageError(
            "--cell and --episodes go with --bundle",
            "wasp view results/ --bundle DIR --cell LABEL --episodes 0,3",
        )
    serve(site_of(results.path), port, place, open_browser=browser)
