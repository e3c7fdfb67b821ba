"""Numbers that followed from a task are said where its results are."""

import pytest

from wasp_cli.report.shortfalls import chosen_sentences
from wasp_cli.report.trained.artifacts import Trained


def part(kind: str, **summary: float) -> Trained:
    return Trained(kind, "puddle:Puddle-v0", 0, "k", None, summary, kind)


@pytest.mark.parametrize(
    ("kind", "summary", "named"),
    [
        ("expert", {"cost_limit": 6.0}, "cost_limit of 6 "),
        ("policies", {"cost_allowance": 0.6}, "cost_allowance of 0.6 "),
        ("residual", {"cost_limit": 6.0}, "cost_limit of 6 "),
        ("calibration", {"incident": 2.0, "tau_c": 0.5}, "tau_c of 0.5 "),
    ],
)
def test_a_number_that_followed_from_the_task_is_said(kind, summary, named):
    (sentence,) = chosen_sentences([part(kind, **summary)])
    assert named in sentence
    assert sentence.startswith("Puddle-v0, training 0: ")


def test_what_was_written_is_not():
    written = [part("expert", cost=3.0), part("policies", cost=2.0), part("residual", multiplier=1)]
    assert chosen_sentences(written) == []
