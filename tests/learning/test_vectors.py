"""Datasets, training and diagnostics of tasks that show vectors."""

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

from tests.learning.recordings import ROWS, SOURCES, TINY, recording
from wasp_cli.learning import world_model as learning
from wasp_cli.learning.diagnostics import judge_filter
from wasp_cli.learning.encoding import encode
from wasp_cli.learning.forecast import forecast, spread_starts
from wasp_cli.learning.image_samples import decoded_sample, imagined_samples, write_samples
from wasp_cli.learning.observations import judge_observations
from wasp_cli.learning.privileged_state import untaught
from wasp_cli.learning.shards import Recording, read_shards, write_shard
from wasp_cli.learning.windows import Windows
from wasp_cli.models.vectors import standard_of
from wasp_cli.stages.base import no_progress

SIZE = 4


def bare(seed: int = 0) -> Recording:
    """A recording without images."""
    data = recording(seed=seed)
    state = np.random.default_rng(seed).normal([0, 5, -3, 1], [1, 0.1, 100, 0], (36, SIZE))
    return data._replace(pixels=np.zeros(0, np.uint8), state=state.astype(np.float32))


def trained(data: Recording, folder) -> tuple[learning.SafetyWorldModel, dict]:
    torch.manual_seed(0)
    model = learning.build(TINY, 2, standard_of(data.state))
    curves, _ = learning.train(model, data, ROWS, TINY, TINY.updates, 1, folder, no_progress)
    model.requires_grad_(False)
    return model, curves


def test_a_shard_has_vectors_in_the_place_of_images(tmp_path):
    data = bare()
    write_shard(tmp_path / "shard-0000.parquet", data, SOURCES)
    columns = pq.read_schema(tmp_path / "shard-0000.parquet").names
    assert "state" in columns
    assert "pixels" not in columns
    found = read_shards(tmp_path)
    assert found.reads == "state"
    for name in ("state", "privileged", "action", "cost", "first"):
        np.testing.assert_array_equal(getattr(found, name), getattr(data, name))
    np.testing.assert_array_equal(found.seen, data.state)
    assert read_shards(tmp_path, ["reward"]).state.size == 0


def test_a_shard_with_images_has_no_vectors(tmp_path):
    write_shard(tmp_path / "shard-0000.parquet", recording(), SOURCES)
    assert "state" not in pq.read_schema(tmp_path / "shard-0000.parquet").names
    found = read_shards(tmp_path)
    assert (found.reads, found.state.size) == ("pixels", 0)


def test_windows_hold_the_vectors_of_their_rows():
    data = bare()
    windows = Windows(data, ROWS, 6, 0.0)
    source = torch.Generator().manual_seed(0)
    window = windows.sample(5, source)
    np.testing.assert_array_equal(window.batch.seen.numpy(), data.state[window.rows.numpy()])
    ahead = windows.ahead(window, 7, 3, 4, 12, source)
    assert ahead.seen.shape == (4, SIZE)


def test_training_on_vectors_goes_on_from_its_checkpoint_and_gives_the_same(tmp_path):
    data = bare()
    for name in ("whole", "parts"):
        (tmp_path / name).mkdir()
    whole, curves = trained(data, tmp_path / "whole")
    torch.manual_seed(0)
    half = learning.build(TINY, 2, standard_of(data.state))
    parts, stop = tmp_path / "parts", _interrupt_at(0.9)
    with pytest.raises(KeyboardInterrupt):
        learning.train(half, data, ROWS, TINY, TINY.updates, 1, parts, stop)
    again, _ = trained(data, tmp_path / "parts")
    assert all(
        torch.equal(one, other)
        for one, other in zip(whole.parameters(), again.parameters(), strict=True)
    )
    assert {"beta_o", "ahead_o"} <= set(curves)


def _interrupt_at(share: float):
    def report(done: float, text: str) -> None:
        if done > share:
            raise KeyboardInterrupt

    return report


def test_a_model_of_vectors_is_not_taught_what_it_sees():
    data = bare()
    config = TINY.model_copy(update={"privileged": 10.0})
    assert untaught(config, data) == {"taught": 0}, "the expert sees another vector"
    same = data._replace(privileged=data.state.copy())
    assert untaught(config, same) == {"taught": 0, "privileged": 0.0}


def test_vectors_are_judged_in_standard_deviations(tmp_path):
    data = bare()
    model, _ = trained(data, tmp_path)
    latents = encode(model, data, no_progress)
    rows = judge_observations(model, data, latents, spread_starts(data, 3, 5), 3, 1, 0)
    starts = spread_starts(data, 3, 5)
    std = np.array(model.sizes.state_std)
    for k, row in enumerate(rows, 1):
        moved = (data.state[starts + k] - data.state[starts]) / std
        assert row["copy_error"] == pytest.approx(np.square(moved).mean(), rel=1e-3)
        assert set(row) == {"vector_error", "copy_error", "vector_over_copy", "vector_explained"}
    filtered = judge_filter(model, data, latents, 36)
    # three of four components move, each with a variance of 1
    assert filtered["vector_variance"] == pytest.approx(0.75, rel=1e-3)
    now = latents.at(torch.arange(36))
    told = (model.decode(now).numpy() - data.state) / std
    assert filtered["vector_error"] == pytest.approx(np.square(told).mean(), rel=1e-2)


def test_samples_of_vectors_are_stored_in_the_tasks_own_units(tmp_path):
    data = bare()
    model, _ = trained(data, tmp_path)
    latents = encode(model, data, no_progress)
    starts = spread_starts(data, 3, 5)
    seen = forecast(model, data, latents, starts, 3, 1, 0)
    imagined = imagined_samples(model, data, latents, seen, [0, 2], 0)
    write_samples(
        tmp_path / "vectors.parquet", data, decoded_sample(model, data, latents), imagined
    )
    table = pq.read_table(tmp_path / "vectors.parquet")
    window = np.asarray(table["window"])
    true = np.array(table["true"].to_pylist(), np.float32)
    first = true[window == 0]
    np.testing.assert_array_equal(first, data.state[starts[0] : starts[0] + 4])
    told = np.array(table["model"].to_pylist(), np.float32)
    assert told.shape == true.shape
    assert np.isfinite(told).all()
