"""What `--help` shows: all commands on one screen, and examples that can be typed after the
quickstart.
"""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest
from typer.main import get_command
from typer.testing import CliRunner

from tests.commands import ROOT, run_here
from tests.compare.two_runs import episodes, write_results
from tests.report.conftest import without_figures
from wasp_cli.cli import app
from wasp_cli.cli.command import GROUPS
from wasp_cli.cli.completion import method_names, setting_names, task_names, variant_names
from wasp_cli.cli.options import Work
from wasp_cli.errors import UnknownName, WaspError
from wasp_cli.methods.registry import METHODS
from wasp_cli.plan.grid import lay_out
from wasp_cli.spec.hints import settings
from wasp_cli.spec.load import load, restricted, sized
from wasp_cli.spec.shipped import shipped_names
from wasp_cli.tasks.registry import TASKS

__all__ = ["without_figures"]

COMMANDS = [[], *([name] for name in sorted(get_command(app).commands))]  # type: ignore[attr-defined]


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_help_has_no_type_behind_a_switch_and_labels_that_the_quickstart_has(
    command: list[str], labels: set[str]
) -> None:
    shown = run_here(*command, "--help", columns=200).stdout
    assert "--help" in shown
    assert "<bool>" not in shown
    assert not strangers(shown, labels)


@pytest.mark.parametrize("arguments", [["--help"], []], ids=["asked", "alone"])
def test_all_commands_fit_on_a_screen_each_on_a_line(arguments: list[str]) -> None:
    done = run_here(*arguments, columns=80)
    assert done.exit_code == (0 if arguments else 2)
    lines = done.stdout.splitlines()
    assert len(lines) <= 40
    assert max(map(len, lines)) <= 80
    for name, line in listed(lines).items():
        assert re.search(rf" {name} +[A-Z].*[.]$", line), line
    options = next(line for line in lines if line.startswith("Options: "))
    assert {"--debug", "--version", "--install-completion", "--help"} <= set(
        options.removeprefix("Options: ").split(", ")
    )


def test_the_list_has_every_command_once_and_begins_with_the_readme() -> None:
    names = [name for group in GROUPS.values() for name in group]
    assert sorted(names) == sorted(get_command(app).commands)  # type: ignore[attr-defined]
    assert len(set(names)) == len(names)
    start = re.findall(
        r"^\$ (?:.* && )?wasp (\w+)", (ROOT / "README.md").read_text(encoding="utf-8"), re.MULTILINE
    )
    assert start
    assert names[: len(start)] == start


def listed(lines: list[str]) -> dict[str, str]:
    """The line of each command."""
    names = [name for group in GROUPS.values() for name in group]
    return {
        name: next(line.rstrip() for line in lines if re.search(rf"(^| ) *{name} {{2,}}", line))
        for name in names
    }


@pytest.mark.parametrize(
    "page", ["README.md", "docs/running.md", "docs/commands.md", "docs/guide.md"]
)
def test_commands_of_the_pages_name_what_the_quickstart_has(page: str, labels: set[str]) -> None:
    lines = (ROOT / page).read_text(encoding="utf-8").splitlines()
    assert not strangers("\n".join(line for line in lines if line.startswith("$ ")), labels)


@pytest.fixture(scope="module")
def labels() -> set[str]:
    return {node.label for node in lay_out(load(ROOT / "specs/quickstart.yaml").spec).nodes}


def strangers(text: str, labels: set[str]) -> set[str]:
    """What an example names that is not there after the quickstart: another label, or a key,
    which differs on every machine.
    """
    named = {*re.findall(r"['\"]([a-z]+\d s\d [^'\"]+)['\"]", text)}
    return (named - labels) | {*re.findall(r"\b(?=[a-f]*\d)(?=\d*[a-f])[0-9a-f]{8}\b", text)}


# Options that commands share, and what a terminal, a pipe and a folder without permission get.


