"""`wasp view` and `wasp note`: results in a browser, and what somebody noted about them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from wasp_cli.cli.command import command
from wasp_cli.cli.options import Folder, Whereabouts, argument, directory, flag, option
from wasp_cli.console import say
from wasp_cli.errors import UsageError
from wasp_cli.store.layout import Layout

if TYPE_CHECKING:
    from wasp_cli.report.notes import Mark


@command(
    "wasp view results/",
    "wasp view results/ --open '/cell/goal1 s1 wasp laggy=0.7/episode/3?step=100'",
    codes="0 done, 1 the results cannot be read, 2 usage, or packages of the extra 'web' are missing",
)
def view(
    results: Folder,
    place: Annotated[str, option("PLACE", "The page that opens: an address as pages and commands print it.", "--open")] = "/",
    port: Annotated[int, option("N", "Port on 127.0.0.1; 0: any free one.", min=0, max=65535)] = 0,
    browser: Annotated[bool, flag("--no-browser", "Only print the address.")] = False,
    bundle: Annotated[Path | None, directory("Write the pages to a folder that works from any host, and serve nothing.")] = None,
    cell: Annotated[
        list[str] | None, option("CELL", "With --bundle: a cell whose episodes have pages (repeatable). (default: all cells)")
    ] = None,
    episodes: Annotated[str | None, option("N,N,...", "With --bundle: which of their episodes. (default: 0)")] = None,
) -> None:
    """Walk through results in a browser.

    Cells, episodes, decisions and why; runs as they go on. The pages are served on this machine alone, under an address with a token;
    through an SSH tunnel they work from elsewhere. Nothing of the results is executed or changed.
    """
    try:
        import starlette  # noqa: F401
        import uvicorn  # noqa: F401
    except ImportError as error:
        raise UsageError(f"viewing needs packages that are not here: {error}", "pip install 'wasp-cli[web]'") from error
    from wasp_cli.view.bundle import bundle as write_bundle
    from wasp_cli.view.server import serve
    from wasp_cli.view.site import site_of

    if bundle is not None:
        write_bundle(site_of(results.path, films=False), bundle, cell or [], episodes or "0")
        return
    if cell or episodes:
        raise UsageError("--cell and --episodes go with --bundle", "wasp view results/ --bundle DIR --cell LABEL --episodes 0,3")
    serve(site_of(results.path), port, place, open_browser=not browser)


@command(
    "wasp note 'goal1 s1 wasp laggy=0.7' --episode 3 --invalid 'the robot starts within a hazard'",
    "wasp note 'goal1 s1 wasp laggy=0.7' 'worth a look'",
    "wasp note 'goal1 s1 wasp laggy=0.7' -e 3 --valid ''",
    codes="0 done, 1 the note cannot be written, 2 no such cell or episode",
)
def note(
    cell: Annotated[str, argument("CELL", "A label ('goal1 s1 wasp laggy=0.7'), or the beginning of a key.")],
    text: Annotated[str, argument("TEXT", "What there is to say.")],
    place: Whereabouts,
    episode: Annotated[int | None, option("E", "One episode. (default: the whole cell)", "--episode", "-e", min=0)] = None,
    invalid: Annotated[bool, flag("--invalid", "Reports leave it out, and say so.")] = False,
    valid: Annotated[bool, flag("--valid", "Take an earlier --invalid back.")] = False,
    author: Annotated[str | None, option("NAME", "Who says so. (default: the user of this machine)")] = None,
) -> None:
    """Note something about a cell or an episode.

    Or mark it as invalid. Notes are kept in notes.jsonl beside the store; no result changes. Reports show them, leave out what is
    invalid, and name it.
    """
    from wasp_cli.plan.recorded import keys_of
    from wasp_cli.report.notes import Note, add_note, one_line
    from wasp_cli.store.bounds import require_size
    from wasp_cli.store.find import find_cell
    from wasp_cli.store.tables import read_episodes

    if invalid and valid:
        raise UsageError("--invalid and --valid exclude each other", "name one of them")
    layout = Layout(place.results)
    stored = find_cell(layout, cell, keys_of(layout, place.run))
    if stored.key is None or stored.path.absolute().parent.parent != layout.kind("evaluate").absolute():
        raise UsageError(f"'{cell}' is no cell of '{place.results}'", "a note is of a cell in the store: name it by its label or its key")
    if episode is not None:
        require_size(stored.path)
        numbers = read_episodes([stored.path])["episode"].to_pylist()
        if episode not in numbers:
            raise UsageError(f"there is no episode {episode}", f"this cell has the episodes {min(numbers)} to {max(numbers)}")
    mark: Mark = "invalid" if invalid else "valid" if valid else ""
    say(one_line(add_note(layout, Note(stored.key, stored.label or stored.key, episode, text, mark, author or ""))))
