"""`wasp view` and `wasp note`: results in a browser, and what somebody noted about them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from wasp_cli.cli.options import ResultsArgument, ResultsOption, expected_errors, flag, option, parse_folder, results_folder

view_app = typer.Typer()


@view_app.command(
    rich_help_panel="Results",
    epilog="[bold]wasp view results/[/]   ·   [bold]wasp view results/ --open '/cell/goal1 s1 wasp laggy=0.7/episode/3?step=100'[/]\n\n"
    "Exit codes: 0 done, 1 the results cannot be read, 2 usage, or packages of the extra 'web' are missing.",
)
@expected_errors
def view(
    folder: ResultsArgument = None,
    place: Annotated[
        str, typer.Option("--open", metavar="PLACE", help="The page that opens: an address as pages and commands print it.")
    ] = "/",
    port: Annotated[int, typer.Option("--port", min=0, max=65535, metavar="N", help="Port on 127.0.0.1; 0: any free one.")] = 0,
    browser: Annotated[bool, flag("--no-browser", help="Only print the address.")] = False,
    other: Annotated[
        Path | None, option("--with", metavar="DIR", parser=parse_folder, help="A second results folder: where do the two differ?")
    ] = None,
    results: ResultsOption = Path("results"),
) -> None:
    """Walk through results in a browser: cells, episodes, decisions and why; runs as they go on.

    The pages are served on this machine alone, under an address with a token; through an SSH tunnel they work from elsewhere. Nothing of
    the results is executed or changed.
    """
    from wasp_cli.errors import UsageError

    try:
        import starlette  # noqa: F401
        import uvicorn  # noqa: F401
    except ImportError as error:
        raise UsageError(f"viewing needs packages that are not here: {error}", "pip install 'wasp-cli[web]'") from error
    from wasp_cli.view.command import site_of
    from wasp_cli.view.command import view as served

    served(site_of(results_folder(folder, results), other), port, place, open_browser=not browser)
