from __future__ import annotations

import pytest
import torch
from torch import Tensor

from tests.worlds import Corridor, NoCritics
from wasp_cli.methods.configs import WASPConfig
from wasp_cli.methods.wasp.candidates import Batch, propose
from wasp_cli.methods.wasp.gates import Gain, probe, safe_score, scored_again, task_score
from wasp_cli.methods.wasp.imagine import Draws, Imagination, Returns, Situation
from wasp_cli.methods.wasp.planner import plan_residuals
from wasp_cli.operators.base import DrawnNoise, Operator

TAU = 0.3


class Scripted(Imagination):
    """Returns given by a function of the candidates alone."""

    def returns(self, start: Situation, residuals: Tensor, draws: Draws, share: Tensor | None = None, *, alone: int = 0) -> Returns:
        effort = residuals.square().sum((-2, -1))
        first = residuals[:, :, 0, 0]
        cost = torch.where(first < -0.4, torch.zeros_like(first), torch.ones_like(first))
        return Returns(2.0 * first, cost, effort)


def config(**changes: object) -> WASPConfig:
    sizes = {"horizon": 4, "residual_steps": 2, "candidates": 40, "elites": 10, "feasible": 5, "iterations": 5, "probe": 40}
    sizes |= {"elites_kept": 0.0, "shrink": 1.0}
    return WASPConfig.model_validate(sizes | changes)


def nowhere(batch: int) -> tuple[Situation, Draws]:
    zeros = torch.zeros(batch, 1)
    operator = Operator(lambda f: f[:, :1] * 0, 1, DrawnNoise(torch.zeros(1, batch, 0)), batch)
    start = Situation(Corridor(9, 9).at(*[0.0] * batch), zeros, operator, torch.arange(batch))
    return start, Draws(torch.zeros(batch, 4, 1, 2), torch.zeros(batch, 4, 1, 0))


def literal_plan(settings: WASPConfig, batches: list[tuple[Tensor, Returns]]) -> Tensor:
    """The sequence that section 4.3 selects from the batches of all iterations of one decision."""
    best_task, best_safe = (-float("inf"), None), (float("inf"), None)
    for candidates, returns in batches:
        for n in range(candidates.shape[1]):
            g_r, g_c, effort = (float(field[0, n]) for field in returns)
            if g_c <= TAU and g_r - settings.alpha * effort > best_task[0]:
                best_task = (g_r - settings.alpha * effort, candidates[0, n])
            s_safe = max(0.0, g_c - TAU) + settings.alpha * effort
            if s_safe < best_safe[0]:
                best_safe = (s_safe, candidates[0, n])
    chosen = best_task[1] if best_task[1] is not None else best_safe[1]
    assert chosen is not None
    return chosen


def literal_elites(settings: WASPConfig, returns: Returns) -> list[int]:
    """Indices of the elites of one batch, by Eq. 14-17; without Case II the safe ones, however few."""
    g_r, g_c, effort = (field[0] for field in returns)
    safe = [n for n in range(len(g_r)) if g_c[n] <= TAU]
    if len(safe) >= settings.feasible or settings.variant == "no-case2":
        ranked = sorted(safe, key=lambda n: -float(g_r[n] - settings.alpha * effort[n]))
        return ranked[: settings.elites]
    ranked = sorted(range(len(g_r)), key=lambda n: max(0.0, float(g_c[n]) - TAU) + settings.alpha * float(effort[n]))
    return ranked[: settings.feasible]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("feasible", [3, 40])
