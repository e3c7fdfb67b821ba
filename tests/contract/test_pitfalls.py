"""What the published code of shared autonomy got wrong, each as a check of ours. Their other
halves: `test_operators`, `test_methods`.

The numbers are those of a list of defects found in the public repositories of IDA, Diffusion, RSA
and their kin.
"""

import json
import math

import pytest
import torch

from tests.artifacts import tiny_latents
from wasp_cli.learning.assistants import build_assistant, load_parts
from wasp_cli.learning.configs import ReturnsConfig
from wasp_cli.methods.base import Heldout
from wasp_cli.methods.configs import DiffusionConfig
from wasp_cli.methods.diffusion import assist
from wasp_cli.models.denoiser import Denoiser, NoiseSchedule
from wasp_cli.operators.base import EpisodeNoise, Operator, OperatorContext


def test_the_reverse_chain_undoes_as_many_steps_as_were_taken():
    """With the exact noise as its prediction, a chain without draws returns the action that was
    diffused.
    """
    schedule = NoiseSchedule(50, 1e-4, 0.26)
    clean = torch.tensor([[0.3, -0.6]])
    for ratio in (0.1, 0.4, 0.6):
        k = schedule.forward_level(ratio)
        assert k == math.floor(49 * ratio + 1e-9)
        levels: list[int] = []

        class Exact(Denoiser):
            def __init__(self) -> None:
                torch.nn.Module.__init__(self)

            def forward(
                self, features: torch.Tensor, noisy: torch.Tensor, level: torch.Tensor
            ) -> torch.Tensor:
                levels.append(int(level))  # noqa: B023  (called within the loop)
                alpha_bar = schedule.alpha_bar[level].unsqueeze(-1)
                return (noisy - alpha_bar.sqrt() * clean) / (1 - alpha_bar).sqrt()

        draws = torch.zeros(k + 1, 1, 2)
        draws[0] = torch.tensor([[1.3, -0.2]])
        found = assist(Exact(), schedule, torch.zeros(1, 1), clean, k, draws)
        assert levels == list(range(k - 1, -1, -1))
        torch.testing.assert_close(found, clean, atol=1e-4, rtol=0)


def test_noise_at_the_last_reverse_step_changes_every_command_and_is_off():
    schedule = NoiseSchedule(10, 1e-4, 0.26)
    torch.manual_seed(0)
    denoiser = Denoiser(3, 2, [8], 10)
    source = torch.Generator().manual_seed(1)
    features, a_h, draws = (
        torch.randn(*shape, generator=source) for shape in ((6, 3), (6, 2), (5, 6, 2))
    )
    clean, noisy = (
        assist(denoiser, schedule, features, a_h.clamp(-1, 1), 4, draws, last)
        for last in (False, True)
    )
    free = clean.abs() < 1
    torch.testing.assert_close(
        (noisy - clean)[free & (noisy.abs() < 1)],
        (schedule.beta[0].sqrt() * draws[4])[free & (noisy.abs() < 1)],
    )
    assert not DiffusionConfig().last_noise


class Nearness(torch.nn.Module):
    """Q_k: the nearer to the expert the better, to each member by another measure."""

    def __init__(self, expert: torch.nn.Module) -> None:
        super().__init__()
        self.expert = expert

    def forward(self, features: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        weight = torch.tensor([[1.0, 1.0], [1.5, 0.5], [0.5, 1.5]]).unsqueeze(1)
        return -(weight * (action - self.expert(features)).square()).sum(-1)


@pytest.mark.parametrize("copilot", ["expert", "diffusion"])
def test_ida_overrules_an_exploring_expert_in_one_decision_of_twenty_and_the_expert_itself_no_more(
    parts, copilot
):
    rows = 1000
    latent, zeros = tiny_latents(rows, 3), torch.zeros(rows)
    expert = parts.skills.expert(latent.features)
    heldout = Heldout(latent, expert, zeros, zeros, zeros.long(), zeros)
    operator = Operator.build(
        1.0, OperatorContext(parts.skills.at, 2, 0.08), EpisodeNoise([0] * rows), rows
    )
    made = build_assistant("ida", {"copilot": copilot, "ratio": 0.2}, parts)
    made.ensemble = Nearness(parts.skills.expert)

    def overruled(command: torch.Tensor) -> float:
        made.reset(torch.ones(rows, dtype=torch.bool), list(range(rows)))
        return float(
            (made.decide(latent, command, operator).action != command).any(-1).float().mean()
        )

    noise = torch.randn(rows, 2, generator=torch.Generator().manual_seed(9))
    with torch.inference_mode():
        found = made.calibrate(heldout, zeros, operator, 5)
        unimpaired, exploring, bad = (
            overruled(expert),
            overruled((expert + 0.25 * noise).clamp(-1, 1)),
            overruled(-expert.sign()),
        )
    assert found["expert_rate"] <= 0.05
    assert unimpaired <= (0.0 if copilot == "expert" else 0.05)
    assert exploring <= 0.08
    # an untrained denoiser proposes little that is better
    assert exploring > 0.02 or copilot == "diffusion"
    assert bad > 0.5


@pytest.mark.parametrize(("vote", "needed"), [(0.99, 3), (0.3, 2), (0.4, 3), (-0.5, 1)])
def test_tau_q_is_the_margin_at_which_the_vote_tips(parts, vote, needed):
    made = build_assistant("ida", {"vote": vote}, parts)
    advantage = torch.randn(3, 400, generator=torch.Generator().manual_seed(2))
    tips = made._tips(advantage)
    torch.testing.assert_close(tips, advantage.sort(0, descending=True).values[needed - 1])
    for margin in (tips - 1e-4, tips + 1e-4):
        assert torch.equal((advantage - margin).sign().mean(0) > vote, margin < tips)


def test_the_thresholds_in_force_are_what_a_row_stores(artifacts, tmp_path):
    from wasp_cli.stages.evaluate import thresholds_of

    folders = {**artifacts, "calibration": tmp_path}
    (folders["calibration"] / "calibration.json").write_text(
        json.dumps({"tau_r": 0.1, "tau_q": 0.7, "tau_c": 0.9})
    )
    parts = load_parts(folders, ReturnsConfig())
    assert thresholds_of(build_assistant("ida", {}, parts)).tau_q == 0.7
    assert thresholds_of(build_assistant("filter", {}, parts)).tau_c == 0.9
    assert thresholds_of(build_assistant("filter", {"tau_c": 0.4}, parts)).tau_c == 0.4
    assert thresholds_of(build_assistant("wasp", {}, parts)).tau_r == 0.1
