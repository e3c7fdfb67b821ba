"""The command line from outside: exit codes, messages, what goes to which stream, what is
imported.
"""

import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import typer
from click.testing import Result

from tests.commands import ROOT, run_here, wasp
from tests.run.harness import Fakes, fakes, prepared, small_spec, written
from tests.run.recorded import key, planned, write_run
from wasp_cli import __version__
from wasp_cli.cells.asked import asked_of_grid
from wasp_cli.cli.report import NotWritten, show_report
from wasp_cli.cli.run import say_next
from wasp_cli.errors import CellsFailed
from wasp_cli.run.record import new_run
from wasp_cli.spec.load import load
from wasp_cli.spec.paper import load_paper
from wasp_cli.store.layout import Layout
from wasp_cli.store.records import write_record

__all__ = ["fakes", "small_spec"]

SMOKE = "specs/smoke.yaml"


def here(*arguments: str | Path, code: int | None = None) -> Result:
    """`wasp ARGUMENTS` in this process, where nothing but the answer matters."""
    done = run_here(*arguments, columns=200, code=code)
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exc_info
    return done


def spec_with(tmp_path: Path, old: str, new: str) -> Path:
    text = (ROOT / SMOKE).read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "spec.yaml"
    path.write_text(text.replace(old, new), encoding="utf-8")
    return path


def test_an_ascii_terminal_gets_help_and_no_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONIOENCODING", "ascii")
    done = wasp(ROOT, "run", "--help")
    assert (done.returncode, done.stderr) == (0, "")
    assert "+- Arguments -" in done.stdout


def test_version_says_what_is_published() -> None:
    version, *published = here("--version").stdout.splitlines()
    assert version == f"wasp {__version__}"
    assert "735 of table1" in " ".join(published)


@pytest.mark.parametrize(
    ("arguments", "package", "extra"),
    [(("view", "results/published"), "starlette", "web"), (("drive", "goal1"), "uvicorn", "drive")],
)
def test_without_its_packages_a_command_says_what_to_install(
    arguments: tuple[str, ...], package: str, extra: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)  # as if it were not installed
    done = here(*arguments)
    assert (done.exit_code, done.stdout) == (2, "")
    assert f"pip install 'wasp-cli[{extra}]'" in done.stderr


LIGHT = """
import sys
from wasp_cli.cli import main
for arguments, heavy in %r:
    sys.argv[1:] = arguments
    try:
        main()
    except SystemExit:
        pass
    print("IMPORTED", arguments, [name for name in heavy if name in sys.modules])
"""


