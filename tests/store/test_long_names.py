"""A name of any length is refused at once."""

from difflib import SequenceMatcher
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.commands import run_here
from tests.view.conftest import brought
from wasp_cli import errors
from wasp_cli.errors import LONGEST_NAME, WaspError
from wasp_cli.view.site import site_of

CELL = "goal1 s1 human noisy=0.45"


@pytest.fixture
def results(tmp_path: Path) -> Path:
    return brought(tmp_path / "results", CELL)


@pytest.mark.parametrize("command", [["explain"], ["note"], ["view"]], ids=lambda each: each[0])
def test_a_name_of_any_length_costs_nothing(
    command: list[str], results: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Comparing 60,000 characters with the names of a store took 17 s of CPU: they are compared
    with none.
    """
    name = "goal1 s1 human noisy " * 3000

    def compared(_: object, one: str, other: str) -> SequenceMatcher[str]:
        assert max(len(one), len(other)) <= LONGEST_NAME
        return SequenceMatcher(None, one, other)

    monkeypatch.setattr(errors, "difflib", SimpleNamespace(SequenceMatcher=compared))
    if command == ["view"]:
        with pytest.raises(WaspError, match="unknown cell") as caught:
            site_of(results).one(name)
        assert "this one has 62999" in str(caught.value.hint)
        return
    done = run_here(
        *command,
        name,
        *(["text"] if command == ["note"] else []),
        "--results",
        results,
        columns=100,
        code=2,
    )
    assert "did you mean" not in done.stderr