@pytest.mark.parametrize("variant", ["full", "no-case2"])
def test_a_whole_search_equals_its_literal_reading(seed: int, feasible: int, variant: str) -> None:
    settings = config(feasible=feasible, iterations=3, variant=variant)
    model = Scripted(Corridor(9, 9), NoCritics(), settings, 0.9, 0.9, 0.9)
    start, draws = nowhere(1)
    normals = torch.randn(1, 3, 40, 2, 1, generator=torch.Generator().manual_seed(seed))
    found = plan_residuals(model, start, torch.zeros(1, 2, 1), normals, draws, TAU)

    mean, std = torch.zeros(1, 2, 1), torch.full((1, 2, 1), settings.initial_std)
    batches = []
    for i in range(3):
        candidates = propose(mean, std, normals[:, i], nothing=i == 0)
        returns = model.returns(start, candidates, draws)
        batches.append((candidates, returns))
        elites = candidates[:, literal_elites(settings, returns)]
        new = elites.mean(1)
        std = (elites - new.unsqueeze(1)).square().mean(1).sqrt().clamp(min=settings.std_floor)
        mean = settings.momentum * mean + (1 - settings.momentum) * new
    torch.testing.assert_close(found.residuals[0], literal_plan(settings, batches))
    case2 = [int((returns.cost <= TAU).sum()) < feasible for _, returns in batches]
    assert found.case2[0].tolist() == case2
    assert found.safe[0].tolist() == [int((returns.cost <= TAU).sum()) for _, returns in batches]
    predicted = model.returns(start, found.residuals.unsqueeze(1), draws)
    assert [float(field[0]) for field in found.predicted] == [float(field[0, 0]) for field in predicted]
    assert [float(field[0]) for field in found.alone] == [0.0, 1.0, 0.0]


def test_decisions_of_a_batch_do_not_touch_each_other() -> None:
    settings = config(iterations=3)
    model = Scripted(Corridor(9, 9), NoCritics(), settings, 0.9, 0.9, 0.9)
    normals = torch.randn(3, 3, 40, 2, 1)
    start, draws = nowhere(3)
    together = plan_residuals(model, start, torch.zeros(3, 2, 1), normals, draws, TAU).residuals
    for b in range(3):
        alone, own = nowhere(1)
        torch.testing.assert_close(
            plan_residuals(model, alone, torch.zeros(1, 2, 1), normals[b : b + 1], own, TAU).residuals[0], together[b]
        )


def test_without_a_safe_candidate_the_lowest_safety_score_is_chosen() -> None:
    settings = config()
    model = Scripted(Corridor(9, 9), NoCritics(), settings, 0.9, 0.9, 0.9)
    start, draws = nowhere(1)
    normals = torch.rand(1, 2, 40, 2, 1)  # never below -0.4: nothing is safe
    found = plan_residuals(model, start, torch.zeros(1, 2, 1), normals, draws, TAU)
    assert not bool(found.found_safe)
    assert bool(found.case2.all())
    assert (found.residuals == 0).all()  # every cost is alike, so the least effort wins


@pytest.mark.parametrize("rescored", [False, True])
def test_no_case2_keeps_the_command_where_the_whole_method_takes_the_least_unsafe_plan(rescored: bool) -> None:
    class Hopeless(Scripted):
        """The harder the brake the smaller the cost, which never becomes small enough."""

        def returns(self, start: Situation, residuals: Tensor, draws: Draws, share: Tensor | None = None, *, alone: int = 0) -> Returns:
            found = super().returns(start, residuals, draws)
            return found._replace(cost=TAU + 2.5 + residuals[:, :, 0, 0])

    start, draws = nowhere(1)
    normals = torch.randn(1, 3, 40, 2, 1, generator=torch.Generator().manual_seed(0))
    found = {}
    for variant in ("full", "no-case2"):
        settings = config(variant=variant, iterations=3, finalists=4 if rescored else 0)
        model = Hopeless(Corridor(9, 9), NoCritics(), settings, 0.9, 0.9, 0.9)
        found[variant] = plan_residuals(model, start, torch.zeros(1, 2, 1), normals, draws, TAU, fresh=draws if rescored else None)
    assert not any(bool(plan.found_safe) for plan in found.values())
    assert float(found["full"].residuals[0, 0, 0]) < -0.5
    assert float(found["full"].predicted.cost) < TAU + 2.0
    assert (found["no-case2"].residuals == 0).all()
    assert [float(field) for field in found["no-case2"].predicted] == [float(field) for field in found["no-case2"].alone]


