"""A search that is cut off returns its best so far; one that is never cut off does not notice that it could be."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.methods.wasp.test_equations import GAMMA_C, GAMMA_R, HIGH, JITTER, LAM, LOW, configured, policy, situation
from tests.worlds import Corridor, LinearCritics
from wasp_cli.methods.base import Decision
from wasp_cli.methods.wasp.assistant import WASP, effective
from wasp_cli.methods.wasp.imagine import Imagination, Situation
from wasp_cli.metrics.episode import CUT_OFF, GATE_SAFETY

SAMPLED: dict[str, Any] = {"probe": 20, "finalists": 2}
TAKEOVERS = SAMPLED | {"takeover_shares": (1.0, 0.5), "probe_with": "takeovers"}


def decided(
    monkeypatch: pytest.MonkeyPatch,
    changes: dict[str, Any],
    time_is_up: Callable[[], bool] | None,
    expert: Callable[[Tensor], Tensor] = policy,
) -> tuple[Decision, list[int]]:
    """A decision in front of a hazard, and how many candidates every batch of rollouts had."""
    seen: list[int] = []
    original: Callable[..., Any] = Imagination.rolled

    def counted(self: Imagination, start: Situation, residuals: Any, *rest: Any, **further: Any) -> Any:
        seen.append(residuals.shape[1])
        return original(self, start, residuals, *rest, **further)

    config = configured(**changes)
    model = Imagination(Corridor(LOW, HIGH, JITTER), LinearCritics(), effective(config), GAMMA_R, GAMMA_C, LAM, expert)
    assistant = WASP(config, model, {})
    assistant.time_is_up = time_is_up
    assistant.reset(torch.ones(1, dtype=torch.bool), [3])
    start = situation(model, 0.28, 0.8)
    with monkeypatch.context() as patch:
        patch.setattr(Imagination, "rolled", counted)
        decision = assistant.decide(start.latent, start.a_h, start.operator)
    assert decision.record is not None
    assert int(decision.record.gate) == GATE_SAFETY
    return decision, seen


def after(looks: int) -> Callable[[], bool]:
    """Time that is up once it was asked for so often."""
    asked = iter([False] * looks + [True] * 100)
    return lambda: next(asked)


@pytest.mark.parametrize("changes", [SAMPLED, TAKEOVERS], ids=["sampled", "takeovers"])
def test_a_search_with_time_enough_is_the_search_bit_for_bit(monkeypatch: pytest.MonkeyPatch, changes: dict[str, Any]) -> None:
    plain, batches = decided(monkeypatch, changes, None)
    patient, same = decided(monkeypatch, changes, lambda: False)
    assert batches == same
    for first, second in ((plain.record, patient.record), (plain.planned, patient.planned)):
        assert first is not None
        assert second is not None
        for one, other in zip(first, second, strict=True):
            torch.testing.assert_close(one, other, rtol=0, atol=0, equal_nan=True)
    assert torch.equal(plain.action, patient.action)


@pytest.mark.parametrize(("looks", "made"), [(0, 1), (1, 1), (2, 2), (3, 3)])
def test_a_search_that_is_cut_off_returns_its_best_so_far(monkeypatch: pytest.MonkeyPatch, looks: int, made: int) -> None:
    decision, batches = decided(monkeypatch, SAMPLED, after(looks))
    assert batches == [1, *[24] * made], "the gate's look and the iterations, no finalists"
    assert decision.planned is not None
    safe = decision.planned.safe[0].tolist()
    assert safe[: 3 - made] == [CUT_OFF] * (3 - made)
    assert min(safe[3 - made :]) >= 0
    assert not decision.planned.case2[0, : 3 - made].any()
    assert decision.action.item() != pytest.approx(0.8)
    assert decision.planned.cost.item() < decision.planned.alone_cost.item()


def retreats(features: Tensor) -> Tensor:
    return -torch.ones_like(features[:, :1])


@pytest.mark.parametrize(("expert", "helps"), [(policy, False), (retreats, True)])
def test_without_any_time_the_best_takeover_is_carried_out_where_it_is_better_than_nothing(
    monkeypatch: pytest.MonkeyPatch, expert: Callable[[Tensor], Tensor], helps: bool
) -> None:
    decision, batches = decided(monkeypatch, TAKEOVERS, lambda: True, expert)
    assert len(batches) == 1, "nothing is imagined but what the gates looked at"
    assert decision.planned is not None
    assert decision.planned.safe[0].tolist()[:2] == [CUT_OFF] * 2
    better = decision.planned.cost.item() < decision.planned.alone_cost.item()
    assert better == helps
    assert (decision.action.item() != pytest.approx(0.8)) == better
