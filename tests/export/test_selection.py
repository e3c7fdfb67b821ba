"""Which results a text means."""

from pathlib import Path

import pytest

from tests.export.stored import cell, corrected, recording, store_cell, store_dataset, store_of
from wasp_cli.errors import StoreError, UnknownName, UsageError
from wasp_cli.export.selection import selected
from wasp_cli.export.written import source_of
from wasp_cli.store.layout import Layout

D1, D2 = "goal1 s1 dataset", "race1 s2 dataset"
LAGGY, NOISY = "goal1 s1 wasp laggy=0.7", "goal1 s1 wasp noisy=0.4"
ABLATION = "goal1 s1 wasp/no-case2 laggy=0.7"
PERSON = "goal1 s0 ida person=3"


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Layout:
    layout = store_of(tmp_path_factory.mktemp("selection"))
    store_dataset(layout, [recording([1], 2, 3)])
    store_dataset(layout, [recording([1], 2, 3)], "race1", 2, number=1)
    store_cell(layout, [corrected(2)], cell())
    store_cell(layout, [corrected(2)], cell("noisy", 0.4), 1)
    store_cell(layout, [corrected(2)], cell(variant="no-case2"), 2)
    store_cell(layout, [corrected(2)], cell("person", 3.0, method="ida", seed=0), 3)
    return layout


@pytest.mark.parametrize(
    ("texts", "expected"),
    [
        ([LAGGY], [LAGGY]),
        (["goal1 wasp laggy=0.7 seed 1"], [LAGGY]),
        (["GOAL1 S1 WASP LAGGY=0.7"], [LAGGY]),
        (["goal1 s1 wasp"], [LAGGY, NOISY]),
        (["wasp/no-case2"], [ABLATION]),
        (["goal1 laggy"], [LAGGY, ABLATION]),
        (["dataset"], [D1, D2]),
        (["race1 dataset", PERSON], [D2, PERSON]),
        (["person"], [PERSON]),
        (["s0"], [PERSON]),
        (["e001"], [NOISY]),
        ([], [PERSON, LAGGY, NOISY, ABLATION]),
    ],
    ids=str,
)
def test_words_of_a_label_mean_all_that_have_them(
    stored: Layout, texts: list[str], expected: list[str]
) -> None:
    assert [node.label for node in selected(stored, texts)] == expected


def test_what_means_nothing_is_refused_with_what_there_is(stored: Layout, tmp_path: Path) -> None:
    with pytest.raises(UnknownName, match="'waps' is no task"):
        selected(stored, ["goal1 s1 waps"])
    with pytest.raises(UsageError, match="it has:\n  goal1 s1 dataset"):
        selected(stored, ["goal1 s7"])
    with pytest.raises(UsageError, match="no severity"):
        selected(stored, ["laggy=high"])
    with pytest.raises(UnknownName, match="unknown spec"):
        selected(stored, [], "table9")
    with pytest.raises(StoreError, match="neither a cell nor a dataset"):
        selected(Layout(tmp_path), ["goal1"])


def test_two_results_of_one_label_are_told_apart_by_their_keys(tmp_path: Path) -> None:
    layout = store_of(tmp_path)
    for number in (0, 1):
        store_cell(layout, [corrected(2)], cell(), number)
    with pytest.raises(UsageError, match=r"2 results are called 'goal1 s1 wasp laggy=0\.7'"):
        selected(layout, ["goal1 wasp"])
    assert [node.key[:4] for node in selected(layout, ["e001"])] == ["e001"]


def test_a_dataset_is_of_one_task_and_one_duration_of_decisions(
    stored: Layout, tmp_path: Path
) -> None:
    with pytest.raises(UsageError, match="of one task, and these are of 2"):
        source_of(stored, selected(stored, ["dataset"]))
    layout = store_of(tmp_path)
    store_cell(layout, [corrected(2)], cell())
    store_cell(layout, [corrected(2)], cell("noisy", 0.4), 1, settings={"action_repeat": 2})
    with pytest.raises(UsageError, match="2 and 4 env steps"):
        source_of(layout, selected(layout, ["wasp"]))
