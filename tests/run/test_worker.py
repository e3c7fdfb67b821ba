from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest

from tests.run.fake_stages import Fake
from tests.run.harness import Fakes, prepared
from wasp_cli.run import worker
from wasp_cli.run.order import Order
from wasp_cli.run.pool import InlinePool
from wasp_cli.run.record import new_run
from wasp_cli.run.runner import Runner
from wasp_cli.run.worker import execute
from wasp_cli.store.artifact import is_published
from wasp_cli.store.layout import Layout


@pytest.fixture
def order(fakes: Fakes, small_spec: Path, tmp_path: Path) -> Order:
    """The order for the first node of a run."""
    loaded, layout, plan = prepared(small_spec, tmp_path / "results")
    return Runner(layout, new_run(layout, loaded, plan), InlinePool())._order(plan.to_run()[0], threads=1)


def test_what_c_libraries_print_goes_to_the_log(order: Order, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Fake, "run", lambda self, job: {"written": os.write(1, b"one") + os.write(2, b"two")})
    outcome = execute(order)
    assert outcome.summary == {"written": 6}
    assert Path(outcome.log).read_text(encoding="utf-8") == "onetwo"
    os.write(1, b"restored")
    assert capfd.readouterr() == ("restored", "")


def test_a_node_that_is_there_already_is_not_computed_again(order: Order, fakes: Fakes) -> None:
    execute(order)
    assert execute(order).state == "shared"
    assert len(fakes.executions()) == 1


def test_a_result_of_changed_source_is_not_published(order: Order) -> None:
    outcome = execute(replace(order, sources={**order.sources, "wasp_cli.config": "0" * 12}))
    assert outcome.state == "failed"
    assert outcome.message == "the source changed while the run was going: wasp_cli.config"
    assert not is_published(Layout(Path(order.root)), order.kind, order.key)


def test_a_stage_that_returns_what_json_lacks_fails(order: Order, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Fake, "run", lambda self, job: {"model": object()})
    assert execute(order).message == "the stage returned object as 'model', which has no JSON form"


def test_numbers_of_numpy_and_nested_ones_become_plain() -> None:
    import numpy as np

    summary = {"a": np.float32(0.5), "b": [np.int64(2), float("inf")], "c": {"d": True}}
    assert worker._finite(summary) == {"a": 0.5, "b": [2, None], "c": {"d": True}}


def test_an_order_that_cannot_even_start_fails_without_raising(order: Order, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    outcome = execute(replace(order, root=str(tmp_path / "file")))
    assert outcome.state == "failed"
    assert "NotADirectoryError" in outcome.message
