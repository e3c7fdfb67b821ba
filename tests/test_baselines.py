"""docs/baselines.md says what the session `external` measured: theirs beside ours, and what
holds of it.
"""

import json
from pathlib import Path

import external
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

PAGE = (Path(__file__).parents[1] / "docs" / "baselines.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("expert", external.EXPERTS)
def test_the_tables_are_the_published_rows(expert):
    rows = pq.read_table(external.ROWS)
    for table in (external.table, external.verdicts, external.sweep):
        assert table(rows, expert) in PAGE


def test_so_is_what_was_trained():
    assert external.parts(json.loads(external.PARTS.read_text())) in PAGE


def rows_of(shares: dict[tuple[str, float], tuple[int, int]]) -> pa.Table:
    """A hundred episodes of the noisy lander for each (assistant, ratio), of which so many
    reached the goal and so many crashed.
    """
    return pa.Table.from_pylist(
        [
            {
                "expert": "ours",
                "world": "lander",
                "pilot": "noisy",
                "value": 0.3,
                "assistant": assistant,
                "ratio": ratio,
            }
            | {"group": 0, "episode": i, "reached": i < reached, "crashed": i >= 100 - crashed}
            for (assistant, ratio), (reached, crashed) in shares.items()
            for i in range(100)
        ]
    )


@pytest.mark.parametrize(
    ("alone", "assisted", "free", "expected"),
    [
        (
            (20, 30),
            (68, 8),
            (29, 18),
            [
                "yes (+48.0, theirs +47.3)",
                "yes (to 27 %, theirs 27 %)",
                "yes (-39.0, theirs -39.0)",
            ],
        ),
        (
            (20, 30),
            (55, 16),
            (54, 18),
            [
                "**no** (+35.0, theirs +47.3)",
                "**no** (to 53 %, theirs 27 %)",
                "**no** (-1.0, theirs -39.0)",
            ],
        ),
    ],
)
def test_verdicts_follow_from_the_shares(alone, assisted, free, expected):
    rows = rows_of({("alone", 0.0): alone, ("diffusion", 0.4): assisted, ("diffusion", 1.0): free})
    assert [
        cell.strip() for cell in external.verdicts(rows, "ours").splitlines()[-1].split("|")[3:6]
    ] == expected


def test_a_cell_that_was_not_measured_is_left_open():
    text = external.table(rows_of({("alone", 0.0): (20, 30), ("diffusion", 0.4): (68, 8)}), "ours")
    assert (
        text.splitlines()[-1]
        == "| Lander | noisy 0.3 | 20.7 / 28.3 | 68.0 / 7.7 | +47.3 | 20.0 / 30.0 | 68.0 / "
        "8.0 | +48.0 |  |  |"
    )
