"""Judge the paper's claims by the published rows, as REPRODUCTION.md lists them: nothing is computed anew.

python docs/examples/claims.py
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from pathlib import Path

from wasp_cli.plan.reuse import lay_out_over
from wasp_cli.report.claims import Answer, Judged, VerdictReport, any_of, judge
from wasp_cli.report.claims_text import PLAIN, sentence
from wasp_cli.report.render import markdown_row
from wasp_cli.report.stats import Frame, read_frame, with_branches
from wasp_cli.report.summarize import wanted_cells
from wasp_cli.spec.load import load
from wasp_cli.spec.paper import load_paper
from wasp_cli.store.layout import Layout

ROOT = Path(__file__).parents[2]
PUBLISHED = ROOT / "results" / "published"
TRAININGS = (1,)


HEADINGS = ("Claim", "WASP", "As printed", "Decides")


@cache
def frame() -> Frame:
    """Return the published cells of the second edition, with their branches."""
    settings = (
        f"seeds={list(TRAININGS)}",
        "variants=[full, safety-only, task-only, no-case2, no-rollout]",
        "stages=[counterfactual]",
        "counterfactual.stride=10",
    )
    spec, layout = load(ROOT / "specs" / "edition2.yaml", settings).spec, Layout(PUBLISHED)
    grid = lay_out_over(spec, Layout(Path("nowhere")), str(PUBLISHED))
    wanted, _ = wanted_cells(layout, spec, *([(cell, node.key) for cell, node in some] for some in (grid.cells, grid.branched)))
    return with_branches(read_frame(wanted), wanted)


def word(judged: Judged | None) -> str:
    """Return an outcome as the page prints it."""
    if judged is None or judged.outcome == "untested":
        return "n/a"
    return f"**{PLAIN['fails']}**" if judged.outcome == "fails" else PLAIN[judged.outcome]


def decides(judged: Judged) -> str:
    """Put the first comparison with the claim's outcome into words, and count those that share it."""
    deciding = [answers for answers in judged.answers if any_of(answers) == judged.outcome]
    if not deciding:
        return ""
    first: Answer = next(answer for answer in deciding[0] if answer.outcome == judged.outcome)
    either = "one is enough: " if len(deciding[0]) > 1 else ""
    return f"{either}{sentence(first)}; {len(deciding)} of {len(judged.answers)} comparisons"


def rows_of(verdict: VerdictReport) -> Iterator[tuple[str, ...]]:
    """Yield the row of every claim: with WASP, and with WASP (as printed) in its place."""
    printed = [who.method for who in verdict.others].index("printed") if verdict.others else None
    for judged in verdict.claims:
        other = None if printed is None else judged.others[printed]
        yield f"{judged.claim.says} (`{judged.claim.id}`)", word(judged), word(other), decides(judged)


def table() -> str:
    """Return the table of all claims in Markdown."""
    rows = rows_of(judge(frame(), load_paper()))
    return "\n".join(markdown_row(row) for row in (HEADINGS, ["---"] * len(HEADINGS), *rows))


if __name__ == "__main__":
    print(table())