SHARED = [
    (
        ["run", "ablate", "sweep"],
        {"--dry-run", "--jobs", "--timeout", "--retries", "--backend", "--scheduler", "--reuse"},
    ),
    (
        ["run", "plan", "ablate", "sweep", "publish", "clone"],
        {"--task", "--preset", "--set", "--results"},
    ),
    (["logs", "show", "explain", "replay", "note", "status"], {"--run", "--results"}),
    (["view", "drive"], {"--browser", "--port"}),
]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("written") / "results"
    write_results(path, lambda identity: episodes(identity, count=3))
    return path


@pytest.fixture
def results(written: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(written, tmp_path / "results"))


@pytest.mark.usefixtures("without_figures")
def test_a_pipe_gets_every_column(results: Path) -> None:
    done = run_here("report", results, "--no-trained", columns=None, code=0)
    heading = next(
        line for line in done.stdout.partition("Main results")[2].splitlines() if "Method" in line
    )
    assert heading.split()[-1] == "ms"
    assert "hidden" not in done.stdout


@pytest.mark.usefixtures("without_figures")
def test_where_the_files_cannot_be_written_the_tables_are_printed(results: Path) -> None:
    (results / "reports").write_text("in the way")
    done = run_here("report", results, "--no-trained", columns=120, code=1)
    assert "Main results" in done.stdout
    assert "--out" in done.stderr


@pytest.mark.parametrize(("commands", "options"), SHARED, ids=lambda part: " ".join(sorted(part)))
def test_commands_of_a_kind_have_the_same_options_with_the_same_words(
    commands: list[str], options: set[str]
) -> None:
    texts: list[dict[str, tuple[str, str]]] = []
    for command in commands:
        parameters = get_command(app).commands[command].params  # type: ignore[attr-defined]
        words = {
            parameter.opts[0]: (parameter.help, parameter.metavar)
            for parameter in parameters
            if parameter.opts[0] in options
        }
        assert words.keys() == options, command
        texts.append(words)
    assert all(words == texts[0] for words in texts)


def test_an_option_has_the_same_spellings_in_every_command() -> None:
    spellings: dict[str, set[tuple[str, ...]]] = {}
    for command in get_command(app).commands.values():  # type: ignore[attr-defined]
        for parameter in command.params:
            every = (*parameter.opts, *parameter.secondary_opts)
            spellings.setdefault(every[0], set()).add(every)
    assert {name: found for name, found in spellings.items() if len(found) > 1} == {}


@pytest.mark.parametrize("command", [["view"], ["drive", "goal1"]], ids=" ".join)
def test_a_browser_opens_unless_it_is_told_not_to(command: list[str]) -> None:
    def opens(*options: str) -> bool:
        name, *arguments = command
        made = get_command(app).commands[name]  # type: ignore[attr-defined]
        with made.make_context(name, [*arguments, *options]) as context:
            browser: bool = context.params["browser"]
            return browser

    assert opens()
    assert opens("--browser")
    assert not opens("--no-browser")


def test_a_word_that_an_option_had_before_is_in_no_help() -> None:
    shown = run_here("view", "--help", columns=200).stdout
    assert "--page" in shown
    assert "--open" not in shown


