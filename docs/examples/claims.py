"""Judge the paper's claims by the published rows, as REPRODUCTION.md lists them: no plan, nothing is computed anew.

python docs/examples/claims.py
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from wasp_cli.plan.reuse import lay_out_over
from wasp_cli.report.claims import Answer, Judged, VerdictReport, any_of, judge
from wasp_cli.report.claims_text import PLAIN, sentence
from wasp_cli.report.render import markdown_row
from wasp_cli.report.stats import Frame, Wanted, read_frame, with_branches
from wasp_cli.spec.load import load
from wasp_cli.spec.paper import load_paper
from wasp_cli.store.branches import BRANCHES_FILE, read_branches
from wasp_cli.store.layout import Layout
from wasp_cli.store.tables import CellIdentity, read_episodes

ROOT = Path(__file__).parents[2]
STORE = ROOT / "results" / "published" / "store"
SPECS = ("table1", "table2", "figure3")
HEADINGS = ("Claim", "Verdict", "As printed", "In", "Decides")


def cells_of(pattern: str) -> dict[CellIdentity, Path]:
    """Return the tables of the store that match and are not the second edition's, by the cell that their rows name."""
    second = lay_out_over(load(ROOT / "specs" / "edition2.yaml").spec, Layout(ROOT / "nowhere"), str(STORE.parent))
    keys = {node.key for node in second.nodes}
    return {identity_of(path): path for path in sorted(STORE.glob(pattern)) if path.parent.name not in keys}


def identity_of(path: Path) -> CellIdentity:
    """Return the cell that a table of episodes or of branches names."""
    if path.name == BRANCHES_FILE:
        return read_branches(path).cell.identity
    names = list(CellIdentity.__dataclass_fields__)
    return CellIdentity(**read_episodes([path]).select(names).slice(0, 1).to_pylist()[0])


def frame_of(name: str, cells: dict[CellIdentity, Path], branches: dict[CellIdentity, Path]) -> Frame:
    """Return the published cells that a spec asks for, of Figure 3 with their branches, whatever the spec sets now."""
    spec = load(ROOT / "specs" / f"{name}.yaml").spec
    operators = {(operator, value) for operator, values in spec.operators.items() for value in values.values()}
    wanted = [
        Wanted(cell, str(cell), path, branches=Wanted(cell, str(cell), branches[cell]) if name == "figure3" and cell in branches else None)
        for cell, path in cells.items()
        if (cell.operator, cell.value) in operators
        and cell.task in spec.tasks
        and cell.seed in spec.seeds
        and cell.variant in (*spec.variants, "full", "as-printed")
    ]
    return with_branches(read_frame(wanted), wanted)


def as_printed(frame: Frame) -> Frame:
    """Return the frame with the rows of WASP (as printed) in the place of WASP's."""
    printed = [cell for cell in frame.cells if cell.identity.variant == "as-printed"]
    others = [cell for cell in frame.cells if cell.identity.method != "wasp"]
    return Frame((*others, *(replace(cell, identity=replace(cell.identity, variant="full")) for cell in printed)))


def word(judged: Judged | None) -> str:
    """Return an outcome as the page prints it."""
    if judged is None or judged.outcome == "untested":
        return "n/a"
    return f"**{PLAIN['fails']}**" if judged.outcome == "fails" else PLAIN[judged.outcome]


def decides(judged: Judged) -> str:
    """Put the first comparison with the claim's outcome into words, and count those that share it."""
    found = [answers for answers in judged.answers if any_of(answers) == judged.outcome]
    first: Answer = next(answer for answer in found[0] if answer.outcome == judged.outcome)
    either = "one is enough: " if len(found[0]) > 1 else ""
    return f"{either}{sentence(first)}; {len(found)} of {len(judged.answers)} comparisons"


def rows_of(verdicts: dict[str, VerdictReport], second: VerdictReport) -> Iterator[tuple[str, ...]]:
    """Yield the row of every claim, from the first report that tests it as a whole."""
    for i, claim in enumerate(load_paper().claims):
        name, judged = next((name, found.claims[i]) for name, found in verdicts.items() if found.claims[i].outcome != "untested")
        names = {side for question in claim.questions() for asked in question for side in (asked.left, asked.right) if side}
        printed = second.claims[i] if {who.variant for who in names if who.method == "wasp"} == {"full"} else None
        yield f"{claim.says} (`{claim.id}`)", word(judged), word(printed), name, decides(judged)


def table() -> str:
    """Return the table of all claims in Markdown."""
    cells, branches = cells_of("evaluate/*/episodes.parquet"), cells_of("counterfactual/*/branches.parquet")
    frames = {name: frame_of(name, cells, branches) for name in SPECS}
    verdicts = {name: judge(frame, load_paper()) for name, frame in frames.items()}
    rows = rows_of(verdicts, judge(as_printed(frames["table1"]), load_paper()))
    return "\n".join(markdown_row(row) for row in (HEADINGS, ["---"] * len(HEADINGS), *rows))


if __name__ == "__main__":
    print(table())
