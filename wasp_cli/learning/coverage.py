"""Human-only episodes of a mixture of operators, and what a gate would have read in them.

The episodes are run once and recorded. A method's gate is asked afterwards: the operators are played again over the recorded latents,
so that the gate imagines them with the memory that they had. B = episodes side by side, N = recorded decisions, E = episodes.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import save_file
from torch import Tensor

from wasp_cli.learning.closed_loop import Loop, run_episodes
from wasp_cli.methods.human import HumanOnly
from wasp_cli.metrics.coverage import LEVEL, clopper_pearson, coverage_threshold, episode_score
from wasp_cli.models.base import Latent
from wasp_cli.models.policy import Skills
from wasp_cli.models.weights import read_tensors
from wasp_cli.models.world_model import SafetyWorldModel
from wasp_cli.operators.base import EpisodeNoise, Operator, OperatorContext, build_operator
from wasp_cli.operators.mixed import MixedOperator
from wasp_cli.seeds import derive
from wasp_cli.tasks.base import VectorTask

BATCH = 32
"""Episodes that are played again together."""
Mixture = Sequence[tuple[str, float]]
"""Operator variants with a severity each, all equally likely in an episode."""


class Drives(NamedTuple):
    """Recorded episodes, one after the other."""

    h: Tensor
    """[N, D] filtered"""
    z: Tensor
    """uint8 [N, Z], one-hot"""
    a_h: Tensor
    """[N, A] commands, which were executed"""
    cost: Tensor
    """[N] in {0, 1}: costly decision"""
    episode: Tensor
    """[N] index of the episode"""
    operator: Tensor
    """[E] index into the mixture"""
    seed: Tensor
    """[E] of the operator's mistakes"""


class Facts(NamedTuple):
    """What else is known of recorded episodes."""

    mixture: Mixture
    decision_seconds: float
    calibration: int
    """Episodes from which thresholds are taken: the first ones. The others are fresh."""


class Foreseeing(Protocol):
    """An assistant whose gate looks ahead at the operator alone, such as WASP."""

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        """Begin new episodes in `rows` [B] (bool); `seeds` has one entry for each of the B rows."""
        ...

    def foreseen_cost(self, latent: Latent, a_h: Tensor, operator: Operator) -> Tensor:
        """Return what the gate reads [B]."""
        ...


def mixture_of(operators: Mapping[str, Sequence[float]], skills: Sequence[float]) -> list[tuple[str, float]]:
    """List every severity of every variant; limited skills of which there is no checkpoint are left out."""
    named = [(variant, value) for variant in sorted(operators) for value in operators[variant]]
    return [(variant, value) for variant, value in named if variant != "limited-skill" or value in skills]


def operator_of(mixture: Mixture, choice: Tensor, seeds: Sequence[int], context: OperatorContext) -> MixedOperator:
    """Build the operators of B episodes: that of index `choice` [B] drives each, with the mistakes of its seed."""
    noise = EpisodeNoise(seeds)
    mixed = MixedOperator([build_operator(variant, value, context, noise, len(choice)) for variant, value in mixture], noise, seed=0)
    mixed.choice = choice
    return mixed


def record_drives(
    task: VectorTask,
    model: SafetyWorldModel,
    skills: Skills,
    mixture: Mixture,
    episodes: int,
    stream: tuple[str, int],
    progress: Callable[[float, str], None],
) -> Drives:
    """Record at least `episodes` Human-only episodes, each with an operator drawn from the mixture.

    Args:
        task: B episodes with pixels; whole batches are run, and what is more than `episodes` is dropped.
        model: the filter.
        skills: the latent policies.
        mixture: the operators.
        episodes: E.
        stream: task and seed of the training chain, which name the random streams.
        progress: told of the decisions.
    """
    context = OperatorContext(skills.at, task.action_size, task.decision_seconds)
    # Drawn and not in turn: only draws of one distribution are exchangeable.
    drawn = np.random.default_rng(derive("coverage-mixture", *stream)).integers(len(mixture), size=episodes + task.batch)
    loops: list[Loop] = []
    for first in range(0, episodes, task.batch):
        numbers = range(first, first + task.batch)
        layouts, mistakes = ([derive(f"coverage-{role}", *stream, i) for i in numbers] for role in ("episode", "operator"))

        def during(share: float, text: str, first: int = first) -> None:
            progress(min(1.0, (first + share * task.batch) / episodes), f"{first} of {episodes} episodes, {text}")

        operator = operator_of(mixture, torch.from_numpy(drawn[first : first + task.batch]), mistakes, context)
        loops.append(run_episodes(task, model, operator, HumanOnly(), layouts, mistakes, keep_latents=True, progress=during))
    parts = [_rows(loop, number, row) for number, (loop, row) in enumerate(_columns(loops, episodes))]
    seeds = torch.tensor([derive("coverage-operator", *stream, i) for i in range(episodes)])
    h, z, a_h, cost, episode = (torch.cat(fields) for fields in zip(*parts, strict=True))
    return Drives(h, z, a_h, cost, episode, torch.from_numpy(drawn[:episodes]), seeds)


def _columns(loops: Sequence[Loop], episodes: int) -> Iterator[tuple[Loop, int]]:
    """The first episodes of all loops, each as a loop and its row there."""
    yield from [(loop, row) for loop in loops for row in range(loop.alive.shape[1])][:episodes]