def test_a_scheduler_of_the_environment_is_not_for_this_machine(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("WASP_SCHEDULER", "tcp://somewhere:8786")
    asked = Work(backend="loky", scheduler="tcp://somewhere:8786").options()
    assert (asked.backend, asked.scheduler) == ("loky", None)
    assert Work(backend="loky", scheduler="tcp://typed:1").options().scheduler == "tcp://typed:1"
    assert Work(backend="dask", scheduler="tcp://typed:1").options().scheduler == "tcp://typed:1"


def test_two_results_folders_are_refused_and_one_may_be_said_twice(results: Path) -> None:
    assert run_here("status", results, "--results", "elsewhere", columns=120).exit_code == 2
    assert run_here("status", results, "--results", results, columns=120).exit_code == 0


def test_tasks_methods_and_preset_restrict_a_spec() -> None:
    loaded = load(Path("specs/field.yaml"), sized("smoke", ["episodes=3"]))
    assert (loaded.spec.preset, loaded.spec.episodes) == ("smoke", 3)
    some = restricted(loaded, ["race1", "goal1"], ["wasp", "human"]).spec
    assert (some.tasks, some.methods) == (("race1", "goal1"), ("human", "wasp"))
    assert restricted(loaded, None, None) is loaded
    with pytest.raises(UnknownName):
        restricted(loaded, None, ["nobody"])
    with pytest.raises(UnknownName):
        sized("enormous")


# What a shell offers behind TAB.


HEAVY = ["torch", "mujoco", "joblib", "stable_baselines3", "gymnasium", "pyarrow", "matplotlib"]
WASP = (
    "import atexit, sys\n"
    "sys.argv[0] = 'wasp'\n"
    f"atexit.register(lambda: print('HEAVY', [name for name in {HEAVY} if name in "
    "sys.modules], file=sys.stderr))\n"
    "from wasp_cli.cli import main\n"
    "main()\n"
)


def test_a_shell_asks_through_its_environment_and_nothing_heavy_is_imported() -> None:
    line = "wasp run specs/smoke.yaml --set wasp.ca"
    asked = {
        "_WASP_COMPLETE": "complete_bash",
        "COMP_WORDS": line,
        "COMP_CWORD": "4",
        "PYTHONPATH": str(ROOT),
    }
    command = [sys.executable, "-c", WASP]
    done = subprocess.run(
        command,
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
        env={**os.environ, **asked},
    )
    assert (done.returncode, done.stdout.split(), done.stderr) == (
        0,
        ["wasp.candidates="],
        "HEAVY []\n",
    )


def offered(line: str) -> list[str]:
    """What bash is offered for the last word of a line, which may be empty."""
    asked = {
        "_WASP_COMPLETE": "complete_bash",
        "COMP_WORDS": line,
        "COMP_CWORD": str(line.count(" ")),
    }
    return CliRunner().invoke(app, [], env=asked).stdout.split()


@pytest.mark.parametrize(
    ("line", "names"),
    [
        ("wasp run --task g", ["goal0", "goal1", "goal1-two", "goal2"]),
        ("wasp run specs/smoke.yaml -t ", list(TASKS)),
        ("wasp list ", ["methods", "operators", "tasks"]),
        ("wasp s", ["schema", "show", "status", "submit", "sweep"]),
        ("wasp sweep specs/smoke.yaml --method ", list(METHODS)),
        ("wasp ablate --variant no", ["no-case2", "no-rollout"]),
        ("wasp ablate --preset ", ["smoke", "quick", "cpu", "gpu", "paper"]),
        ("wasp sweep specs/smoke.yaml --vary diffusion.r", ["diffusion.ratio="]),
        ("wasp run specs/smoke.yaml --set ", [f"{name}=" for name in settings()]),
        ("wasp run nowhere/", []),
    ],
)
def test_what_is_offered(line: str, names: list[str]) -> None:
    assert sorted(offered(line)) == sorted(names)


def test_specs_are_offered_from_here_and_from_their_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("mine.yaml", "notes.txt", "specs/quick.yaml", "specs/deep/far.yaml"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert offered("wasp run ") == ["mine.yaml", "specs/quick.yaml", *shipped_names()]
    assert offered("wasp check mine.yaml s") == [
        "specs/quick.yaml",
        *(name for name in shipped_names() if name[0] == "s"),
    ]
    assert offered("wasp check specs/deep/") == ["specs/deep/far.yaml"]
    assert offered(f"wasp plan {tmp_path}/m") == [f"{tmp_path}/mine.yaml"]


def test_a_plugin_that_does_not_load_offers_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    broken = Mock(side_effect=WaspError("plugin 'x' does not load"))
    monkeypatch.setattr("wasp_cli.registry.Registry._entries", broken)
    monkeypatch.setattr("wasp_cli.spec.hints.settings", broken)
    assert task_names() == method_names() == variant_names() == setting_names() == []
