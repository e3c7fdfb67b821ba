"""Imagined trajectories are those whose returns the gates look at."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.worlds import NoCritics
from wasp_cli.learning.rerun import Recorded
from wasp_cli.learning.sampling import generator, gumbel
from wasp_cli.methods.wasp.imagine import Draws, Imagination, Situation, corrected, over_rollouts
from wasp_cli.models.base import Latent
from wasp_cli.models.policy import load_skills
from wasp_cli.models.world_model import load_world_model
from wasp_cli.operators.base import EpisodeNoise, Operator, OperatorContext, build_operator
from wasp_cli.video.trace import (
    ROLLOUTS,
    AsRecorded,
    RolloutStart,
    following,
    imagine,
    rollout_start,
)

HORIZON, ROWS, ROW, T = 6, 3, 1, 9
GAMMA = 0.9
PLAN = np.array([[0.4, -0.7], [-0.3, 0.2]], np.float32)


@pytest.fixture(
    params=[
        ("laggy", 0.7),
        ("noisy", 0.5),
        ("reaction-time", 0.24),
        ("reactive", 0.5),
        ("none", None),
    ],
    ids=lambda each: each[0],
)
def decided(
    request: pytest.FixtureRequest, inputs: Mapping[str, Path]
) -> tuple[Any, Operator, Latent, torch.Tensor]:
    """Model, operator, latents and commands in the middle of three episodes."""
    model = load_world_model(inputs["world_model"])
    operator = build_operator(
        *request.param,
        OperatorContext(load_skills(inputs["policies"]).at, 2, 0.08),
        EpisodeNoise([3, 4, 5]),
        ROWS,
    )
    source = generator(7)
    for _ in range(4):
        latent = Latent(
            torch.randn(ROWS, model.sizes.deter, generator=source),
            torch.rand(ROWS, model.rssm.flat, generator=source),
        )
        with torch.inference_mode():
            a_h = operator.command(latent.features).clamp(-1, 1)
    return model, operator, latent, a_h


def start(
    decided: tuple[Any, Operator, Latent, torch.Tensor], plan: np.ndarray | None = PLAN
) -> RolloutStart:
    _, operator, latent, a_h = decided
    return rollout_start(T, latent, ROW, a_h[ROW].numpy(), operator, plan, HORIZON)


@pytest.mark.parametrize("composition", ["per_step", "hold"])
def test_returns_are_those_of_the_planner(
    decided: tuple[Any, Operator, Latent, torch.Tensor], composition: str
) -> None:
    model, operator, latent, a_h = decided
    found = imagine(model, start(decided), HORIZON, [2, 6], hold=composition == "hold")

    imagination = Imagination(model, NoCritics(), operator.policy, GAMMA, GAMMA, 1.0)
    draws = Draws(
        gumbel((HORIZON, ROLLOUTS, model.noise_size), generator(2 * T + 1))[None],
        torch.rand((HORIZON, ROLLOUTS, operator.draws), generator=generator(2 * T))[None],
    )
    residuals = torch.from_numpy(np.stack([np.zeros_like(PLAN), PLAN]))[None]
    row = torch.tensor([ROW])
    now, delta = a_h[row].expand(2 * ROLLOUTS, -1), over_rollouts(residuals, ROLLOUTS)

    def held(k: int, command: torch.Tensor) -> torch.Tensor:
        """Eq. 13 as printed; the operator alone (Eq. 9) is asked on."""
        return (
            torch.cat([command[:ROLLOUTS], (now + delta[:, k])[ROLLOUTS:]])
            if k < len(PLAN)
            else command
        )

    compose = held if composition == "hold" else corrected(residuals, draws)
    with torch.inference_mode():
        cost = (
            imagination.roll(
                Situation(latent.rows(row), a_h[row], operator, row), 2, compose, draws
            )
            .cost()[:, 0]
            .mean(-1)
            .numpy()
        )
    discount = GAMMA ** np.arange(HORIZON)
    expected = (cost * discount[:, None]).sum(0)
    np.testing.assert_allclose((found.cost * discount).sum(1), expected, rtol=1e-4)
    assert abs(expected[0] - expected[1]) > 1e-6, "the plan changes nothing here"


def test_a_start_gives_the_same_again_and_leaves_the_operator_alone(
    decided: tuple[Any, Operator, Latent, torch.Tensor],
) -> None:
    model, operator, _, _ = decided
    before, begun = operator.snapshot(), start(decided)
    one, other = imagine(model, begun, HORIZON, [3]), imagine(model, begun, HORIZON, [3])
    np.testing.assert_array_equal(one.features, other.features)
    np.testing.assert_array_equal(one.images[3], other.images[3])
    after = operator.snapshot()
    assert before.keys() == after.keys()
    assert all(torch.equal(before[name], after[name]) for name in before)


def test_it_is_imagined_where_the_model_is(inputs: Mapping[str, Path]) -> None:
    """Tensors on `meta` have no values: only the copy of what is found may ask for them."""
    model, expert = (
        load_world_model(inputs["world_model"]).to("meta"),
        load_skills(inputs["policies"]).to("meta").expert,
    )
    begun = rollout_start(
        T, model.initial(1), 0, np.zeros(2, np.float32), following(expert, 2, 1), PLAN, HORIZON
    )
    for shown in ([], [1]):
        with pytest.raises(NotImplementedError, match="Cannot copy out of meta tensor"):
            imagine(model, begun, HORIZON, shown)


def test_without_a_correction_there_is_one_sequence_the_same_as_beside_one(
    decided: tuple[Any, Operator, Latent, torch.Tensor],
) -> None:
    model = decided[0]
    alone = imagine(model, start(decided, None), HORIZON, [HORIZON])
    beside = imagine(model, start(decided), HORIZON, [HORIZON])
    assert sorted(beside.images) == [HORIZON]
    features = torch.from_numpy(beside.features[:, 0, HORIZON - 1])  # of the first rollout
    with torch.inference_mode():
        decoded = model.decode(
            Latent(features[:, : model.sizes.deter], features[:, model.sizes.deter :])
        ).numpy()
    np.testing.assert_allclose(beside.images[HORIZON], decoded, atol=1e-5)
    assert alone.features.shape == (1, ROLLOUTS, HORIZON, model.feature_size)
    assert beside.features.shape[0] == 2
    np.testing.assert_allclose(alone.features[0], beside.features[0], atol=1e-5)
    nothing = imagine(model, start(decided, 0 * PLAN), HORIZON, [])
    np.testing.assert_allclose(nothing.features[0], nothing.features[1], atol=1e-6)


def test_one_whose_commands_are_taken_as_recorded_is_told_what_was_executed() -> None:
    context = OperatorContext(lambda fraction: lambda features: features[:, :2], 2, 0.08)
    operator = build_operator("reactive", 0.5, context, EpisodeNoise([3]), 1)
    said = np.full((1, 2), 0.1, np.float32)
    again = AsRecorded(operator, Recorded([0], [said], [said], [said[:, 0]]))
    assert torch.equal(again.command(torch.full((1, 2), 0.2)), torch.from_numpy(said))
    again.observe(-torch.ones(1, 2))
    forked = again.fork(torch.tensor([0]), 1, EpisodeNoise([4]))
    assert (forked.memory["pushed"] > 0).all()  # imagined, the person goes on from the reaction


def test_the_expert_follows_where_the_assistant_imagines_him(
    decided: tuple[Any, Operator, Latent, torch.Tensor],
) -> None:
    model, operator, latent, a_h = decided
    expert = following(operator.policy, 2, ROWS)
    begun = rollout_start(T, latent, ROW, a_h[ROW].numpy(), expert, PLAN, HORIZON)
    with torch.inference_mode():
        first = imagine(model, begun, HORIZON, [])
        own = imagine(model, start(decided), HORIZON, [])
    assert np.array_equal(first.features, own.features) == (type(operator) is Operator), (
        "only the unimpaired operator is the expert"
    )