def _rows(loop: Loop, number: int, row: int) -> tuple[Tensor, ...]:
    """The decisions of one episode: h, z, a_h, cost, episode."""
    assert loop.h is not None
    assert loop.z is not None
    length = int(loop.alive[:, row].sum())
    a_h, cost = torch.from_numpy(loop.a_h[:length, row]), torch.from_numpy(loop.cost[:length, row].astype(np.float32))
    return loop.h[:length, row].clone(), loop.z[:length, row].to(torch.uint8), a_h, cost, torch.full((length,), number)


def save_drives(drives: Drives, facts: Facts, folder: Path) -> None:
    """Write `drives.safetensors` and `drives.json`."""
    save_file(drives._asdict(), folder / "drives.safetensors")
    (folder / "drives.json").write_text(json.dumps(facts._asdict()))


def load_drives(folder: Path) -> tuple[Drives, Facts]:
    """Load recorded episodes.

    Raises:
        ArtifactError: a file is missing or damaged.
    """
    tensors = read_tensors(folder / "drives.safetensors")
    facts = json.loads((folder / "drives.json").read_text())
    return Drives(**tensors), Facts(**facts | {"mixture": [(variant, value) for variant, value in facts["mixture"]]})


def foreseen(
    assistant: Foreseeing, drives: Drives, facts: Facts, skills: Skills, stream: tuple[str, int], batch: int
) -> list[NDArray[Any]]:
    """Return what the gate would have read at every decision: per episode [T].

    Args:
        assistant: whose gate it is.
        drives: E recorded episodes.
        facts: of them.
        skills: the latent policies of the operators.
        stream: task and seed of the training chain, which name the assistant's draws.
        batch: B; what an episode's gate reads does not depend on it, but for rounding.
    """
    context = OperatorContext(skills.at, drives.a_h.shape[1], facts.decision_seconds)
    starts = [int((drives.episode < number).sum()) for number in range(len(drives.seed) + 1)]
    found: list[NDArray[Any]] = []
    for first in range(0, len(drives.seed), batch):
        numbers = list(range(first, min(first + batch, len(drives.seed))))
        lengths = [starts[number + 1] - starts[number] for number in numbers]
        operator = operator_of(facts.mixture, drives.operator[numbers], drives.seed[numbers].tolist(), context)
        assistant.reset(torch.ones(len(numbers), dtype=torch.bool), [derive("coverage-draws", *stream, number) for number in numbers])
        read = []
        for t in range(max(lengths)):
            # An episode that has ended stays at its last decision; what is read there is dropped.
            at = torch.tensor([starts[number] + min(t, length - 1) for number, length in zip(numbers, lengths, strict=True)])
            latent = Latent(drives.h[at], drives.z[at].float())
            operator.command(latent.features)
            read.append(assistant.foreseen_cost(latent, drives.a_h[at], operator))
            operator.observe(drives.a_h[at])
        signals = torch.stack(read).numpy()  # [T, B]
        found += [signals[:length, row] for row, length in enumerate(lengths)]
    return found


def guaranteed(
    assistant: Any, drives: Drives, facts: Facts, skills: Skills, eps: float, window: int, stream: tuple[str, int]
) -> dict[str, Any]:
    """Return the threshold (`tau_c`) that leaves at most a share `eps` of costly episodes an onset without an alert, and its statement.

    Args:
        assistant: `Foreseeing`; its own thresholds play no part.
        drives: recorded episodes.
        facts: of them.
        skills: the latent policies of the operators.
        eps: the share.
        window: W, within which an alert has to precede an onset.
        stream: task and seed of the training chain.

    Raises:
        WaspError: too few episodes cost anything.
    """
    signals, cost, episode = foreseen(assistant, drives, facts, skills, stream, BATCH), drives.cost.numpy(), drives.episode.numpy()
    scores = [episode_score(signal, cost[episode == number], window) for number, signal in enumerate(signals)]
    known, fresh = scores[: facts.calibration], [score for score in scores[facts.calibration :] if score is not None]
    found = coverage_threshold([score for score in known if score is not None], eps, len(known))
    missed = sum(score <= found.value for score in fresh)
    low, high = clopper_pearson(missed, len(fresh))
    mixture = ", ".join(f"{variant} {value:g}" for variant, value in facts.mixture)
    fresh_signals = signals[facts.calibration :]
    alerts = float(np.mean(np.concatenate(fresh_signals) > np.float32(found.value))) if fresh_signals else None
    fires = "" if alerts is None else f"; the gate alerts at {alerts:.1%} of the decisions of fresh episodes"
    return {
        "statement": (
            f"of the costly episodes of these operators alone at most {eps:.1%} have an onset without an alert in the {window} decisions "
            f"up to it (threshold {found.score:.3g}: score {found.k} of {found.n}); of {len(fresh)} fresh ones {missed} have, "
            f"{LEVEL:.0%} interval {low:.3f} to {high:.3f}{fires}; operators, equally likely: {mixture}"
        ),
        "tau_c": found.value, "eps": eps, "n": found.n, "k": found.k, "episodes": len(known), "window": window,
        "mixture": facts.mixture,
        "fresh": {
            "episodes": len(fresh_signals), "costly": len(fresh), "missed": missed, "low": low, "high": high,
            "alerts": alerts,
        },
        "scores": sorted(score for score in known if score is not None),
    }  # fmt: skip
