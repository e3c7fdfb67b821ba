"""The commands of the storm: what each begins with, what must hold after every kill, and what
it leaves in the end.
"""

import json
import os
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import torch  # noqa: F401  (imported before the forks)

import wasp_cli.cli
import wasp_cli.cli.run
import wasp_cli.drive.command
import wasp_cli.report.summarize
import wasp_cli.run.publish
from tests.faults.test_random_kills import artifacts, payload, require_whole
from tests.run import fake_stages
from tests.run.harness import data_of, written
from wasp_cli.cells.runs import last_runs
from wasp_cli.store.artifact import file_digest
from wasp_cli.store.layout import SESSION_FILE, Layout
from wasp_cli.store.tables import EPISODES_FILE, read_episodes

PEOPLE = """\
extends: table1
name: people
tasks: [goal1]
methods: [human]
operators: {noisy: null, laggy: null, limited-skill: null, reaction-time: null, person: {p7: 7, p8: 8}}
seeds: [0]
training_seed: 1
episodes: 4
side_by_side: 1
stages: []
reuse: published
"""
EPISODES = 4
BEFORE = "before.json"
"""Digests of what must stay, beside the results."""


def wasp(*arguments: object) -> None:
    """Be `wasp ARGUMENTS`, to the end of this process."""
    sys.argv = ["wasp", *map(str, arguments)]
    wasp_cli.cli.main()


def drive(folder: Path, participant: int) -> None:
    wasp(
        "drive",
        folder / "people.yaml",
        "--participant",
        participant,
        "--simulate",
        "--speed",
        4,
        "--results",
        folder / "results",
    )


def prepare(base: Path) -> None:
    """Fill a results folder: a session of one person."""
    base.mkdir()
    (base / "people.yaml").write_text(PEOPLE)
    written(base / "small.yaml", "[0, 1]", "[0]")
    drive(base, 7)


def digests(results: Path) -> dict[str, str]:
    files = [path for path in results.glob("store/*/*/**/*") if path.is_file()]
    return {str(path.relative_to(results)): file_digest(path) for path in files}


@dataclass(frozen=True)
class Command:
    """A command that is killed. Each function is called in a process of its own, with the
    folder.
    """

    name: str
    weight: int
    start: Callable[[Path], None]
    # what the command has left with what it leaves undisturbed
    compare: Callable[[Path, Path], None]
    begin: Callable[[Path], None] = lambda folder: None
    check: Callable[[Path], None] = lambda folder: None  # after a kill, beside what holds for all

    def arrange(self, folder: Path) -> None:
        """Make what the command needs, and write down what must stay."""
        self.begin(folder)
        stay = {
            name: digest
            for name, digest in digests(folder / "results").items()
            if not name.split("/")[2].startswith(RUBBISH)
        }
        (folder / BEFORE).write_text(json.dumps(stay))

    def look(self, folder: Path) -> None:
        """See that nothing that was there is lost, and nothing half is seen."""
        results = folder / "results"
        now = digests(results)
        lost = {
            name
            for name, digest in json.loads((folder / BEFORE).read_text()).items()
            if now.get(name) != digest
        }
        assert not lost, f"lost or changed: {sorted(lost)}"
        require_whole(results)
        assert not last_runs(Layout(results)).damaged
        self.check(folder)


RUBBISH = "0ddba11"


# run: fake stages, real workers


def start_run(folder: Path) -> None:
    """`wasp run` over stages that compute nothing, and without a report."""
    fake_stages.install()
    os.environ[fake_stages.OPTIONS] = json.dumps({"log": str(folder / "log"), "seconds": 0.1})

    def no_report(*arguments: object, **options: object) -> object:
        return type("Shown", (), {"missing": ()})

    wasp_cli.cli.run.show_report = no_report
    wasp("run", folder / "small.yaml", "--results", folder / "results", "-j", 2)


def compare_run(folder: Path, calm: Path) -> None:
    found = data_of(folder / "results")
    assert found
    assert found == data_of(calm / "results")
    assert not list((folder / "results" / "tmp").glob("*"))


