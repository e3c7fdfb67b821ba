"""Whether a cost can be seen before it comes: a linear probe, from what assistants see to whether a
cost follows. It is no world model: what it finds is there to be seen, and what it does not find may
still be there.

N = samples, D = values of what is seen.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

FOLDS = 5
RIDGE = 0.3
"""Weight of the penalty, as a share of the mean squared length of a sample."""
RESAMPLES = 400
SHARE = 0.95
FEWEST = 20
"""Samples of either kind, of at least `FOLDS` episodes each, without which nothing is said."""


@dataclass(frozen=True)
class Sight:
    """How well a cost is seen before it comes."""

    samples: int
    costly: int  # samples after which a cost followed
    auroc: float | None
    """The probability that a sample before a cost scores higher than another one, in episodes that
    the probe has not learned from; .5 is chance. None where there were too few samples."""
    low: float | None  # of the interval that holds it with a probability of .95
    high: float | None

    @property
    def is_seen(self) -> bool:
        """Whether the whole interval lies above chance."""
        return self.low is not None and self.low > 0.5


def sight_of(
    seen: NDArray[Any], follows: NDArray[np.bool_], episode: NDArray[np.int64], seed: int = 0
) -> Sight:
    """Fit the probe with held-out episodes.

    Args:
        seen: [N, D].
        follows: [N] whether a cost follows.
        episode: [N] the number of the episode.
        seed: of the resampled episodes, from which the interval comes.
    """
    costly = int(follows.sum())
    few = min(costly, len(follows) - costly) < FEWEST
    if few or len(np.unique(episode[follows])) < FOLDS or len(np.unique(episode)) < 2 * FOLDS:
        return Sight(len(follows), costly, None, None, None)
    fold = _folds(follows, episode)
    score = np.zeros(len(follows))
    gram = _gram(seen)
    for number in range(FOLDS):
        held_out = fold == number
        score[held_out] = _predicted(gram, follows, ~held_out, held_out)
    _, place = np.unique(episode, return_inverse=True)
    draws = np.random.default_rng(seed)
    count = int(place.max()) + 1
    found = []
    for _ in range(RESAMPLES):
        drawn = np.bincount(draws.integers(count, size=count), minlength=count)
        value = _auroc(score, follows, fold, drawn[place].astype(np.float64))
        if value is not None:
            found.append(value)
    low, high = np.quantile(found, [(1 - SHARE) / 2, (1 + SHARE) / 2])
    whole = _auroc(score, follows, fold, np.ones(len(score)))
    return Sight(len(follows), costly, whole, float(low), float(high))


def _folds(follows: NDArray[np.bool_], episode: NDArray[np.int64]) -> NDArray[np.int64]:
    """The fold [N] of every sample: whole episodes, those with costs spread over the folds."""
    numbers = np.unique(episode)
    costs = np.array([int(follows[episode == number].sum()) for number in numbers])
    order = numbers[np.argsort(-costs, kind="stable")]
    fold_of = {int(number): place % FOLDS for place, number in enumerate(order)}
    return np.array([fold_of[int(number)] for number in episode])


def _gram(seen: NDArray[Any]) -> NDArray[np.float64]:
    """The products [N, N] of the samples, each value about its mean and in units of its spread."""
    values = seen.astype(np.float32)
    values -= values.mean(0)
    spread = values.std(0)
    values /= np.maximum(spread, 0.05 * max(float(spread.max()), 1e-9))
    return (values @ values.T).astype(np.float64)


def _predicted(
    gram: NDArray[np.float64],
    follows: NDArray[np.bool_],
    learned: NDArray[np.bool_],
    asked: NDArray[np.bool_],
) -> NDArray[np.float64]:
    """Ridge regression in its dual form: scores of `asked` samples from those of `learned`."""
    inner = gram[np.ix_(learned, learned)]
    target = follows[learned].astype(np.float64)
    penalty = RIDGE * np.trace(inner) / len(inner)
    weights = np.linalg.solve(inner + penalty * np.eye(len(inner)), target - target.mean())
    predicted: NDArray[np.float64] = gram[np.ix_(asked, learned)] @ weights
    return predicted


def _auroc(
    score: NDArray[np.float64],
    follows: NDArray[np.bool_],
    fold: NDArray[np.int64],
    weight: NDArray[np.float64],
) -> float | None:
    """The area under the curve over pairs within a fold, whose scores have one probe; ties count
    half. None without a pair.
    """
    won = pairs = 0.0
    for number in range(FOLDS):
        here = fold == number
        before = here & follows
        other = here & ~follows
        order = np.argsort(score[other], kind="stable")
        ranked = score[other][order]
        mass = np.append(0.0, np.cumsum(weight[other][order]))
        below = mass[np.searchsorted(ranked, score[before], "left")]
        up_to = mass[np.searchsorted(ranked, score[before], "right")]
        won += float(weight[before] @ (below + up_to)) / 2.0
        pairs += float(weight[before].sum() * mass[-1])
    return won / pairs if pairs else None
