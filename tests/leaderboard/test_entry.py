"""What of a spec is submitted: the assistant and its settings; all else is the board's."""

import shutil
from pathlib import Path

import pytest

from tests.commands import run_here
from tests.leaderboard.submissions import EXAMPLES, HALFWAY
from wasp_cli.errors import UnknownName
from wasp_cli.leaderboard.board import Board, board_of
from wasp_cli.leaderboard.entry import entry_from, entry_of
from wasp_cli.spec.load import load
from wasp_cli.spec.read import InvalidSpec

NAME = "halfway:Halfway"


@pytest.fixture(scope="module")
def board() -> Board:
    return board_of()


def test_a_spec_that_names_a_part_of_the_board_is_evaluated_in_all_of_it(board):
    entry = entry_of(load(HALFWAY), board)
    spec = entry.loaded.spec
    assert (spec.methods, spec.stages, spec.variants) == ((NAME,), (), ("full",))
    for name in ("tasks", "operators", "seeds", "episodes", "training_seed"):
        assert getattr(spec, name) == getattr(board.spec, name)


def test_the_text_of_an_entry_gives_the_same_entry(board):
    entry = entry_of(load(HALFWAY), board)
    assert entry_from(entry.text, "again", board).loaded.spec == entry.loaded.spec


def test_settings_of_other_assistants_do_not_matter(board):
    entry = entry_of(load(HALFWAY, ["wasp.tau_c=0.5", "counterfactual.most=40"]), board)
    assert "wasp" not in entry.text


WRONG = {
    "tasks: [goal1, goal2]": (4, 16, "goal2"),
    "seeds: [313, 2]": (4, 14, "trained"),
    "seeds: [500]": (4, 9, "development"),
    "seeds: [400]": (4, 9, "400"),
    "operators: {laggy: {severe: 0.85}}": (4, 29, "0.7"),
    "operators: {reactive: {moderate: 0.88}}": (4, 13, "reactive"),
    "episodes: 20": (4, 11, "episodes"),
    "training_seed: 2": (4, 16, "training_seed"),
    "preset: quick": (4, 9, "preset"),
    "world_model: {updates: 7}": (4, 24, "world_model.updates"),
    "by_task: {formula1: {policies: {hidden: [32, 32]}}}": (4, 41, "policies.hidden"),
}


@pytest.mark.parametrize("line", WRONG)
def test_what_is_changed_of_the_board_is_refused_where_the_spec_says_it(line, tmp_path, board):
    path = tmp_path / "mine.yaml"
    path.write_text(f'extends: field\nname: mine\nmethods: ["{NAME}"]\n{line}\n', encoding="utf-8")
    with pytest.raises(InvalidSpec) as refused:
        entry_of(load(path), board)
    row, column, word = WRONG[line]
    found = [
        problem
        for problem in refused.value.problems
        if problem.position is not None and problem.position.line == row
    ]
    assert any(
        problem.position.column == column and word in problem.message and str(path) in str(problem)
        for problem in found
    ), str(refused.value)
    assert refused.value.exit_code == 3


def test_a_spec_without_an_own_assistant_is_refused_at_its_methods(tmp_path, board):
    path = tmp_path / "mine.yaml"
    path.write_text("extends: field\nname: mine\nmethods: [human, wasp]\n", encoding="utf-8")
    with pytest.raises(InvalidSpec) as refused:
        entry_of(load(path), board)
    assert refused.value.problems[0].place == f"{path}:3:10"


def test_of_several_own_assistants_one_is_named(tmp_path, board, monkeypatch):
    text = (EXAMPLES / "halfway.py").read_text(encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "quarterway.py").write_text(text.replace("Halfway", "Quarter"), encoding="utf-8")
    path = tmp_path / "mine.yaml"
    other = "quarterway:Quarter"
    path.write_text(f'extends: field\nname: mine\nmethods: ["{NAME}", "{other}"]\n')
    with pytest.raises(InvalidSpec, match=r"mine\.yaml:3:30"):
        entry_of(load(path), board)
    assert entry_of(load(path), board, other).method == other
    with pytest.raises(UnknownName):
        entry_of(load(path), board, "wasp")


def test_the_spec_of_a_submission_has_nothing_of_the_boards(board):
    text = f'extends: field\nname: mine\nmethods: ["{NAME}"]\nevaluate: {{safe_cost: 100}}\n'
    with pytest.raises(InvalidSpec, match=r"spec\.yaml:4:1"):
        entry_from(text, "spec.yaml", board)


def test_who_submits_is_asked_before_anything_is_computed(tmp_path, monkeypatch):
    for name in ("halfway.py", "halfway.yaml"):
        shutil.copy(EXAMPLES / name, tmp_path)
    monkeypatch.chdir(tmp_path)
    done = run_here("submit", "halfway.yaml", columns=200, code=2)
    assert "--by" in done.stderr
    assert not Path("results").exists()


def test_a_folder_that_is_there_is_not_replaced(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("mine").mkdir()
    for options in ([], ["--force"]):  # which replaces submissions, and nothing else
        done = run_here("submit", HALFWAY, "--by", "me", "--out", "mine", *options, columns=200)
        assert done.exit_code == 2
        assert "'mine'" in done.stderr
