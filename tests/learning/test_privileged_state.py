"""What the privileged vector teaches: the encoder before Eq. 6, the latents along with it, and
nobody who may not learn from it.
"""

from pathlib import Path

import numpy as np
import pytest
import torch

from tests.learning.recordings import MIRROR, ROWS, SOURCES, TINY, Interrupted, recording
from wasp_cli.learning.privileged_state import Readout, new_readout, teach_encoder
from wasp_cli.learning.readout import embeddings, fit_ridge
from wasp_cli.learning.shards import Recording, write_shard
from wasp_cli.learning.world_model import Report, build, mean_image, train
from wasp_cli.models.world_model import SafetyWorldModel
from wasp_cli.stages.base import Job, no_progress
from wasp_cli.stages.world_model import WorldModelStage

TAUGHT = TINY.model_copy(
    update={"taught": 150, "taught_batch": 32, "taught_head": 32, "privileged": 100.0, "depth": 4}
)


def blocks(rows: int = 400) -> Recording:
    """Images with a small bright block on noise; the vector is where it is across, its height,
    and a constant.
    """
    random = np.random.default_rng(4)
    data = recording((rows // 2, rows // 2))
    pixels = random.integers(0, 40, data.pixels.shape, dtype=np.uint8)
    across, down = random.integers(0, 58, (2, rows))
    for image, x, y in zip(pixels, across, down, strict=True):
        image[:3, y : y + 6, x : x + 6] = 220
    vector = np.stack([(across - 29) / 29, down / 29, np.ones(rows)], 1).astype(np.float32)
    return data._replace(pixels=pixels, privileged=vector)


def told(model: SafetyWorldModel, data: Recording, learned: np.ndarray, rest: np.ndarray) -> float:
    ridge = fit_ridge(embeddings(model, data.pixels[learned]), data.privileged[learned], 1e-2)
    return ridge.explained(
        embeddings(model, data.pixels[rest]), data.privileged[rest], {"place": slice(0, 2)}
    )["place"]


@pytest.mark.parametrize(
    "mirror",
    [None, (np.array([0, 1, 2]), np.array([-1, 1, 1], np.float32))],
    ids=["straight", "mirror"],
)
def test_a_taught_encoder_tells_more_of_images_that_it_has_not_seen(mirror):
    data = blocks()
    learned, rest = np.arange(300), np.arange(300, 400)
    torch.manual_seed(0)
    model = build(TAUGHT, 2)
    model.mean_image.copy_(mean_image(data))
    before = told(model, data, learned, rest)
    curve = teach_encoder(model, data, learned, TAUGHT, 3, no_progress, mirror=mirror)
    after = told(model, data, learned, rest)
    assert after > max(0.7, before + 0.1)
    assert curve[-1] < 0.5 * curve[0]


def test_rows_that_may_not_be_learned_from_teach_nothing(tmp_path):
    """Whatever the last episode holds, the same model comes out: images, vectors and their mean
    and deviation.
    """
    whole = recording()
    rows = np.flatnonzero(whole.episode < 2)
    other = whole._replace(pixels=whole.pixels.copy(), privileged=whole.privileged.copy())
    other.pixels[whole.episode == 2] = 255 - other.pixels[whole.episode == 2]
    other.privileged[whole.episode == 2] = 1e6
    found = []
    for name, data in (("whole", whole), ("other", other)):
        (tmp_path / name).mkdir()
        torch.manual_seed(0)
        config = TAUGHT.model_copy(update={"taught": 5, "ahead_starts": 0})
        model = build(config, 2)
        readout = new_readout(model, data, rows, config)
        teach_encoder(model, data, rows, config, 1, no_progress)
        train(model, data, rows, config, 4, 2, tmp_path / name, no_progress, readout=readout)
        found.append({**model.state_dict(), **readout.state_dict()})
    assert all(torch.equal(found[0][name], found[1][name]) for name in found[0])


@pytest.mark.parametrize(
    "mirror",
    [None, (np.array([1, 0, 2]), np.array([-1, 1, 0], np.float32))],
    ids=["unknown", "but the third"],
)
def test_the_loss_counts_what_is_known(mirror):
    """Against loops: in a mirror the first two entries change places, one its sign, and the
    third is not known.
    """
    random = np.random.default_rng(0)
    torch.manual_seed(0)
    readout = Readout(4, 8, 3)
    vectors = random.normal(3.0, 2.0, (50, 3)).astype(np.float32)
    vectors[:, 1] = 5.0
    readout.standardise(vectors)
    np.testing.assert_allclose(
        readout.std.numpy(), [vectors[:, 0].std(), 1.0, vectors[:, 2].std()], rtol=1e-5
    )
    features, privileged = torch.randn(3, 6, 4), torch.from_numpy(vectors[:18].reshape(3, 6, 3))
    mirrored = torch.tensor([False, True, False])
    errors = []
    for b in range(3):
        for t in range(6):
            said, (x, y, z) = readout.net(features[b, t]).detach(), privileged[b, t]
            wanted = [x, y, z] if not mirrored[b] else [-y, x] if mirror is not None else []
            errors.append(
                sum(
                    float((v - readout.mean[i]) / readout.std[i] - said[i]) ** 2
                    for i, v in enumerate(wanted)
                )
            )
    assert float(readout.loss(features, privileged, mirrored, mirror).detach()) == pytest.approx(
        np.mean(errors), rel=1e-4
    )
    if mirror is None:
        assert (
            float(
                readout.loss(features, privileged, torch.ones(3, dtype=torch.bool), None).detach()
            )
            == 0.0
        )


def test_without_weight_training_is_that_of_eq_6_alone(tmp_path):
    """The head's loss is a term of its own: its weight 0 leaves the others' numbers, and all
    draws, as they are.
    """
    data, found = recording(), []
    for weight in (0.0, 1e-12):
        config = TINY.model_copy(update={"privileged": weight, "clip": 1e9})
        torch.manual_seed(0)
        model = build(config, 2)
        readout = new_readout(model, data, ROWS, config) if weight else None
        (tmp_path / str(weight)).mkdir()
        curves, _ = train(
            model,
            data,
            ROWS,
            config,
            8,
            5,
            tmp_path / str(weight),
            no_progress,
            readout=readout,
            mirror=MIRROR,
        )
        found.append((curves, model.state_dict()))
    (plain, weights), (along, others) = found
    assert set(along) - set(plain) == {"privileged"}
    for name, curve in plain.items():
        assert along[name] == pytest.approx(curve, rel=1e-4), name
    assert all(torch.allclose(weights[name], others[name], atol=1e-4) for name in weights)


def stage_job(
    root: Path, name: str, inputs: dict[str, Path], progress: Report = no_progress
) -> Job:
    out, work = root / name, root / f"{name}-work"
    out.mkdir(exist_ok=True)
    work.mkdir(exist_ok=True)
    config = TAUGHT.model_copy(update={"taught": 40})
    return Job(
        "world_model", "goal1", 0, config, {"action_repeat": 4}, {}, inputs, out, work, progress
    )


@pytest.mark.slow
@pytest.mark.parametrize("at", ["teaching the encoder, update 21/40", "update 8/8"])
def test_an_interrupted_stage_ends_with_the_same_bytes(tmp_path, at):
    """Interrupted while the encoder is taught, which begins anew, or behind a checkpoint of Eq.
    6, which keeps what was taught.
    """
    (tmp_path / "dataset").mkdir()
    random, data = np.random.default_rng(2), recording()
    privileged = random.normal(size=(36, 65)).astype(np.float32)
    write_shard(
        tmp_path / "dataset" / "shard-0000.parquet", data._replace(privileged=privileged), SOURCES
    )
    inputs = {"dataset": tmp_path / "dataset"}
    shown = WorldModelStage().run(stage_job(tmp_path, "whole", inputs))
    assert shown["final_teaching_error"] > 0
    assert shown["final_privileged_loss"] > 0

    def interrupt(share: float, text: str) -> None:
        if text.startswith(at):
            raise Interrupted

    with pytest.raises(Interrupted):
        WorldModelStage().run(stage_job(tmp_path, "again", inputs, interrupt))
    assert WorldModelStage().run(stage_job(tmp_path, "again", inputs)) == shown
    written = {
        name: {path.name: path.read_bytes() for path in (tmp_path / name).iterdir()}
        for name in ("whole", "again")
    }
    assert written["whole"] == written["again"]
    assert {"world_model.safetensors", "curves.json"} <= set(written["whole"])
