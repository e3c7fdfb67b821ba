"""`wasp view` and `wasp note`: results in a browser, and what somebody noted about them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from wasp_cli.cli.options import (
    ResultsArgument,
    ResultsOption,
    RunOption,
    argument,
    expected_errors,
    flag,
    option,
    parse_folder,
    results_folder,
)

if TYPE_CHECKING:
    from wasp_cli.report.notes import Mark

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
    bundle: Annotated[
        Path | None,
        option(
            "--bundle", metavar="DIR", parser=parse_folder, help="Write the pages to a folder that works from any host, and serve nothing."
        ),
    ] = None,
    cell: Annotated[
        list[str] | None,
        option("--cell", metavar="CELL", help="With --bundle: a cell whose episodes have pages (repeatable). (default: all cells)"),
    ] = None,
    episodes: Annotated[
        str | None, option("--episodes", metavar="N,N,...", help="With --bundle: which of their episodes. (default: 0)")
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
    from wasp_cli.view.bundle import bundle as write_bundle
    from wasp_cli.view.server import serve
    from wasp_cli.view.site import site_of

    if bundle is not None:
        write_bundle(site_of(results_folder(folder, results), films=False), bundle, cell or [], episodes or "0")
        return
    if cell or episodes:
        raise UsageError("--cell and --episodes go with --bundle", "wasp view results/ --bundle DIR --cell LABEL --episodes 0,3")
    serve(site_of(results_folder(folder, results)), port, place, open_browser=not browser)


@view_app.command(
    rich_help_panel="Results",
    epilog="[bold]wasp note 'goal1 s1 wasp laggy=0.7' --episode 3 --invalid 'the robot starts within a hazard'[/]   ·   "
    "[bold]wasp note 'goal1 s1 wasp laggy=0.7' 'worth a look'[/]   ·   [bold]wasp note 'goal1 s1 wasp laggy=0.7' -e 3 --valid ''[/]\n\n"
    "Exit codes: 0 done, 1 the note cannot be written, 2 no such cell or episode.",
)
@expected_errors
def note(
    cell: Annotated[str, argument(metavar="CELL", help="A label ('goal1 s1 wasp laggy=0.7'), or the beginning of a key.")],
    text: Annotated[str, argument(metavar="TEXT", help="What there is to say.")],
    episode: Annotated[int | None, option("--episode", "-e", min=0, metavar="E", help="One episode. (default: the whole cell)")] = None,
    invalid: Annotated[bool, flag("--invalid", help="Reports leave it out, and say so.")] = False,
    valid: Annotated[bool, flag("--valid", help="Take an earlier --invalid back.")] = False,
    author: Annotated[str | None, option("--author", metavar="NAME", help="Who says so. (default: the user of this machine)")] = None,
    run: RunOption = None,
    results: ResultsOption = Path("results"),
) -> None:
    """Note something about a cell or an episode, or mark it as invalid.

    Notes are kept in notes.jsonl beside the store; no result changes. Reports show them, leave out what is invalid, and name it.
    """
    from wasp_cli.console import say
    from wasp_cli.errors import UsageError
    from wasp_cli.plan.recorded import keys_of
    from wasp_cli.report.notes import Note, add_note, one_line
    from wasp_cli.store.bounds import require_size
    from wasp_cli.store.find import find_cell
    from wasp_cli.store.layout import Layout
    from wasp_cli.store.tables import read_episodes

    if invalid and valid:
        raise UsageError("--invalid and --valid exclude each other", "name one of them")
    layout = Layout(results)
    found = find_cell(layout, cell, keys_of(layout, run))
    if found.key is None or found.path.absolute().parent.parent != layout.kind("evaluate").absolute():
        raise UsageError(f"'{cell}' is no cell of '{results}'", "a note is of a cell in the store: name it by its label or its key")
    if episode is not None:
        require_size(found.path)
        numbers = read_episodes([found.path])["episode"].to_pylist()
        if episode not in numbers:
            raise UsageError(f"there is no episode {episode}", f"this cell has the episodes {min(numbers)} to {max(numbers)}")
    mark: Mark = "invalid" if invalid else "valid" if valid else ""
    say(one_line(add_note(layout, Note(found.key, found.label or found.key, episode, text, mark, author or ""))))
