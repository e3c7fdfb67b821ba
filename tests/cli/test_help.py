"""What `--help` shows, and that its examples can be typed after the quickstart."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from typer.main import get_command

from tests.commands import run_here
from wasp_cli.cli.app import app
from wasp_cli.plan.grid import lay_out
from wasp_cli.spec.load import load

ROOT = Path(__file__).parents[2]
COMMANDS = [[], *([name] for name in sorted(get_command(app).commands)), ["tasks", "show"]]  # type: ignore[attr-defined]


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_help_has_no_type_behind_a_switch_and_labels_that_the_quickstart_has(command: list[str], labels: set[str]) -> None:
    shown = run_here(*command, "--help", columns=200).stdout
    assert "--help" in shown
    assert "<bool>" not in shown
    require_labels(shown, labels)


@pytest.mark.parametrize("page", ["README.md", "docs/running.md", "docs/commands.md", "docs/guide.md"])
def test_commands_of_the_pages_name_what_the_quickstart_has(page: str, labels: set[str]) -> None:
    lines = (ROOT / page).read_text(encoding="utf-8").splitlines()
    require_labels("\n".join(line for line in lines if line.startswith("$ wasp")), labels)


@pytest.fixture(scope="module")
def labels() -> set[str]:
    return {node.label for node in lay_out(load(ROOT / "specs/quickstart.yaml").spec).nodes}


def require_labels(text: str, labels: set[str]) -> None:
    """Fail where an example names what is not there after the quickstart: another label, or a key, which differs on every machine."""
    assert {*re.findall(r"['\"]([a-z]+\d s\d [^'\"]+)['\"]", text)} <= labels
    assert not re.findall(r"\b(?=[a-f]*\d)(?=\d*[a-f])[0-9a-f]{8}\b", text)