def test_light_commands_import_nothing_heavy(layout: Layout, tmp_path: Path) -> None:
    driving = ["starlette", "uvicorn", "h11", "websockets"]
    heavy = ["torch", "mujoco", "joblib", "stable_baselines3", "gymnasium", *driving]
    invalid, results = spec_with(tmp_path, "episodes: 2", "episode: 2"), str(layout.root)
    run_id = "20260501-120000-small-0001"
    write_run(layout, run_id, [planned(1, "a")], [(0.0, "run started", {})])
    layout.log(run_id, "a", key(1)).write_text("log\n")
    manifest = {
        "label": "a",
        "config": {"updates": 7},
        "axes": {"method": "wasp", "method_config": {"horizon": 7}},
        "files": {},
    }
    write_record(layout.manifest("world_model", key(1)), manifest)
    commands = [
        (["--help"], [*heavy, "pydantic", "ruamel.yaml", "numpy"]),
        *(
            (arguments, heavy)
            for arguments in (
                ["drive", "--help"],
                ["view", "--help"],
                ["note", "no such cell", "text", "--results", results],
                ["plan", "specs/table1.yaml", "--results", "/nowhere"],
                ["check", "specs/table1.yaml"],
                ["schema"],
                ["run", str(invalid), "--results", results],
                ["report", "/nowhere"],
                ["status", results],
                ["logs", "a", "--results", results],
                ["show", "a", "--results", results],
                ["gc", results, "--dry-run"],
            )
        ),
    ]
    done = subprocess.run(
        [sys.executable, "-c", LIGHT % commands],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    told = [line for line in done.stdout.splitlines() if line.startswith("IMPORTED")]
    assert told == [f"IMPORTED {arguments} []" for arguments, _ in commands], done.stderr


def test_a_spec_that_only_trains_is_checked_planned_run_and_reported(
    fakes: Fakes, tmp_path: Path
) -> None:
    methods = (
        "methods: [human, ida, ida-least, ida-guarded, diffusion, csa, saferl, filter, reach, "
        "qcbf, mpmi, wasp, printed, planner, expert]"
    )
    spec, results = spec_with(tmp_path, methods, "methods: []"), tmp_path / "out"
    stages = "[diagnostics, adversary, counterfactual]"
    text = spec.read_text(encoding="utf-8").replace(stages, "[critics]")
    spec.write_text(text, encoding="utf-8")
    assert here("check", spec).stdout == f"{spec}: ok, training only\n"
    assert "nothing to evaluate" in here("plan", spec, "--results", results).stdout
    done = here("run", spec, "--results", results, "-j", "0", code=0)
    assert "7 computed" in done.stderr
    assert "Main results" not in done.stdout
    page = (results / "reports" / "smoke" / "report.md").read_text(encoding="utf-8")
    assert "- Training only: the spec lists no methods." in page
    assert page.count("| Goal1 | 0 | ") == 7
    assert "| world_model | " in page
    assert not (results / "reports" / "smoke" / "table1.md").exists()


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("episodes: 2", "episode: 2", "unknown key 'episode'"),
        ("episodes: 2", "episodes: two", ":13:11: should be an integer, not 'two'"),
        ("episodes: 2", "\n" * 87 + "episodes: two", ":100:11: should be"),
        ("[goal1]", "[gaol1]", "did you mean 'goal1'?"),
        ("name: smoke", "name: [", "not valid YAML"),
    ],
)
def test_bad_specs_end_with_3_and_a_place(
    old: str, new: str, expected: str, tmp_path: Path
) -> None:
    path = spec_with(tmp_path, old, new)
    for command in ("run", "plan", "check"):
        done = here(
            command,
            path,
            *([] if command == "check" else ["--results", tmp_path / "results"]),
            code=3,
        )
        assert expected in done.stderr
        assert f"error: {path}:" in done.stderr
        assert done.stdout == ""


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["run"], "Missing argument"),
        (["runn"], "No such command"),
        (["run", SMOKE, "-j", "-1"], "Invalid value for '--jobs'"),
        (["run", SMOKE, "--task", "goal7"], "unknown task of this spec 'goal7'"),
        (["plan", SMOKE, "--set", "seeds"], "--set #1: 'seeds' is not of the form key=value"),
        (["ablate", "--variant", "no-case"], "did you mean 'no-case2'?"),
        (
            ["ablate", "--variant", "no-case2", "--task", "goal"],
            "did you mean 'goal0', 'goal1' or 'goal2'?",
        ),
        (["ablate", "--variant", "no-case2", "--preset", "smok"], "did you mean 'smoke'?"),
    ],
)
def test_wrong_usage_ends_with_2(arguments: list[str], expected: str, tmp_path: Path) -> None:
    assert (
        expected
        in here(
            *arguments,
            *([] if arguments[0] == "runn" else ["--results", tmp_path / "results"]),
            code=2,
        ).stderr
    )


def test_a_folder_that_was_removed_under_the_shell_ends_with_2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    tmp_path.rmdir()
    assert "the current folder is not there any more" in here("status", code=2).stderr


