"""Who drives which episode of a dataset, and what their commands are."""

import itertools

import numpy as np
import pytest
import torch

from wasp_cli.learning.configs import MixtureConfig
from wasp_cli.learning.dataset import Behaviour, Commander, behaviours
from wasp_cli.models.policy import PrivilegedPolicy


def test_behaviours_follow_their_shares():
    chosen = behaviours(MixtureConfig().model_dump(), 50, 4, np.random.default_rng(0))
    assert len(chosen) == 50
    counts = {name: sum(b.name == name for b in chosen) for name in MixtureConfig.model_fields}
    assert all(abs(counts[name] - 50 * share) < 1 for name, share in MixtureConfig().model_dump().items())
    assert {b.skill for b in behaviours(MixtureConfig().model_dump(), 50, 1, np.random.default_rng(0))} == {-1, 0}


@pytest.mark.parametrize("seed", range(5))
def test_held_out_episodes_have_the_shares_of_all(seed):
    chosen = behaviours(MixtureConfig().model_dump(), 400, 4, np.random.default_rng(seed))
    held = chosen[9::10]
    for name, share in MixtureConfig().model_dump().items():
        assert abs(sum(b.name == name for b in held) - share * len(held)) <= 1
    assert {b.repeat for b in held if b.name == "careless"} == {0.9, 0.95}
    names = [b.name for b in chosen]
    assert len({"".join(names[i : i + 10]) for i in range(0, 400, 10)}) > 30, "the order is random all the same"


def commander(*rows: Behaviour) -> Commander:
    torch.manual_seed(0)
    skills = [PrivilegedPolicy(5, [4], 2), PrivilegedPolicy(5, [4], 2)]
    return Commander(skills, rows, 2, np.random.default_rng(0))


def test_commands_do_what_their_behaviour_says():
    rows = (
        Behaviour("plain"), Behaviour("early", skill=0), Behaviour("frozen", repeat=1.0), Behaviour("random", replace=1.0),
        Behaviour("delayed", delay=2),
    )  # fmt: skip
    driver = commander(*rows)
    random = np.random.default_rng(1)
    seen = [random.normal(size=(5, 5)).astype(np.float32) for _ in range(6)]
    issued = np.stack([driver.command(s) for s in seen])
    expert, early = (driver._skills[i](torch.from_numpy(np.stack(seen))).detach().numpy() for i in (-1, 0))
    np.testing.assert_allclose(issued[:, 0], expert[:, 0], rtol=1e-5)
    np.testing.assert_allclose(issued[:, 1], early[:, 1], rtol=1e-5)
    assert (issued[:, 2] == issued[0, 2]).all()  # a lag repeats from the second command on
    assert len({tuple(a) for a in issued[:, 3]}) == 6
    assert (issued[:2, 4] == 0).all()
    np.testing.assert_allclose(issued[2:, 4], expert[:-2, 4], rtol=1e-5)
    assert np.abs(issued).max() <= 1


def test_bursts_are_held():
    driver = commander(Behaviour("bursts", burst=1.0))
    issued = [tuple(driver.command(np.zeros((1, 5), np.float32))[0]) for _ in range(60)]
    runs = [len(list(group)) for _, group in itertools.groupby(issued)][:-1]
    assert min(runs[::2]) >= 2
    assert max(runs[::2]) <= 11
    assert set(runs[1::2]) == {1}  # the intended command stands for one step before the next burst may begin