def test_no_case2_learns_from_the_few_safe_candidates_and_without_any_from_none() -> None:
    """Case II would move the distribution toward the N_f candidates of lowest S_safe, safe or not."""
    start, draws = nowhere(1)
    for brake, wanted in ((-0.9, -0.9), (0.2, 0.0)):
        batches: list[Tensor] = []

        class Watched(Scripted):
            def returns(self, start: Situation, residuals: Tensor, draws: Draws, share: Tensor | None = None, *, alone: int = 0) -> Returns:
                batches.append(residuals)  # noqa: B023
                return super().returns(start, residuals, draws)

        settings = config(variant="no-case2", iterations=2, momentum=0.0, finalists=0, initial_std=1.0)
        model = Watched(Corridor(9, 9), NoCritics(), settings, 0.9, 0.9, 0.9)
        normals = torch.full((1, 2, 40, 2, 1), 0.1)
        normals[0, 0, 2] = brake  # the only candidate that may be safe
        normals[0, 1] = 0.0
        plan_residuals(model, start, torch.zeros(1, 2, 1), normals, draws, TAU)
        assert batches[1][0, 2:, :, 0] == pytest.approx(wanted)  # without noise every candidate is the mean


def test_broken_rollouts_are_never_chosen() -> None:
    class Broken(Scripted):
        def returns(self, start: Situation, residuals: Tensor, draws: Draws, share: Tensor | None = None, *, alone: int = 0) -> Returns:
            found = super().returns(start, residuals, draws)
            bad = residuals[:, :, 0, 0] < -0.6
            return Returns(*(torch.where(bad, torch.nan, field) for field in found))

    model = Broken(Corridor(9, 9), NoCritics(), config(), 0.9, 0.9, 0.9)
    start, draws = nowhere(1)
    normals = torch.randn(1, 5, 40, 2, 1, generator=torch.Generator().manual_seed(0))  # of some seeds no candidate is safe
    found = plan_residuals(model, start, torch.zeros(1, 2, 1), normals, draws, TAU)
    assert torch.isfinite(found.residuals).all()
    assert -0.6 <= float(found.residuals[0, 0, 0]) <= -0.4


def test_where_every_rollout_is_broken_the_command_stands() -> None:
    class Broken(Scripted):
        def returns(self, start: Situation, residuals: Tensor, draws: Draws, share: Tensor | None = None, *, alone: int = 0) -> Returns:
            return Returns(*(torch.full_like(field, torch.nan) for field in super().returns(start, residuals, draws)))

    start, draws = nowhere(1)
    # Where nothing is forced, the first candidate is a sample and no zero.
    for settings in (config(), config(finalists=0), config(finalists=0, forced=False), config(variant="no-case2")):
        model = Broken(Corridor(9, 9), NoCritics(), settings, 0.9, 0.9, 0.9)
        fresh = draws if settings.finalists else None
        found = plan_residuals(model, start, torch.full((1, 2, 1), 0.3), torch.randn(1, 5, 40, 2, 1), draws, TAU, fresh=fresh)
        assert (found.residuals == 0).all()
        assert not bool(found.found_safe)