def test_results_that_cannot_be_written_end_with_1(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for place in (tmp_path / "file", Path("/proc/results")):
        told = here("run", SMOKE, "--results", place, code=1).stderr
        assert (
            told.startswith(f"error: cannot write results to '{place}'"),
            "--results DIR" in told,
        ) == (True, True)


@pytest.mark.parametrize("record", ["plan.json", "spec.json"])
def test_one_damaged_run_does_not_hide_the_others(
    record: str, fakes: Fakes, small_spec: Path, results: Path, tmp_path: Path
) -> None:
    for path in (small_spec, written(tmp_path / "other.yaml", "name: small", "name: other")):
        loaded, layout, plan = prepared(path, results)
        new_run(layout, loaded, plan)
    (damaged,) = layout.runs.glob(f"*-small-*/{record}")
    damaged.write_text("{", encoding="utf-8")
    done = here("report", results, code=1)
    assert damaged.parent.name in done.stderr
    assert "Human-only" in done.stdout
    assert (results / "reports" / "other" / "report.md").is_file()


def test_the_report_is_written_though_the_terminal_is_gone(
    small_spec: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded, layout, plan = prepared(small_spec, tmp_path / "results")
    monkeypatch.setattr(
        "wasp_cli.report.summarize.Report.terminal", Mock(side_effect=BrokenPipeError)
    )
    with pytest.raises(BrokenPipeError):
        show_report(asked_of_grid(layout, "run", loaded.spec, plan.grid), load_paper())
    assert (layout.reports("small") / "report.md").is_file()


def test_cells_without_readable_rows_fail_the_run(
    fakes: Fakes, small_spec: Path, tmp_path: Path
) -> None:
    from wasp_cli.cli.run import run_and_report
    from wasp_cli.run.session import RunOptions

    # The fake stages end well, and write no cell.
    with pytest.raises(CellsFailed, match="14 cells cannot be read") as caught:
        run_and_report(load(small_spec), tmp_path / "results", RunOptions(jobs=0))
    assert "goal1 human noisy=0.2 seed 0" in caught.value.message
    # Their bytes are as they were stored: nothing is taken out of use, since a read may fail once.
    assert not [*(tmp_path / "results" / "store" / "evaluate").glob("*/*invalid*")]


def test_debug_shows_the_traceback_before_the_command_and_after_it() -> None:
    for arguments in (("--debug", "check", "/nowhere.yaml"), ("check", "/nowhere.yaml", "--debug")):
        done = wasp(ROOT, *arguments)
        assert ("Traceback" in done.stderr, done.returncode) == (True, 1)


def test_a_run_with_failures_names_them_with_their_logs_and_ends_with_1(
    fakes: Fakes, small_spec: Path, results: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "wasp_cli.cli.run.show_report", Mock(side_effect=NotWritten("the report cannot be written"))
    )
    fakes.set(behave={"s1 critics": "refuse"})
    done = here("run", small_spec, "--results", results, "-j", "0", code=1)
    assert (
        "1 failed:\n  goal1 s1 critics: the loss is not finite\n      lower the learning "
        "rate\n      log: " in done.stderr
    )
    assert "goal1 s1 wasp noisy=0.2 (needs goal1 s1 critics)" in done.stderr
    assert "the report cannot be written" in done.stderr
    log = done.stderr.partition("log: ")[2].split()[0]
    assert "the loss is not finite" in Path(log).read_text(encoding="utf-8")
    assert done.stdout == ""
    monkeypatch.setattr(
        "wasp_cli.cli.run.show_report", lambda *_, **__: SimpleNamespace(missing=())
    )
    fakes.set()
    assert (
        "4 computed, 32 computed before"
        in here("run", small_spec, "--results", results, "-j", "0", code=0).stderr
    )


@pytest.mark.parametrize("module", ["wasp_cli.console", "torch._C"])
def test_ctrl_c_before_a_command_has_begun_leaves_no_traceback(module: str, tmp_path: Path) -> None:
    """The signal comes when Python says that it has imported `module`; more is imported after
    each.
    """
    command = [
        sys.executable,
        "-P",
        "-X",
        "importtime",
        "-c",
        "import wasp_cli.__main__ as program; program.main()",
        "doctor",
    ]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path
    )
    sent, said = False, []
    for line in process.stderr:
        if not line.startswith("import time:"):
            said.append(line)
        elif not sent and line.split("|")[-1].strip() == module:
            process.send_signal(signal.SIGINT)
            sent = True
    process.communicate()
    assert sent
    assert (process.returncode, said) == (130, ["interrupted\n"])


def test_ctrl_c_at_a_question_is_an_interruption(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("wasp_cli.cells.runs.results_of", Mock(side_effect=typer.Abort))
    done = here("gc", tmp_path)
    assert (done.exit_code, done.stderr) == (130, "interrupted\n")


def test_who_was_started_to_ignore_ctrl_c_goes_on(tmp_path: Path) -> None:
    """As under `nohup` in a script."""
    program = (
        "import os, signal; signal.signal(signal.SIGINT, signal.SIG_IGN); import "
        "wasp_cli.__main__ as program; "
        "os.kill(os.getpid(), signal.SIGINT); program.main()"
    )
    done = subprocess.run(
        [sys.executable, "-P", "-c", program, "--version"],
        capture_output=True,
        text=True,
        cwd=tmp_path,
    )
    assert (done.returncode, done.stdout[:5]) == (0, "wasp ")


def test_what_a_run_suggests_can_be_explained(monkeypatch):
    """Of the published cells one has no steps; another is not there."""
    cells = [
        ("wasp", "empty", "0f90b6fff576de2b8175"),
        ("wasp", "missing", "0" * 20),
        ("ida", "whole", "bc484850ba1f80f0a26a"),
    ]
    told: list[str] = []
    monkeypatch.setattr("wasp_cli.cli.run.plain", told.append)
    say_next(ROOT / "results" / "published", cells)
    assert [line.split()[2] for line in told if "wasp explain" in line] == ["whole"]
