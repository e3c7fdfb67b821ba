"""What the package says of itself: metadata, supported versions of Python, published data."""

import re
import shutil
import tomllib
from email import message_from_string
from email.message import Message
from pathlib import Path

import published
import pytest

from wasp_cli.errors import WaspError
from wasp_cli.spec.shipped import Contents, published_contents

ROOT = Path(__file__).parents[1]
ADDRESS = "https://example.org/someone/wasp"


def metadata_with(repository: str, place: Path, monkeypatch: pytest.MonkeyPatch) -> Message:
    """What an index would read of a wheel that is built with this address."""
    builder = pytest.importorskip("hatchling.build")
    for name in ("README.md", "LICENSE", "hatch_build.py", "wasp_cli/__init__.py"):
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, place / name)
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    text = re.sub(r'(?m)^repository = ".*"$', f'repository = "{repository}"', text)
    (place / "pyproject.toml").write_text(text, encoding="utf-8")
    monkeypatch.chdir(place)
    folder = place / builder.prepare_metadata_for_build_wheel(str(place))
    return message_from_string((folder / "METADATA").read_text(encoding="utf-8"))


def test_every_link_of_the_package_leads_into_the_repository_that_is_configured(
    tmp_path, monkeypatch
):
    metadata = metadata_with(ADDRESS, tmp_path, monkeypatch)
    urls = dict(line.split(", ", 1) for line in metadata.get_all("Project-URL"))
    assert set(urls) == {"Repository", "Documentation", "Changelog", "Issues"}
    assert all(url.startswith(ADDRESS) for url in urls.values())
    links = re.findall(r"\]\(([^)]+)\)", metadata.get_payload())
    assert links
    assert all(link.startswith(("https://", "#")) for link in links)
    pictures = re.findall(r"!\[[^]]*\]\(([^)]+)\)", metadata.get_payload())
    assert pictures
    assert all(f"{ADDRESS}/raw/" in picture for picture in pictures)


def test_without_a_repository_no_link_is_invented(tmp_path, monkeypatch):
    metadata = metadata_with("", tmp_path, monkeypatch)
    assert metadata.get_all("Project-URL") is None
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert metadata.get_payload().strip() == readme.strip()
    assert metadata["License-Expression"] == "Apache-2.0"


def test_the_versions_of_python_that_are_named_are_those_that_are_tested():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    named = [line.rpartition(" ")[2] for line in project["classifiers"] if ":: 3." in line]
    sessions = (ROOT / "noxfile.py").read_text(encoding="utf-8")
    (tested,) = re.findall(r"^PYTHONS = \((.+)\)$", sessions, re.MULTILINE)
    assert re.findall(r'"([\d.]+)"', tested) == named
    checks = (ROOT / ".github/workflows/checks.yml").read_text(encoding="utf-8")
    for matrix in re.findall(r"python: \[(.+)\]", checks):
        assert re.findall(r'"([\d.]+)"', matrix) == named
    assert project["requires-python"] == f">={named[0]}"


def test_every_session_runs_for_each_change_or_every_night():
    sessions = (ROOT / "noxfile.py").read_text(encoding="utf-8")
    found = re.findall(r"^@nox\.session(.*)\ndef (\w+)", sessions, re.MULTILINE)
    named = set()
    for workflow in ("checks.yml", "nightly.yml"):
        text = (ROOT / ".github/workflows" / workflow).read_text(encoding="utf-8")
        named |= set(re.findall(r"(?:session: |nox -s )(\w+)", text))
    on_request = {name for options, name in found if "default=False" in options}
    assert on_request - named == {"gpu", "package"}, "no GPU there; every wheel needs its package"
    assert named <= on_request


@pytest.mark.parametrize("spec", ["table2", "unseen"])
def test_what_is_said_to_be_published_of_a_spec_is_what_a_run_takes(spec):
    counted = published_contents().specs
    assert counted[spec] == published.published_cells(published.spec_files()[spec])


@pytest.mark.slow  # every spec is planned
@pytest.mark.parametrize("spec", published.spec_files())
def test_what_is_said_to_be_published_is_what_runs_take(spec):
    try:
        cells = published.published_cells(published.spec_files()[spec])
    except WaspError as error:
        pytest.skip(f"its environment is not installed: {error.message}")
    assert published_contents().specs.get(spec, 0) == cells


def test_all_published_cells_are_counted():
    assert published_contents().cells == published.all_published_cells()


def test_a_package_without_published_parts_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr("wasp_cli.spec.shipped._PACKAGE", tmp_path / "wasp_cli")
    assert published_contents() == Contents()
