"""`wasp verify`: stored cells are computed again."""

from __future__ import annotations

from typing import Annotated

import typer

from wasp_cli.cli import options
from wasp_cli.cli.command import command
from wasp_cli.cli.parameters import flag, option
from wasp_cli.cli.submit import BoardOption, verify_submission
from wasp_cli.console import out as console
from wasp_cli.console import say
from wasp_cli.store.layout import Layout


@command(
    "wasp verify results/ --cells 30 --seed 7",
    "wasp verify leaderboard/halfway",
    codes="0 all are the same, 1 some are not, or the folder cannot be read or was changed, 2 "
    "usage, 3 the spec of a submission is invalid here",
)
def verify(
    results: options.Folder,
    cells: Annotated[
        int | None,
        option("N", "Cells that are drawn. (default: 30; of a submission its sample)", min=1),
    ] = None,
    seed: Annotated[int, option("N", "Seed of the draw.", min=0)] = 0,
    anywhere: Annotated[
        bool, flag("--anywhere", "Draw also from cells that another kind of processor computed.")
    ] = False,
    jobs: options.JobsOption = None,
    yes: Annotated[bool, flag("--yes", "Do not ask. Required without a terminal.", "-y")] = False,
    board: BoardOption = None,
) -> None:
    """Compute some cells again and compare to the bit.

    They are drawn, and computed from the models beside them. Nothing in the folder changes. Wall
    times are not compared. What differs with AVX512 is computed once more with AVX2. Of a
    submission to the leaderboard every file is checked first; then its code runs, if you agree.
    """
    from wasp_cli.leaderboard.folder import is_submission
    from wasp_cli.run.cores import cores
    from wasp_cli.run.verify import draw, kind, show_answer
    from wasp_cli.run.verify import verify as verified

    if is_submission(results.path):
        verify_submission(results.path, cells=cells, seed=seed, jobs=jobs, yes=yes, board=board)
        return
    layout = Layout(results.path.absolute())
    drawn = draw(layout, 30 if cells is None else cells, seed, anywhere=anywhere)
    others = (
        f"{drawn.others} others cannot be: models are not in the folder, a person drove, or a "
        "module is not wasp's"
    )
    left_out = ""
    if drawn.elsewhere:
        left_out = f"; {drawn.elsewhere} of another kind of processor are left out (--anywhere)"
    say(f"{len(drawn.cells)} of {drawn.of} cells are computed again{left_out}; {others}")
    answers = []
    for answer in verified(layout, drawn.cells, cores() if jobs is None else max(1, jobs)):
        answers.append(answer)
        show_answer(answer, console())
    same = sum(not answer.differing for answer in answers)
    console().print(f"{same} of {len(drawn.cells)} cells are the same to the bit", markup=False)
    elsewhere = sum(
        bool(answer.means) and kind(answer.then) != kind(answer.here) for answer in answers
    )
    if elsewhere:
        remark = (
            "processors round differently, and an episode may then go another way: see how far "
            "the means are apart"
        )
        say(f"{elsewhere} of the others were computed on another processor; {remark}")
    if same < len(drawn.cells):
        raise typer.Exit(1)
