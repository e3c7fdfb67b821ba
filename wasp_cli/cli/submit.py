"""The commands of the leaderboard, `wasp submit` and `wasp leaderboard`; and the part of `wasp
verify` for submissions.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from wasp_cli.cli import options
from wasp_cli.cli.command import command
from wasp_cli.cli.completion import spec_names
from wasp_cli.cli.parameters import argument, directory, flag, option, parse_folder
from wasp_cli.console import duration, say
from wasp_cli.console import out as console
from wasp_cli.errors import UsageError, WaspError
from wasp_cli.store.layout import is_name, slug

FOLDER = Path("leaderboard")
"""Where submissions are, beside LEADERBOARD.md."""

BoardOption = Annotated[
    Path | None,
    option(
        "SPEC",
        "A board of your own. (default: the shipped one)",
        "--board",
        among=spec_names,
    ),
]


@command(
    "wasp submit my.yaml --by 'Jane Doe, Example University'",
    "wasp submit my.yaml --by Anonymous --no-source",
    codes="0 written, 1 a cell failed or is missing, 2 usage, 3 the spec is invalid or changes "
    "what is the board's, 130 interrupted",
)
def submit(
    spec: Annotated[
        Path, argument("SPEC", "A YAML file that lists your assistant.", among=spec_names)
    ],
    by: Annotated[
        str | None, option("TEXT", "Who submits, as the leaderboard shows it.", "--by")
    ] = None,
    method: Annotated[
        str | None,
        option("NAME", "Which assistant, if the spec lists several of yours.", "--method", "-m"),
    ] = None,
    out: Annotated[
        Path | None,
        directory(
            "The folder that is written. (default: leaderboard/ and the name of the spec)",
            "--out",
            "-o",
        ),
    ] = None,
    source: Annotated[
        bool,
        flag("--source/--no-source", "Copy the assistant's files too, or only their hashes."),
    ] = True,
    force: Annotated[bool, flag("--force", "Replace a submission that is there.")] = False,
    board: BoardOption = None,
    results: options.ResultsOption = options.RESULTS,
    set_: options.SetOption = None,
    jobs: options.JobsOption = None,
) -> None:
    """Evaluate an assistant of your own for the leaderboard.

    It drives in all worlds of the board, with published models. What is computed already is used.
    A folder is written that others can check with wasp verify; docs/leaderboard.md has the rules.
    """
    from wasp_cli.leaderboard.board import board_of
    from wasp_cli.leaderboard.entry import entry_of
    from wasp_cli.leaderboard.folder import read_submission, require_free
    from wasp_cli.leaderboard.submit import computed, write_submission
    from wasp_cli.run.cores import cores
    from wasp_cli.run.session import RunOptions
    from wasp_cli.spec.load import load

    asked = load(spec, set_ or ())
    place = FOLDER / slug(asked.spec.name) if out is None else out
    if not is_name(place.name):
        raise UsageError(f"'{place.name}' cannot name a submission", "--out names another folder")
    require_free(place, force=force)
    board_ = board_of(board)
    entry = entry_of(asked, board_, method)
    if by is None or not by.strip():
        raise UsageError(
            "who submits is missing", "--by 'Jane Doe, Example University', or --by Anonymous"
        )
    session = computed(entry, board_, results, RunOptions(cores() if jobs is None else jobs))
    write_submission(session, entry, board_, place, by=by.strip(), source=source, force=force)
    written = read_submission(place)
    say(
        f"written: {place} ({len(written.keys)} cells, computed in {duration(written.seconds)})",
        f"next: wasp leaderboard {place}   (your line among the others)",
        f"      wasp verify {place} --yes   (what others will do: a sample of it again)",
    )


@command(
    "wasp leaderboard",
    "wasp leaderboard leaderboard/halfway --out LEADERBOARD.md",
    codes="0 done, 1 a submission was changed or is not complete, 2 usage",
)
def leaderboard(
    folders: Annotated[
        list[Path] | None,
        argument("[DIR...]", "Submissions. (default: all in leaderboard/)", parser=parse_folder),
    ] = None,
    out: Annotated[
        Path | None, option("FILE", "Write there. (default: print it)", "--out", "-o")
    ] = None,
    board: BoardOption = None,
) -> None:
    """Make the leaderboard of published rows and submissions.

    As Markdown. Nothing is computed: wasp verify does that.
    """
    from wasp_cli.leaderboard.board import board_of
    from wasp_cli.leaderboard.lines import shipped_lines, submitted_lines
    from wasp_cli.leaderboard.page import page_of

    asked = folders if folders else _submissions()
    on = board_of(board)
    submitted = submitted_lines(asked, on)
    text = page_of(shipped_lines(on), submitted, on, Path() if out is None else out.parent)
    if out is None:
        say(text.rstrip("\n"))
    else:
        from wasp_cli.store.records import replace_file

        replace_file(out, text)
        say(f"written: {out} ({len(asked)} submissions)")


def _submissions() -> list[Path]:
    """The submissions of the current folder, by name."""
    from wasp_cli.leaderboard.folder import SUBMISSION

    return sorted(path.parent for path in FOLDER.glob(f"*/{SUBMISSION}"))


def verify_submission(
    folder: Path,
    *,
    cells: int | None,
    seed: int,
    jobs: int | None,
    yes: bool,
    board: Path | None,
) -> None:
    """Check a submission and compute cells of it again.

    Args:
        folder: of the submission.
        cells: how many are drawn; None: its own sample.
        seed: of the draw.
        jobs: processes at most; None: all cores.
        yes: whether its source may run without a question.
        board: the spec of another board.

    Raises:
        ArtifactError: it was changed or is not complete.
        UsageError: its source may not run, or nobody can be asked.
        typer.Exit: rows are not the same.
    """
    from wasp_cli.leaderboard.again import answers
    from wasp_cli.leaderboard.board import board_of
    from wasp_cli.leaderboard.cells import drawn, label_of
    from wasp_cli.leaderboard.check import checked
    from wasp_cli.run.cores import cores
    from wasp_cli.run.verify import kind, show_answer

    on = board_of(board)
    submission, rows = checked(folder, on)
    say(f"{submission.shown}: {len(rows)} of {len(rows)} cells are there, and no file was changed")
    if cells is None:
        chosen = [cell for cell in rows if label_of(cell) in submission.sample]
    else:
        chosen = drawn(list(rows), cells, seed)
    _require_consent(folder, yes=yes)
    found = []
    workers = cores() if jobs is None else max(1, jobs)
    for answer in answers(folder, submission, rows, on, chosen, workers):
        found.append(answer)
        show_answer(answer, console())
    same = sum(not answer.differing for answer in found)
    say(f"{same} of {len(chosen)} cells are the same to the bit")
    elsewhere = [each for each in found if each.differing and kind(each.then) != kind(each.here)]
    if elsewhere:
        say(
            f"{len(elsewhere)} of the others were computed on another processor, which rounds "
            "differently: see how far the means are apart"
        )
    if same < len(chosen):
        raise NotTheSame(
            f"refused: {len(chosen) - same} cells of '{folder}' do not follow from its source",
            None if elsewhere else "its rows were changed, or computed by other code",
        )


class NotTheSame(WaspError):
    """Cells of a submission were computed again, with other results."""


def _require_consent(folder: Path, *, yes: bool) -> None:
    """Ask whether the source of a submission may run. Raises UsageError if not, or if nobody can be
    asked.
    """
    if yes:
        return
    question = f"To compute cells again, the code of '{folder}' runs with your rights. Run it?"
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise UsageError(
            f"nothing was computed again: the code of '{folder}' would run with your rights",
            "read it, then give --yes",
        )
    if not typer.confirm(question):
        raise UsageError("nothing was computed again", "read the source, then give --yes")
