"""`wasp note`: what a person says of a cell or an episode."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from wasp_cli.cli import options
from wasp_cli.cli.command import command
from wasp_cli.cli.parameters import argument, flag, option
from wasp_cli.console import say
from wasp_cli.errors import UsageError
from wasp_cli.store.layout import Layout

if TYPE_CHECKING:
    from wasp_cli.report.notes import Mark


@command(
    "wasp note 'goal1 s1 wasp laggy=0.7' --episode 3 --invalid 'the robot starts within a hazard'",
    "wasp note 'goal1 s1 wasp laggy=0.7' 'worth a look'",
    "wasp note 'goal1 s1 wasp laggy=0.7' -e 3 --valid ''",
    codes="0 done, 1 the note cannot be written, 2 no such cell or episode",
)
def note(
    cell: Annotated[
        str, argument("CELL", "A label ('goal1 s1 wasp laggy=0.7'), or the beginning of a key.")
    ],
    text: Annotated[str, argument("TEXT", "What there is to say.")],
    place: options.Whereabouts,
    episode: Annotated[
        int | None, option("E", "One episode. (default: the whole cell)", "--episode", "-e", min=0)
    ] = None,
    invalid: Annotated[bool, flag("--invalid", "Reports leave it out, and say so.")] = False,
    valid: Annotated[bool, flag("--valid", "Take an earlier --invalid back.")] = False,
    author: Annotated[
        str | None, option("NAME", "Who says so. (default: the user of this machine)")
    ] = None,
) -> None:
    """Note something about a cell or an episode.

    Or mark it as invalid. Notes are kept in notes.jsonl beside the store; no result changes.
    Reports show them, leave out what is invalid, and name it.
    """
    from wasp_cli.cells.runs import keys_of
    from wasp_cli.report.notes import Note, add_note, one_line
    from wasp_cli.store.find import find_cell
    from wasp_cli.store.tables import read_episodes

    if invalid and valid:
        raise UsageError("--invalid and --valid exclude each other", "name one of them")
    layout = Layout(place.results)
    stored = find_cell(layout, cell, keys_of(layout, place.run, cell))
    if (
        stored.key is None
        or stored.path.absolute().parent.parent != layout.kind("evaluate").absolute()
    ):
        raise UsageError(
            f"'{cell}' is no cell of '{place.results}'",
            "a note is of a cell in the store: name it by its label or its key",
        )
    if episode is not None:
        numbers = read_episodes([stored.path])["episode"].to_pylist()
        if episode not in numbers:
            raise UsageError(
                f"there is no episode {episode}",
                f"this cell has the episodes {min(numbers)} to {max(numbers)}",
            )
    mark: Mark = ""
    if invalid:
        mark = "invalid"
    elif valid:
        mark = "valid"
    given = Note(stored.key, stored.label or stored.key, episode, text, mark, author or "")
    say(one_line(add_note(layout, given)))
