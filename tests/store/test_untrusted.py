"""An untrusted results folder: it executes nothing, and makes wasp neither read nor write
outside of it.
"""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from tests.commands import run_here
from tests.store.attacks import ATTACKS, SCRIPT
from tests.store.untrusted import LABEL, UntrustedStore
from wasp_cli.store.tables import EPISODES_FILE, STEPS_FILE

SECRET = "the-secret-of-the-reader"
ONCE: tuple[tuple[str, ...], ...] = (
    ("report", "{results}"),
    ("status", "{results}"),
    ("status", "{results}", "--run", "0000"),
    ("logs", "{label}", "--results", "{results}"),
    ("show", "{label}", "--results", "{results}"),
    ("explain", "{label}", "-e", "0", "-s", "0", "--results", "{results}"),
    ("compare", "{results}", "{results}"),
    ("replay", "{label}", "-e", "0", "--results", "{results}", "--out", "{results}/made.gif"),
    ("gc", "{results}", "--runs", "--yes"),
)
"""Every command in the form that reads and shows the most."""
COMMANDS: tuple[tuple[str, ...], ...] = (
    ("status", "{results}", "--json"),
    ("logs", "{key}", "--path", "--results", "{results}"),
    ("show", "{key}", "--json", "--results", "{results}"),
    ("explain", "{key}", "-e", "0", "--results", "{results}"),
    ("compare", "{results}", "{results}", "--json"),
    ("gc", "{results}", "--dry-run"),
    (
        "replay",
        "{key}",
        "-e",
        "0",
        "-s",
        "0",
        "--json",
        "--results",
        "{results}",
        "--out",
        "{results}/made.png",
    ),
    *ONCE,
)
ON_EVERY_FORM = ("nothing_at_all", "labels_that_command_the_terminal")
"""Attacks on what is printed: every form prints in its own way."""


@pytest.fixture
def outside(tmp_path, monkeypatch) -> Iterator[Path]:
    """What belongs to the reader, and a module that tells when it is imported."""
    folder = tmp_path / "outside"
    (folder / "inner").mkdir(parents=True)
    for name in (
        "secret.json",
        "inner/secret.json",
        "_manifest.json",
        "report.md",
        EPISODES_FILE,
        STEPS_FILE,
    ):
        (folder / name).write_text(json.dumps({"label": SECRET, "message": SECRET, "spec": SECRET}))
    (folder / "evil_module.py").write_text(f"open({str(folder / 'imported')!r}, 'w').close()\n")
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.chdir(tmp_path)
    before = snapshot(folder)
    yield folder
    assert snapshot(folder) == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["outside", "results"]


def snapshot(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


ONCE_EACH = [pytest.param(name, ONCE, id=name) for name in ATTACKS if name not in ON_EVERY_FORM]
ALL_FORMS = [
    pytest.param(
        name,
        COMMANDS,
        id=f"{name}, every form",
        marks=() if name in ON_EVERY_FORM else pytest.mark.slow,
    )
    for name in ATTACKS
]


@pytest.mark.parametrize(("name", "commands"), ONCE_EACH + ALL_FORMS)
def test_nothing_is_obeyed(name, commands, outside, tmp_path, monkeypatch):
    if commands is ONCE:  # the pictures of a report are made and written, but not painted
        monkeypatch.setattr(Figure, "savefig", lambda self, file, **_: file.write(b"a picture"))
    it = UntrustedStore(tmp_path)
    ATTACKS[name](it, outside)
    codes = {}
    for command in commands:
        arguments = [
            part.format(results=it.layout.root, label=LABEL, key=it.key[:8]) for part in command
        ]
        done = run_here(*arguments, columns=100)
        assert done.exception is None or isinstance(done.exception, SystemExit), (
            arguments,
            done.exc_info,
        )
        assert done.exit_code in (0, 1, 2), (arguments, done.output)
        assert "Traceback" not in done.output
        assert "\x1b" not in done.output, arguments
        assert SECRET not in done.output, arguments
        codes[command[:2]] = done.exit_code
    assert not (outside / "imported").exists()
    for page in it.layout.root.glob("reports/*/report.html"):
        assert SCRIPT not in page.read_text(encoding="utf-8")
    if name == "nothing_at_all":
        # There are rows, and in the folders of the models there are none to play them again with.
        assert codes == {command[:2]: 1 if command[0] == "replay" else 0 for command in COMMANDS}
