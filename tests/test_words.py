"""The words of a label, as people write them."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from wasp_cli.cells.words import WHOLE, KnownWords, Words, read_words
from wasp_cli.errors import UsageError
from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import OPERATORS, UNIMPAIRED
from wasp_cli.plan.node import cell_label
from wasp_cli.store.tables import CellIdentity
from wasp_cli.tasks.registry import TASKS

HERE = Path("results")
KNOWN = KnownWords(tasks=["mine/Lake-v0"], methods=["theirs"], settings=["tau_c"])
TASK_NAMES = [*TASKS.own, *KNOWN.tasks]
METHOD_NAMES = [*METHODS.own, *KNOWN.methods]


def spellings(word: str) -> st.SearchStrategy[str]:
    return st.sampled_from([word, word.upper(), word.title()])


@st.composite
def cells(draw: st.DrawFn) -> CellIdentity:
    operator = draw(st.sampled_from([*OPERATORS.own, UNIMPAIRED]))
    value = None
    if operator != UNIMPAIRED:
        value = draw(st.floats(-1e6, 1e6))
    return CellIdentity(
        draw(st.sampled_from(TASK_NAMES)),
        draw(st.sampled_from(METHOD_NAMES)),
        draw(st.sampled_from([WHOLE, "no-case2"])),
        operator,
        value,
        draw(st.integers(0, 10**6)),
    )


def matches(words: Words, cell: CellIdentity) -> bool:
    return (
        (not words.seeds or cell.seed in words.seeds)
        and words.fit_assistant(cell.task, cell.method, cell.variant)
        and words.fit_operator(cell.operator, cell.value)
    )


def words_of(cell: CellIdentity) -> list[str]:
    """The words of the label that a run prints."""
    who = cell_label(cell.method, cell.variant, cell.operator, cell.value)
    return [cell.task, f"s{cell.seed}", *who.split()]


@given(cells(), st.data())
def test_a_label_in_any_order_means_its_cell(cell: CellIdentity, data: st.DataObject) -> None:
    words = data.draw(st.permutations(words_of(cell)))
    read = read_words(" ".join(words), KNOWN, HERE)
    assert matches(read, cell)
    assert read.tasks == {cell.task}
    assert read.methods == {cell.method}
    assert read.seeds == {cell.seed}
    assert len(read.operators) == 1
    assert read.variants == ({cell.variant} - {WHOLE})


@given(cells(), st.data())
def test_commas_and_capitals_change_nothing(cell: CellIdentity, data: st.DataObject) -> None:
    method, slash, variant = words_of(cell)[2].partition("/")
    words = [data.draw(spellings(word)) for word in (words_of(cell)[0], method)]
    words[1] += slash + variant  # an ablation is written as it is called
    text = ", ".join([*words, f"Seed {cell.seed}"])
    plain = " ".join([*words_of(cell)[:1], words_of(cell)[2], f"s{cell.seed}"])
    assert read_words(text, KNOWN, HERE) == read_words(plain, KNOWN, HERE)


@given(cells(), cells(), st.data())
def test_less_words_mean_more_cells(
    cell: CellIdentity, other: CellIdentity, data: st.DataObject
) -> None:
    every = words_of(cell)
    some = data.draw(st.lists(st.sampled_from(every), unique=True))
    if matches(read_words(" ".join(every), KNOWN, HERE), other):
        assert matches(read_words(" ".join(some), KNOWN, HERE), other)
    assert matches(read_words(" ".join(some), KNOWN, HERE), cell)


def read_or_refused(text: str) -> Words | None:
    """The words of a text; None where it is refused with a reason."""
    try:
        return read_words(text, KNOWN, HERE)
    except UsageError:
        return None


@given(st.text(max_size=60))
def test_any_text_is_read_or_refused_with_commas_as_without(text: str) -> None:
    assert read_or_refused(text) == read_or_refused(text.replace(" ", ", "))


@given(st.text("01289s=", max_size=30), st.integers(0, 10**40))
def test_numbers_of_any_length_are_read_or_refused(text: str, number: int) -> None:
    for word in (f"s{text}", f"seed {number}", f"laggy={text}", f"tau_c={number}"):
        words = read_or_refused(word)
        if words is not None:
            assert words.fit_settings({"tau_c": 10**400}) is not word.startswith("tau_c")


def test_an_operator_has_its_own_severity() -> None:
    words = read_words("laggy=0.7 noisy", KNOWN, HERE)
    assert words.fit_operator("laggy", 0.7)
    assert not words.fit_operator("laggy", 0.5)
    assert words.fit_operator("noisy", 0.2)
    assert not words.fit_operator(None, None)


def test_a_method_alone_is_the_whole_method_where_it_is_there() -> None:
    words = read_words("wasp", KNOWN, HERE)
    assert words.whole_first(["whole", "ablation"], [WHOLE, "no-case2"]) == ["whole"]
    assert words.whole_first(["ablation"], ["no-case2"]) == ["ablation"]
    every = read_words("goal1", KNOWN, HERE)
    assert every.whole_first(["whole", "ablation"], [WHOLE, "no-case2"]) == ["whole", "ablation"]


@pytest.mark.parametrize("severity", ["nan", "inf", "high", ""])
def test_what_is_no_number_is_no_severity(severity: str) -> None:
    with pytest.raises(UsageError, match="no severity"):
        read_words(f"laggy={severity}", KNOWN, HERE)


def test_settings_are_compared_as_numbers_where_they_are_some() -> None:
    assert read_words("tau_c=1", KNOWN, HERE).fit_settings({"tau_c": 1.0})
    assert not read_words("tau_c=1", KNOWN, HERE).fit_settings({"tau_c": 0.5})
    assert read_words("tau_c=Auto", KNOWN, HERE).fit_settings({"tau_c": "auto"})
