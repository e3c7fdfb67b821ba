"""`wasp export` of episodes: what is written, what is refused, and that nothing is lost."""

import builtins
from pathlib import Path

import pytest

from tests.commands import run_here
from tests.export.reading import read_lerobot
from tests.export.stored import cell, corrected, recording, store_cell, store_dataset, store_of


def export(results: Path, *arguments: str | Path, code: int = 0) -> str:
    output = run_here("export", *arguments, "--results", results, columns=200, code=code).output
    return " ".join(output.split())


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    layout = store_of(tmp_path)
    store_dataset(layout, [recording([3, 3], 2, 4)])
    store_cell(layout, [corrected(2), corrected(3)], cell())
    return layout.root


def test_a_dataset_and_a_cell_are_exported_by_their_labels(stored: Path, tmp_path: Path) -> None:
    told = export(stored, "goal1 s1 dataset", "--lerobot", tmp_path / "a", "--limit", "1")
    assert "1 episodes, 3 decisions" in told
    assert "LeRobotDataset('wasp/a'" in told
    assert len(read_lerobot(tmp_path / "a").episodes) == 1
    told = export(stored, "e000", "--lerobot", tmp_path / "b", "--no-observations")
    assert "2 episodes, 5 decisions" in told


def test_a_folder_that_is_there_is_replaced_with_force_alone(stored: Path, tmp_path: Path) -> None:
    target = tmp_path / "mine"
    export(stored, "dataset", "--lerobot", target)
    before = (target / "meta/info.json").read_bytes()
    cells = ("wasp", "--no-observations", "--lerobot", target)
    assert "--force replaces it" in export(stored, *cells, code=2)
    assert (target / "meta/info.json").read_bytes() == before
    export(stored, *cells, "--force")
    assert (target / "meta/info.json").read_bytes() != before
    assert {path.name for path in tmp_path.iterdir()} == {"results", "mine"}


def test_no_other_folder_is_ever_replaced(stored: Path, tmp_path: Path) -> None:
    target = tmp_path / "home"
    target.mkdir()
    (target / "thesis.tex").write_text("all of it")
    told = export(stored, "dataset", "--lerobot", target, "--force", code=2)
    assert "holds other files than a dataset" in told
    assert (target / "thesis.tex").read_text() == "all of it"
    (tmp_path / "file").write_text("a file")
    assert "not a folder" in export(stored, "dataset", "--lerobot", tmp_path / "file", code=2)


def test_a_dataset_that_fails_leaves_the_one_before(stored: Path, tmp_path: Path) -> None:
    target = tmp_path / "mine"
    export(stored, "dataset", "--lerobot", target)
    before = (target / "meta/info.json").read_bytes()
    (shard,) = stored.glob("store/dataset/*/shard-0000.parquet")
    shard.write_bytes(b"PAR1" + shard.read_bytes()[4:-9] + b"\0" * 9)
    export(stored, "dataset", "--lerobot", target, "--force", code=1)
    assert (target / "meta/info.json").read_bytes() == before
    assert {path.name for path in tmp_path.iterdir()} == {"results", "mine"}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "nothing to write"),
        (("wasp",), "nothing to write"),
        (("--lerobot", "x"), "which episodes?"),
        (("wasp", "--lerobot", "x", "--tensorboard", "y"), "one after the other"),
        (("wasp", "--tensorboard", "y"), "curves are of whole specs"),
        (("goal1", "--lerobot", "x", "--spec", "none"), "unknown spec"),
    ],
    ids=str,
)
def test_what_cannot_be_meant_is_refused(
    stored: Path, arguments: tuple[str, ...], words: str
) -> None:
    assert words in export(stored, *arguments, code=2)


def test_a_missing_extra_and_a_name_that_minari_cannot_find_say_what_to_do(
    stored: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = builtins.__import__

    def without(name: str, *rest: object, **more: object) -> object:
        if name.partition(".")[0] in ("minari", "h5py"):
            raise ImportError(f"No module named '{name}'")
        return real(name, *rest, **more)

    with monkeypatch.context() as patch:
        patch.setattr("importlib.import_module", without)
        told = export(stored, "dataset", "--minari", tmp_path / "mine-v0", code=2)
        assert "pip install 'wasp-cli[minari]'" in told
    pytest.importorskip("minari")
    told = export(stored, "dataset", "--minari", tmp_path / "mine", code=2)
    assert f"{tmp_path / 'mine-v0'}" in told
