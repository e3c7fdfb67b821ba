"""A sweep over fake stages: what its values share is computed once, and what fails takes no
other value along.
"""

from pathlib import Path

import pytest

from tests.commands import run_here
from wasp_cli.cells.asked import asked_of
from wasp_cli.cells.runs import keys_of, last_runs
from wasp_cli.errors import UsageError
from wasp_cli.run.session import RunOptions, Session, run_sweep
from wasp_cli.spec.load import read_sweep
from wasp_cli.store.find import find_node
from wasp_cli.store.records import read_record

VARY = "diffusion.ratio=0.2,0.4,0.6"


def swept(
    spec: Path,
    results: Path,
    vary: str = VARY,
    methods: tuple[str, ...] = (),
    settings: tuple[str, ...] = (),
) -> Session:
    return run_sweep(read_sweep(spec, vary, methods, settings), results, RunOptions(jobs=0))[0]


def test_what_the_values_share_is_computed_once(fakes, small_spec, tmp_path, capsys):
    done = swept(small_spec, tmp_path / "results")
    executions = fakes.executions()
    assert done.summary.complete
    assert done.summary.done == len(executions) == len(set(executions))
    # Two operators and two seeds, once for Human-only and three times for Diffusion.
    assert sum(" evaluate human " in line for line in executions) == 4
    assert sum(" evaluate diffusion " in line for line in executions) == 12
    trained = [line.split()[2] for line in executions if " evaluate " not in line]
    assert {kind: trained.count(kind) for kind in ("expert", "world_model", "denoiser")} == {
        "expert": 2,
        "world_model": 2,
        "denoiser": 2,
    }
    assert not any("ida" in line or "wasp" in line for line in executions)
    told = capsys.readouterr().err
    assert "3 values of diffusion.ratio: " in told
    assert "trained for each" not in told
    assert "done    goal1 s0 diffusion noisy=0.2 [diffusion.ratio=0.4]" in told
    assert "done    goal1 s0 human noisy=0.2  " in told
    assert swept(small_spec, tmp_path / "results").summary.done == 0


def test_every_value_is_a_run_that_reports_find(fakes, small_spec, layout):
    swept(small_spec, layout.root, settings=("episodes=7",))
    last = last_runs(layout)
    assert sorted(last.runs) == [
        f"small-diffusion.ratio-{value}" for value in ("0.2", "0.4", "0.6")
    ]
    assert not last.damaged
    for name, run in last.runs.items():
        recorded = asked_of(run)
        section = recorded.spec.method("diffusion").model_dump()
        assert (recorded.spec.name, section["ratio"], recorded.spec.episodes) == (
            name,
            float(name.rpartition("-")[2]),
            7,
        )
        assert len(recorded.cells) == len({*recorded.cells}) == 8
        assert all(layout.artifact("evaluate", cell.key).is_dir() for cell in recorded.cells)
        cell = next(cell for cell in recorded.cells if cell.method == "diffusion")
        assert find_node(layout, cell.title, keys_of(layout, name, cell.title)).key == cell.key, (
            "its label is that of three cells"
        )
        log = run_here(
            "logs",
            cell.title,
            "--run",
            name,
            "--path",
            "--results",
            layout.root,
            columns=80,
            code=0,
        ).stdout
        assert log.endswith(f"-{cell.key[:8]}.log\n")
    (record,) = layout.runs.glob("*-small-sweep-diffusion.ratio-*/sweep.json")
    assert read_record(record) == {
        "spec": "small",
        "setting": "diffusion.ratio",
        "values": [
            {"value": value, "run": last.runs[f"small-diffusion.ratio-{value}"].run_id}
            for value in (0.2, 0.4, 0.6)
        ],
    }
    assert list((record.parent / "logs").iterdir())


@pytest.mark.parametrize(
    ("vary", "methods", "settings", "message"),
    [
        (
            "diffusion.ratio=0.2,0.4",
            ("ida", "wasp"),
            (),
            "'diffusion.ratio' changes no cell of ida, wasp",
        ),
        (
            "residual.epochs=1,2",
            (),
            (),
            "'residual.epochs' changes no cell of human, ida, wasp, expert",
        ),
        ("critics.updates=1,2", (), ("methods=[]",), "there is nothing to compare"),
    ],
)
def test_a_sweep_without_effect_is_refused_before_anything_is_written(
    vary, methods, settings, message, fakes, small_spec, tmp_path
):
    with pytest.raises(UsageError) as caught:
        swept(small_spec, tmp_path / "results", vary, methods, settings)
    assert message in caught.value.message
    assert caught.value.hint
    assert not (tmp_path / "results").exists()
