"""The readout of the privileged vector against plain numpy."""

from typing import Any

import numpy as np
import pytest
import torch

from tests.learning.recordings import TINY, recording
from wasp_cli.learning.encoding import encode
from wasp_cli.learning.readout import StateReadout, fit_ridge, imagined_features
from wasp_cli.learning.world_model import build
from wasp_cli.stages.base import no_progress


def test_a_ridge_regression_is_the_textbook_one():
    random = np.random.default_rng(0)
    x, fresh = random.normal(size=(80, 6)), random.normal(size=(50, 6))
    mixing = random.normal(size=(6, 4))
    y, true = ((part @ mixing + 0.5 * random.normal(size=(len(part), 4))) * [1, 10, 3, 0] + 7 for part in (x, fresh))
    ridge = fit_ridge(torch.from_numpy(x).float(), y, 0.3)
    found = ridge.explained(torch.from_numpy(fresh).float(), true, {"all": slice(0, 4), "two": slice(1, 3), "constant": slice(3, 4)})

    x = x - (centre := x.mean(0))
    penalty = 0.3 * (x**2).sum(0).mean()
    share = []
    for j in range(3):
        unit = y[:, j].std()
        weight = np.linalg.inv(x.T @ x + penalty * np.eye(6)) @ x.T @ ((y[:, j] - y[:, j].mean()) / unit)
        told, wanted = (fresh - centre) @ weight, (true[:, j] - y[:, j].mean()) / unit
        share.append((((told - wanted) ** 2).mean(), wanted.var()))
    for name, part in (("all", share), ("two", share[1:])):
        assert found[name] == pytest.approx(1 - sum(e for e, _ in part) / sum(v for _, v in part), rel=1e-4)
    assert 0.3 < found["all"] < 1
    assert np.isnan(found["constant"]), "an entry that never varies is asked of nobody"


def test_an_imagined_latent_is_held_against_the_row_it_arrives_at(monkeypatch):
    data = recording((40,))
    torch.manual_seed(0)
    model = build(TINY, 2)
    latents = encode(model, data, no_progress)
    starts = np.arange(30)
    exact = imagined_features(model, data, latents, starts, 4, 3, 5)
    asked: list[Any] = []

    class Told:
        def explained(self, features: torch.Tensor, privileged: Any, groups: Any) -> dict[str, float]:
            asked.append((features, privileged))
            return {}

    StateReadout(model, {}, Told(), Told()).imagined(data, latents, starts, 4, 3, 5)
    features, privileged = asked[0]
    assert torch.equal(features, exact)
    np.testing.assert_array_equal(privileged, data.privileged[4:34])
    # One sample of one step is the model's own step from the filtered latent under the action that led on.
    one = imagined_features(model, data, latents, starts[:1], 1, 1, 5)
    noise = -(-torch.rand((1, 1, model.noise_size), generator=torch.Generator().manual_seed(5)).clamp(1e-20, 1 - 1e-7).log()).log()
    wanted = model.imagine(latents.at(torch.tensor([0])), torch.from_numpy(data.action[1:2]), noise[0]).features
    assert torch.allclose(one, wanted, atol=1e-6)