def test_a_kept_plan_is_a_candidate_and_a_finalist() -> None:
    """Only one narrow escape is safe, which no sample meets: it is found if and only if it was kept."""

    class Narrow(Scripted):
        def returns(self, start: Situation, residuals: Tensor, draws: Draws, share: Tensor | None = None, *, alone: int = 0) -> Returns:
            cost = ((residuals - 1.25).abs().amax((-2, -1)) > 1e-6).to(residuals.dtype)
            return Returns(torch.zeros_like(cost), cost, residuals.square().sum((-2, -1)))

    start, draws = nowhere(1)
    normals = torch.randn(1, 3, 40, 2, 1, generator=torch.Generator().manual_seed(0))
    for settings in (config(iterations=3, finalists=0), config(iterations=3)):
        model = Narrow(Corridor(9, 9), NoCritics(), settings, 0.9, 0.9, 0.9)
        fresh = draws if settings.finalists else None
        without = plan_residuals(model, start, torch.zeros(1, 2, 1), normals, draws, TAU, fresh=fresh)
        kept = plan_residuals(model, start, torch.zeros(1, 2, 1), normals, draws, TAU, fresh=fresh, kept=torch.full((1, 2, 1), 1.25))
        assert not bool(without.found_safe)
        assert bool(kept.found_safe)
        assert (kept.residuals == 1.25).all()


def test_the_first_candidates_are_nothing_and_the_mean() -> None:
    mean = torch.full((2, 3, 1), 0.7)
    candidates = propose(mean, torch.full_like(mean, 9.0), torch.randn(2, 6, 3, 1))
    assert (candidates[:, 0] == 0).all()
    assert torch.equal(candidates[:, 1], mean)
    assert candidates.abs().max() <= 2


def test_scores_follow_equations_16_and_17() -> None:
    returns = Returns(torch.tensor([[3.0]]), torch.tensor([[0.9]]), torch.tensor([[2.0]]))
    assert task_score(returns, 0.1).item() == pytest.approx(2.8)
    assert safe_score(returns, 0.1, 0.3).item() == pytest.approx(0.6 + 0.2)
    assert safe_score(returns, 0.1, 2.0).item() == pytest.approx(0.2)


def test_the_task_gate_scores_its_winner_again_and_finds_nothing_without_a_feasible_one() -> None:
    start, draws = nowhere(1)
    settings = config()
    model = Imagination(Corridor(9.0, 10.0), NoCritics(), settings, 1.0, 1.0, 1.0)
    candidates = torch.tensor([0.0, 0.5, -0.5]).view(1, 3, 1, 1).expand(1, 3, 2, 1).clone()

    def judged(model: Imagination) -> Gain:
        batch = Batch(candidates, None, model.returns(start, candidates, draws))
        gain = probe(batch, model.nominal(start, draws).reward, settings, TAU)
        return scored_again(model, start, batch, gain, draws)

    gain = judged(model)
    assert int(gain.best) == 1
    assert gain.delta_g.item() == pytest.approx(0.1)  # two steps of 0.1 x 0.5; the effort is not part of Eq. 12
    trapped = Imagination(Corridor(-9.0, 9.0), NoCritics(), settings, 1.0, 1.0, 1.0)
    assert judged(trapped).delta_g.item() == -float("inf")


def test_finalists_are_scored_again_so_that_luck_does_not_win() -> None:
    """In the search every brake looks safe; on other draws only a hard one is. The lucky soft brake must not be executed."""

    class Lucky(Scripted):
        def returns(self, start: Situation, residuals: Tensor, draws: Draws, share: Tensor | None = None, *, alone: int = 0) -> Returns:
            bound = -1.0 if draws.latent.mean() > 0.5 else -0.4
            first = residuals[:, :, 0, 0]
            return Returns(2.0 * first, (first >= bound).to(first.dtype), residuals.square().sum((-2, -1)))

    settings = config(iterations=3, finalists=10, initial_std=1.0)
    model = Lucky(Corridor(9, 9), NoCritics(), settings, 0.9, 0.9, 0.9)
    start, draws = nowhere(1)
    normals = torch.randn(1, 3, 40, 2, 1, generator=torch.Generator().manual_seed(0))
    normals[:, 0, 2] = -1.2  # one hard brake among the first candidates
    arguments = (model, start, torch.zeros(1, 2, 1), normals, draws, TAU)
    naive = plan_residuals(*arguments)
    assert -1.0 < float(naive.residuals[0, 0, 0]) < -0.4
    careful = plan_residuals(*arguments, fresh=Draws(torch.ones(1, 4, 2, 2), torch.zeros(1, 4, 2, 0)))
    assert bool(naive.found_safe)
    chosen = float(careful.residuals[0, 0, 0])
    assert chosen < -1.0 if bool(careful.found_safe) else chosen == 0.0


