"""Options that commands share, and what a terminal, a pipe and a folder without permission get."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from typer.main import get_command

from tests.commands import run_here
from tests.compare.two_runs import episodes, write_results
from wasp_cli.cli.app import app
from wasp_cli.errors import UnknownName
from wasp_cli.spec.derived import restricted, sized
from wasp_cli.spec.load import load

SHARED = [
    (["run", "ablate", "sweep"], {"--dry-run", "--jobs", "--timeout", "--retries", "--backend", "--scheduler", "--reuse"}),
    (["run", "plan", "ablate", "sweep", "publish", "clone"], {"--task", "--preset", "--set", "--results"}),
    (["logs", "show", "explain", "replay", "note", "status"], {"--run", "--results"}),
]
NO_PICTURES = ("--no-films", "--no-trained")


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("written") / "results"
    write_results(path, lambda identity: episodes(identity, count=3))
    return path


@pytest.fixture
def results(written: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(written, tmp_path / "results"))


def test_a_pipe_gets_every_column(results: Path) -> None:
    command = [sys.executable, "-m", "wasp_cli", "report", str(results), *NO_PICTURES]
    here = {name: value for name, value in os.environ.items() if name != "COLUMNS"}
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=True, env=here)
    heading = next(line for line in done.stdout.partition("Main results")[2].splitlines() if "Method" in line)
    assert heading.split()[-1] == "ms"
    assert "hidden" not in done.stdout


def test_where_the_files_cannot_be_written_the_tables_are_printed(results: Path) -> None:
    (results / "reports").write_text("in the way")
    done = run_here("report", results, *NO_PICTURES, columns=120)
    assert done.exit_code == 1
    assert "Main results" in done.stdout
    assert "--out" in done.stderr


@pytest.mark.parametrize(("commands", "options"), SHARED, ids=lambda part: " ".join(sorted(part)))
def test_commands_of_a_kind_have_the_same_options_with_the_same_words(commands: list[str], options: set[str]) -> None:
    texts: list[dict[str, tuple[str, str]]] = []
    for command in commands:
        parameters = get_command(app).commands[command].params  # type: ignore[attr-defined]
        words = {parameter.opts[0]: (parameter.help, parameter.metavar) for parameter in parameters if parameter.opts[0] in options}
        assert words.keys() == options, command
        texts.append(words)
    assert all(words == texts[0] for words in texts)


def test_two_results_folders_are_refused_and_one_may_be_said_twice(results: Path) -> None:
    assert run_here("status", results, "--results", "elsewhere", columns=120).exit_code == 2
    assert run_here("status", results, "--results", results, columns=120).exit_code == 0


def test_tasks_methods_and_preset_restrict_a_spec() -> None:
    loaded = load(Path("specs/assistants.yaml"), sized("smoke", ["episodes=3"]))
    assert (loaded.spec.preset, loaded.spec.episodes) == ("smoke", 3)
    some = restricted(loaded, ["race1", "goal1"], ["wasp", "human"]).spec
    assert (some.tasks, some.methods) == (("race1", "goal1"), ("human", "wasp"))
    assert restricted(loaded, None, None) is loaded
    with pytest.raises(UnknownName):
        restricted(loaded, None, ["nobody"])
    with pytest.raises(UnknownName):
        sized("enormous")


def test_an_unknown_backend_is_refused_before_anything_is_planned(tmp_path: Path) -> None:
    done = run_here("run", "specs/smoke.yaml", "--dry-run", "--backend", "cloud", "--results", tmp_path / "none", columns=120)
    assert (done.exit_code, "cloud" in done.stderr) == (2, True)
