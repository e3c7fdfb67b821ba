"""docs/planner_measured.md says what the published predictions were worth."""

from pathlib import Path

import numpy as np
import reliability

from wasp_cli.metrics.episode import GATE_TASK

PAGE = Path(__file__).parents[1] / "docs" / "planner_measured.md"


def test_the_tables_of_predictions_are_the_published_rows() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert reliability.realised_table("wasp") in page
    assert reliability.predicted_table() in page


def test_every_correction_of_the_task_gate_was_predicted_to_gain_more_than_tau_r() -> None:
    corrections = [
        one
        for task in reliability.TASKS_SHOWN
        for one in reliability.with_predictions(task, "wasp", GATE_TASK)
    ]
    assert len(corrections) == 71
    assert all(one.predicted > one.tau_r for one in corrections)
    assert np.isfinite([one.realised for one in corrections]).all()


def test_the_bins_that_the_page_names_are_the_published_ones() -> None:
    page = " ".join(PAGE.read_text(encoding="utf-8").split())
    rows = reliability.bins_table("wasp", GATE_TASK).splitlines()
    bins = [row.split("|") for row in rows if row.startswith("| FormulaOne1")]
    predicted, realised = (
        [f"{float(row[column].split()[0]):.2f}".lstrip("0") for row in bins] for column in (2, 3)
    )
    told = "predicted {}, {} and {} gained {}, {} and {}".format(*predicted, *realised)
    assert told in page
