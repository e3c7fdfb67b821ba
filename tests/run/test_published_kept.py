"""What a plan keeps of published results moves no plan, and hides no damage."""

import os
from pathlib import Path

import pytest

from tests.run.layered import plan, published_manifest, rewrite, run
from wasp_cli.errors import ArtifactError
from wasp_cli.plan import index, offered
from wasp_cli.spec import kept
from wasp_cli.store import artifact
from wasp_cli.store.layout import Layout

CELL = "goal1 s0 human noisy=0.2"


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache folder of the test's own; a few manifests are enough to be kept, at once."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(index, "LEAST", 1)
    monkeypatch.setattr(index, "RACY", 0.0)
    return tmp_path / "cache" / "wasp" / "kept"


def another_process() -> None:
    """What this process has read of files, it has not read."""
    artifact._verified.clear()


def test_a_plan_is_the_same_with_and_without_what_was_kept(here, fakes, small_spec, cache):
    first = plan(small_spec, here).as_json()
    another_process()
    assert plan(small_spec, here).as_json() == first
    files = [path for path in cache.iterdir() if not path.name.startswith("sources")]
    assert {path.name.partition("-")[0] for path in files} == {"published", "digests"}
    for path in files:
        path.write_bytes(path.read_bytes()[:-10])
    another_process()
    assert plan(small_spec, here).as_json() == first


def test_a_changed_published_file_is_found_whatever_its_size_and_time(here, fakes, small_spec):
    plan(small_spec, here)
    data = published_manifest(here, CELL).with_name("data.bin")
    state = data.stat()
    data.write_bytes(bytes(reversed(data.read_bytes())))
    os.utime(data, ns=(state.st_atime_ns, state.st_mtime_ns))
    another_process()
    found = plan(small_spec, here)
    assert any("has other bytes than were stored" in note for note in found.grid.notes)


def test_a_manifest_that_lists_another_digest_is_compared_again(here, fakes, small_spec):
    plan(small_spec, here)
    rewrite(
        published_manifest(here, CELL),
        lambda manifest: manifest["files"]["data.bin"].update(sha256="0" * 64),
    )
    another_process()
    found = plan(small_spec, here)
    assert any("has other bytes than were stored" in note for note in found.grid.notes)


def test_bytes_that_a_disk_has_changed_are_found_when_they_are_copied_and_then_planned_for(
    here, fakes, small_spec
):
    plan(small_spec, here)
    data = published_manifest(here, CELL).with_name("data.bin")
    data.write_bytes(bytes(reversed(data.read_bytes())))
    # As if neither inode nor times had changed.
    source = Layout(here / "published")
    name, version = index.name_of(offered.DIGESTS, source), kept.code_version(artifact)
    known = kept.read_kept(name, version)
    known[str(data)][0] = artifact.stamp_of(str(data))
    kept.keep(name, version, known)
    another_process()
    with pytest.raises(ArtifactError, match="has other bytes than"):
        run(small_spec, here)
    another_process()
    assert run(small_spec, here).summary.done