def test_no_finalist_is_there_twice() -> None:
    """No residual is a candidate too, a plan may be among the best by both scores, and the kept one may be the first mean."""

    class Watched(Scripted):
        def returns(self, start: Situation, residuals: Tensor, draws: Draws, share: Tensor | None = None, *, alone: int = 0) -> Returns:
            if alone:
                seen.append(residuals)
            found = super().returns(start, residuals, draws)
            # Without residual nothing costs, and the less the better: every score ranks it first.
            return found._replace(reward=-found.effort, cost=(found.effort > 0.5).to(found.cost.dtype))

    start, draws = nowhere(2)
    for kept, finalists in ((None, 4), (torch.tensor([0.2, 0.0]).view(2, 1, 1).expand(2, 2, 1), 4), (None, 1)):
        seen: list[Tensor] = []
        settings = config(iterations=4, finalists=finalists, elites_kept=0.5)
        model = Watched(Corridor(9, 9), NoCritics(), settings, 0.9, 0.9, 0.9)
        normals = torch.randn(2, 4, 40, 2, 1, generator=torch.Generator().manual_seed(1))
        mean = torch.zeros(2, 2, 1) if kept is None else kept
        plan_residuals(model, start, mean, normals, draws, TAU, fresh=draws, kept=kept)
        (plans,) = seen
        for row in plans:
            assert len({tuple(plan.flatten().tolist()) for plan in row}) == 2 * finalists + (1 if kept is None else 2)


def test_kept_elites_stay_candidates_while_the_population_shrinks() -> None:
    """The elites of an iteration are candidates of the next without being imagined again, and count among the safe ones."""
    batches: list[int] = []

    class Watched(Scripted):
        def returns(self, start: Situation, residuals: Tensor, draws: Draws, share: Tensor | None = None, *, alone: int = 0) -> Returns:
            batches.append(residuals.shape[1])
            found = super().returns(start, residuals, draws)
            return found._replace(cost=torch.zeros_like(found.cost))

    settings = config(elites_kept=0.5, shrink=2.0, finalists=0)
    model = Watched(Corridor(9, 9), NoCritics(), settings, 0.9, 0.9, 0.9)
    start, draws = nowhere(1)
    normals = torch.randn(1, 5, 40, 2, 1, generator=torch.Generator().manual_seed(0))
    found = plan_residuals(model, start, torch.zeros(1, 2, 1), normals, draws, TAU)
    assert batches == [40, 20, 10, 10, 10, 1]  # never fewer than the elites; and the command alone
    assert found.safe[0].tolist() == [40, 25, 15, 15, 15]


def test_the_plan_is_the_best_of_all_iterations_or_of_the_last() -> None:
    class Falling(Scripted):
        def returns(self, start: Situation, residuals: Tensor, draws: Draws, share: Tensor | None = None, *, alone: int = 0) -> Returns:
            rounds.append(0)
            value = torch.full(residuals.shape[:2], -float(len(rounds)))
            return Returns(value + residuals[:, :, 0, 0] * 1e-3, torch.zeros_like(value), torch.zeros_like(value))

    start, draws = nowhere(1)
    normals = torch.randn(1, 3, 40, 2, 1, generator=torch.Generator().manual_seed(0))
    rewards = {}
    for best_of in ("all", "last"):
        rounds: list[int] = []
        model = Falling(Corridor(9, 9), NoCritics(), config(iterations=3, best_of=best_of, finalists=0), 0.9, 0.9, 0.9)
        rewards[best_of] = round(plan_residuals(model, start, torch.zeros(1, 2, 1), normals, draws, TAU).predicted.reward.item())
    assert rewards == {"all": -1, "last": -3}
