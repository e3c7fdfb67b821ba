"""What `--help` shows: all commands on one screen, and examples that can be typed after the quickstart."""

import re
from pathlib import Path

import pytest
from typer.main import get_command

from tests.commands import run_here
from wasp_cli.cli.app import app
from wasp_cli.cli.command import GROUPS
from wasp_cli.plan.grid import lay_out
from wasp_cli.spec.load import load

ROOT = Path(__file__).parents[2]
COMMANDS = [[], *([name] for name in sorted(get_command(app).commands))]  # type: ignore[attr-defined]


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_help_has_no_type_behind_a_switch_and_labels_that_the_quickstart_has(command: list[str], labels: set[str]) -> None:
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
    assert {"--debug", "--version", "--install-completion", "--help"} <= set(options.removeprefix("Options: ").split(", "))


def test_the_list_has_every_command_once_and_begins_with_the_readme() -> None:
    names = [name for group in GROUPS.values() for name in group]
    assert sorted(names) == sorted(get_command(app).commands)  # type: ignore[attr-defined]
    assert len(set(names)) == len(names)
    start = re.findall(r"^\$ wasp (\w+)", (ROOT / "README.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert names[: len(start)] == start == ["run", "report"]


def listed(lines: list[str]) -> dict[str, str]:
    """The line of each command."""
    names = [name for group in GROUPS.values() for name in group]
    return {name: next(line.rstrip() for line in lines if re.search(rf"(^| ) *{name} {{2,}}", line)) for name in names}


@pytest.mark.parametrize("page", ["README.md", "docs/running.md", "docs/commands.md", "docs/guide.md"])
def test_commands_of_the_pages_name_what_the_quickstart_has(page: str, labels: set[str]) -> None:
    lines = (ROOT / page).read_text(encoding="utf-8").splitlines()
    assert not strangers("\n".join(line for line in lines if line.startswith("$ wasp")), labels)


@pytest.fixture(scope="module")
def labels() -> set[str]:
    return {node.label for node in lay_out(load(ROOT / "specs/quickstart.yaml").spec).nodes}


def strangers(text: str, labels: set[str]) -> set[str]:
    """What an example names that is not there after the quickstart: another label, or a key, which differs on every machine."""
    named = {*re.findall(r"['\"]([a-z]+\d s\d [^'\"]+)['\"]", text)}
    return (named - labels) | {*re.findall(r"\b(?=[a-f]*\d)(?=\d*[a-f])[0-9a-f]{8}\b", text)}
