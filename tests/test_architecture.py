"""The page and the picture for newcomers show the rooms as they are."""

import importlib.util
import re
import tomllib
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
ROOMS = {path.parent.name for path in (ROOT / "wasp_cli").glob("*/__init__.py")}


@pytest.fixture(scope="module")
def picture() -> ModuleType:
    spec = importlib.util.spec_from_file_location(
        "architecture", ROOT / "docs" / "pictures" / "architecture.py"
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_names_every_room_and_no_other():
    listed = re.findall(r"^\| `(\w+)` \|", PAGE, re.MULTILINE)
    assert sorted(listed) == sorted(ROOMS)


def test_modules_and_files_on_the_page_are_there():
    modules = re.findall(rf"`((?:{'|'.join(sorted(ROOMS))})(?:\.\w+)+)`", PAGE)
    assert len(modules) > 10
    for dotted in modules:
        *folders, last = dotted.split(".")
        folder = (ROOT / "wasp_cli").joinpath(*folders)
        # A module or a folder of them, or the last part names something within a module.
        module = folder / f"{last}.py"
        within = folder.with_suffix(".py")
        assert module.is_file() or within.is_file() or (folder / last).is_dir(), dotted
    for file in re.findall(r"`(tests/[\w/]+\.py)`", PAGE):
        assert (ROOT / file).is_file(), file
    for module in (ROOT / "wasp_cli").glob("[a-z]*.py"):  # those of no room
        assert f"`{module.stem}`" in PAGE, module.stem


def test_the_picture_has_the_layers_of_the_contract(picture):
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    (contract,) = (
        each for each in settings["tool"]["importlinter"]["contracts"] if each.get("exhaustive")
    )
    layers = [
        [name for name in layer.split(" | ") if name in ROOMS] for layer in contract["layers"]
    ]
    assert [[name for name, _ in layer] for layer in picture.LAYERS] == [
        layer for layer in layers if layer
    ]
    assert {where for where, _ in (*picture.SPEC_TO_TABLE, *picture.DECISION)} <= ROOMS


def test_the_picture_is_the_drawn_one(picture):
    assert (ROOT / "docs" / "pictures" / "architecture.svg").read_text(
        encoding="utf-8"
    ) == picture.draw()


def test_rooms_in_no_key_are_those_of_the_closures(picture):
    from wasp_cli.plan.source import ORCHESTRATION

    assert ROOMS - ORCHESTRATION == picture.KEYED
    stated = PAGE.partition("**Not in the key:**")[2].partition("\n\n")[0]
    named = {*re.findall(r"`(\w+)`", stated)}
    assert named == ORCHESTRATION - {"__main__"}