# report and publish: of the session


def compare_report(folder: Path, calm: Path) -> None:
    """The same files, none empty, and the same tables."""
    found, wanted = (
        {
            path.relative_to(each): path
            for path in each.glob("results/reports/**/*")
            if not path.name.startswith(".")
        }
        for each in (folder, calm)
    )
    assert found
    assert found.keys() == wanted.keys()
    for name in found:
        if found[name].is_file():
            assert found[name].stat().st_size, name
        if name.suffix in (".csv", ".tex"):
            assert found[name].read_bytes() == wanted[name].read_bytes(), name


def start_publish(folder: Path) -> None:
    wasp(
        "publish",
        folder / "people.yaml",
        "--results",
        folder / "results",
        "--to",
        folder / "published",
        "--reuse",
        "published",
        "--select",
        "stage=world_model|policies",
    )


def compare_publish(folder: Path, calm: Path) -> None:
    assert payload(folder / "published")
    assert payload(folder / "published") == payload(calm / "published")


# gc: beside what people did there is what nobody wants


def begin_gc(folder: Path) -> None:
    layout = Layout(folder / "results")
    (model,) = (layout.store / "world_model").iterdir()
    for number in range(12):
        shutil.copytree(model, model.with_name(f"{RUBBISH}{number:013x}"))
        (layout.work(f"{RUBBISH}{number:013x}")).mkdir(parents=True)
    session = layout.work("5e55101" + "0" * 13)
    session.mkdir()
    (session / SESSION_FILE).write_text('{"number": 9}')
    shutil.copy(next((layout.store / "evaluate").glob(f"*/{EPISODES_FILE}")), session)


def check_gc(folder: Path) -> None:
    (session,) = (folder / "results" / "work").glob("5e55101*")
    assert {path.name for path in session.iterdir()} == {SESSION_FILE, EPISODES_FILE}


def compare_gc(folder: Path, calm: Path) -> None:
    assert artifacts(folder / "results").keys() == artifacts(calm / "results").keys()
    assert not [name for name in artifacts(folder / "results") if name.startswith(RUBBISH)]
    assert not list((folder / "results" / "tmp").glob("*"))


# drive


def driven(folder: Path) -> pa.Table | None:
    """The finished episodes of the second person, wherever they are now."""
    found = [
        *(folder / "results").glob(f"work/*/{EPISODES_FILE}"),
        *(folder / "results").glob(f"store/evaluate/*/{EPISODES_FILE}"),
    ]
    tables = [
        read_episodes([path])
        for path in found
        if json.loads((path.parent / SESSION_FILE).read_text()).get("number") == 8
    ]
    return max(tables, key=len) if tables else None


def check_drive(folder: Path) -> None:
    """No finished episode goes, and none changes."""
    table, kept = driven(folder), folder / "driven.arrow"
    if kept.exists():
        with pa.ipc.open_file(kept) as file:
            before = file.read_all()
        assert table.slice(0, len(before)).equals(before)
    if table is not None:
        with pa.OSFile(str(kept), "wb") as sink, pa.ipc.new_file(sink, table.schema) as file:
            file.write_table(table)


def compare_drive(folder: Path, calm: Path) -> None:
    table = driven(folder)
    assert table["episode"].to_pylist() == list(range(EPISODES))
    assert not list((folder / "results" / "work").glob(f"*/{EPISODES_FILE}"))


COMMANDS = (
    Command("run", 90, start_run, compare_run),
    Command(
        "report",
        60,
        lambda folder: wasp("report", folder / "results", "--no-trained"),
        compare_report,
    ),
    Command(
        "publish",
        50,
        start_publish,
        compare_publish,
        check=lambda folder: require_whole(folder / "published"),
    ),
    Command(
        "gc",
        45,
        lambda folder: wasp("gc", folder / "results", "--yes", "--runs"),
        compare_gc,
        begin_gc,
        check_gc,
    ),
    Command("drive", 20, lambda folder: drive(folder, 8), compare_drive, check=check_drive),
)
