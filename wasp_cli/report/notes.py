"""Notes on cells and episodes, and marks of what is invalid: one line each in `notes.jsonl` beside
the store, never in a result's bytes.

The file is only appended to: a later `valid` takes back an earlier `invalid`. It may be untrusted,
as everything in a results folder.
"""

from __future__ import annotations

import getpass
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from typing import Any, Literal, cast, get_args

import numpy as np

from wasp_cli.cells.read import Missing
from wasp_cli.errors import StoreError, UsageError, refusal
from wasp_cli.report.stats import Frame
from wasp_cli.store.layout import Layout, is_key
from wasp_cli.store.plain import append_line, open_plain, printable, read_json_lines

FILE = "notes.jsonl"
LONGEST = 2000  # characters of a note
Mark = Literal["", "invalid", "valid"]


@dataclass(frozen=True)
class Note:
    """A note on a cell or one of its episodes, possibly with a mark that it is invalid or valid
    again.
    """

    key: str  # of the cell
    label: str
    episode: int | None  # None: the cell
    text: str
    mark: Mark = ""
    author: str = ""
    at: str = ""  # when it was written, ISO, UTC

    @property
    def where(self) -> str:
        """The label of the cell, and the number of the episode if the note is about one."""
        return self.label if self.episode is None else f"{self.label}, episode {self.episode}"


def one_line(note: Note, *, past: bool = False) -> str:
    """Return a note on one line: where, mark, text, author and day.

    Args:
        past: whether its mark was taken back by a later note.
    """
    text = " ".join(note.text.split())
    if note.mark:
        mark = f"[{note.mark}, taken back]" if past else f"[{note.mark}]"
        text = f"{mark} {text}".rstrip()
    return f"{note.where}: {text} ({note.author}, {note.at[:10]})"


def lines_of(notes: Sequence[Note]) -> list[str]:
    """Return each note on one line, in their order; invalid marks that no longer hold say so."""
    still_invalid = invalid(notes)
    lines = []
    for note in notes:
        taken_back = note.mark == "invalid" and (note.key, note.episode) not in still_invalid
        lines.append(one_line(note, past=taken_back))
    return lines


def author_name() -> str:
    """Return the user name of this process; `unknown` if the system has none."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return "unknown"


def add_note(layout: Layout, note: Note) -> Note:
    """Append a note to `notes.jsonl` of a results folder, and return it as it was written: with its
    time, its author (this user if it names none) and unprintable characters replaced.

    Raises:
        UsageError: it has neither text nor mark, or more than LONGEST characters.
        StoreError: the file cannot be written, or is a link.
    """
    text = printable(note.text).strip()
    author = printable(note.author).strip()[:80] or author_name()
    if not text and not note.mark:
        raise UsageError("the note has neither text nor mark", "write a text")
    if len(text) > LONGEST:
        raise UsageError(f"the note has {len(text)} characters; at most {LONGEST} are allowed")
    note = replace(
        note, text=text, author=author, at=datetime.now(UTC).isoformat(timespec="seconds")
    )
    path = layout.within(layout.root / FILE)
    try:
        # One write, so that the lines of two people who write at once do not mix. O_NOFOLLOW: never
        # through a link.
        flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
        file = os.open(path, flags, 0o666)
        try:
            append_line(file, json.dumps(asdict(note), ensure_ascii=False))
        finally:
            os.close(file)
    except OSError as error:
        raise StoreError(
            f"the note cannot be written to '{path}': {refusal(error).message}"
        ) from error
    return note


def notes_of(layout: Layout) -> list[Note]:
    """Return all notes of a results folder, oldest first. Lines that are not valid notes are left
    out; without a file there are none.

    Raises:
        StoreError: the file cannot be read. It is not passed over, since a cell that is marked as
            invalid would then count as valid.
    """
    path = layout.within(layout.root / FILE)
    try:
        open_plain(path).close()
        records = read_json_lines(path)
    except FileNotFoundError:
        return []
    except OSError as error:
        raise StoreError(f"the notes cannot be read: {refusal(error).message}") from error
    notes = [_note(record) for record in records]
    return [note for note in notes if note is not None]


def _note(record: dict[str, Any]) -> Note | None:
    """The note of a line; None if it is malformed."""
    texts = {
        name: record.get(name, "") for name in ("key", "label", "text", "mark", "author", "at")
    }
    episode = record.get("episode")
    if not all(isinstance(text, str) for text in texts.values()) or not is_key(texts["key"]):
        return None
    if not (episode is None or (type(episode) is int and episode >= 0)):
        return None
    mark = texts.pop("mark")
    if mark not in get_args(Mark):
        return None
    return Note(episode=episode, mark=cast(Mark, mark), **texts)


def invalid(notes: Sequence[Note]) -> dict[tuple[str, int | None], Note]:
    """Return what is marked as invalid and was not taken back: by key and episode (None: the whole
    cell), each with the note that marks it.
    """
    marked: dict[tuple[str, int | None], Note] = {}
    for note in notes:
        if note.mark == "invalid":
            marked[note.key, note.episode] = note
        elif note.mark == "valid":
            marked.pop((note.key, note.episode), None)
    return marked


def without_invalid(
    frame: Frame, marked: Mapping[tuple[str, int | None], Note]
) -> tuple[Frame, tuple[str, ...]]:
    """Return a frame without the cells and episodes that are marked as invalid, and a sentence for
    each of them. A cell that is left out counts as missing.
    """
    if not marked:
        return frame, ()
    table = frame.cells
    kept = np.ones(len(table.place), bool)
    missing: list[Missing] = []
    judged = dict(frame.judged)
    sentences: list[str] = []
    for place, cell in enumerate(table.cells):
        # The notes on this cell, and its episodes that they mark.
        own = {episode: note for (key, episode), note in marked.items() if key == cell.key}
        count = int(table.counts[place])
        episodes = sorted(episode for episode in own if episode is not None and episode < count)
        if None not in own and not episodes:
            continue
        rows = table.rows_of(place)
        kept[rows.start + np.array(episodes, np.intp)] = False
        if None in own or not kept[rows].any():
            # The whole cell: because of a note on it, or since no episode is left.
            kept[rows] = False
            first = own[None] if None in own else next(iter(own.values()))
            reason = f"marked as invalid by {first.author}: {first.text}"
            missing.append(Missing(cell, reason, first.label, invalid=True))
            judged.pop(cell.key, None)
            sentences.append(f"The cell {first.label} is left out: {_why(first)}.")
            continue
        for episode in episodes:
            note = own[episode]
            sentences.append(f"Episode {episode} of {note.label} is left out: {_why(note)}.")
        if cell.key in judged:
            judged[cell.key] = judged[cell.key].of_episodes(kept[rows])
    if not sentences:
        return frame, ()

    # A first sentence with the totals.
    counted = [
        _counted(len(sentences) - len(missing), "episode"),
        _counted(len(missing), "cell"),
    ]
    verb = "is" if len(sentences) == 1 else "are"
    total = " and ".join(text for text in counted if text)
    valid = replace(
        frame,
        cells=table.with_episodes(kept),
        missing=(*frame.missing, *missing),
        judged=judged,
    )
    return valid, (f"{total} marked as invalid {verb} not counted in any number here.", *sentences)


def _counted(count: int, name: str) -> str:
    """A number of things in words; an empty text for none."""
    if not count:
        return ""
    return f"{count} {name}" if count == 1 else f"{count} {name}s"


def _why(note: Note) -> str:
    reason = f"marked as invalid by {note.author} on {note.at[:10]}"
    if note.text:
        reason += f", {note.text.rstrip('.')}"
    return reason
