"""A better picture, column or help text re-runs nothing: the source of a room that moves no
number is in no key.
"""

import shutil
from collections.abc import Callable, Iterator, Mapping
from importlib.util import spec_from_file_location
from pathlib import Path

import pytest

from tests.plugins import forget
from wasp_cli.plan import source
from wasp_cli.plan.grid import lay_out
from wasp_cli.spec.load import load

ROOT = Path(__file__).parents[2]
SCIENCE = frozenset(
    {"learning", "methods", "metrics", "models", "operators", "stages", "store", "tasks"}
)
"""Rooms whose source may be in a key."""
SHARED = frozenset({"config", "registry", "seeds"})
"""Modules beside the rooms that science is built on."""
ROOMS = sorted(
    path.stem
    for path in (ROOT / "wasp_cli").iterdir()
    if (path.suffix == ".py" or (path / "__init__.py").is_file())
    and path.stem not in SCIENCE | SHARED | {"__init__"}
)
"""Every other one, whoever adds it."""


@pytest.fixture(scope="module")
def keys(tmp_path_factory) -> Iterator[Callable[[str], Mapping[str, str]]]:
    """Copies the package, changes every module of a room in the copy, and plans: the key of
    every node by its label.
    """
    spec = load(ROOT / "specs" / "smoke.yaml").spec

    def plan(*rooms: str) -> dict[str, str]:
        package = tmp_path_factory.mktemp("copy") / "wasp_cli"
        shutil.copytree(ROOT / "wasp_cli", package, ignore=shutil.ignore_patterns("__pycache__"))
        for room in rooms:
            files = (
                [package / f"{room}.py"]
                if (package / f"{room}.py").is_file()
                else [*(package / room).rglob("*.py")]
            )
            assert files
            for file in files:
                file.write_text(
                    f"{file.read_text(encoding='utf-8')}\nCOLOUR = '#0072B2'\n", encoding="utf-8"
                )
        found = spec_from_file_location(
            "wasp_cli", package / "__init__.py", submodule_search_locations=[str(package)]
        )
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(source, "find_spec", lambda name: found)
            forget()
            return {node.label: node.key for node in lay_out(spec).nodes}

    yield plan
    forget()


def test_rooms_that_move_no_number_are_in_no_key(keys):
    assert {"cli", "video", "compare", "report", "run", "plan", "spec", "console", "errors"} <= {
        *ROOMS
    }
    before = keys()
    if keys(*ROOMS) != before:
        pytest.fail(f"in a key: {', '.join(room for room in ROOMS if keys(room) != before)}")
