"""Whether a cost can be seen before it comes: a linear probe predicts from what assistants see
whether a cost follows. What the probe finds can be seen; what it does not find, a world model may
still see.

N samples, D values of what is seen.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

FOLDS = 5  # of the cross-validation; an episode is in one of them
RIDGE = 0.3
"""Weight of the penalty, as a share of the mean squared length of a sample."""
RESAMPLES = 400  # of whole episodes, for the interval
SHARE = 0.95  # probability of the interval
FEWEST = 20
"""Fewest samples with and without a cost, of at least `FOLDS` episodes each, from which a number
is computed.
"""


@dataclass(frozen=True)
class Sight:
    """How well a cost is seen before it comes."""

    samples: int
    costly: int  # samples after which a cost followed
    auroc: float | None
    """The probability that a sample before a cost scores higher than another one, in episodes that
    the probe has not learned from; .5 is chance. None where there were too few samples.
    """
    low: float | None  # lower bound of its 95 % interval
    high: float | None  # upper bound

    @property
    def is_seen(self) -> bool:
        """Whether the whole interval lies above chance."""
        return self.low is not None and self.low > 0.5


def sight_of(
    seen: NDArray[Any], follows: NDArray[np.bool_], episode: NDArray[np.int64], seed: int = 0
) -> Sight:
    """Fit the probe, and score each episode with a probe that has not learned from it.

    Args:
        seen: [N, D].
        follows: [N] whether a cost follows.
        episode: [N] number of the episode.
        seed: of the resampled episodes.
    """
    # -- enough samples of both kinds?
    costly = int(follows.sum())
    few_samples = min(costly, len(follows) - costly) < FEWEST
    few_costly_episodes = len(np.unique(episode[follows])) < FOLDS
    few_episodes = len(np.unique(episode)) < 2 * FOLDS
    if few_samples or few_costly_episodes or few_episodes:
        return Sight(len(follows), costly, None, None, None)

    # -- scores from cross-validation
    fold = _folds(follows, episode)
    score = np.zeros(len(follows))
    gram = _gram(seen)
    for number in range(FOLDS):
        held_out = fold == number
        score[held_out] = _predicted(gram, follows, ~held_out, held_out)

    # -- the interval, over resampled episodes
    _, place = np.unique(episode, return_inverse=True)
    draws = np.random.default_rng(seed)
    count = int(place.max()) + 1
    resampled = []
    for _ in range(RESAMPLES):
        times_drawn = np.bincount(draws.integers(count, size=count), minlength=count)
        value = _auroc(score, follows, fold, times_drawn[place].astype(np.float64))
        if value is not None:
            resampled.append(value)
    low, high = np.quantile(resampled, [(1 - SHARE) / 2, (1 + SHARE) / 2])
    auroc = _auroc(score, follows, fold, np.ones(len(score)))
    return Sight(len(follows), costly, auroc, float(low), float(high))


def _folds(follows: NDArray[np.bool_], episode: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the fold [N] of every sample. Episodes stay whole, and those with costs are spread
    over the folds.
    """
    numbers = np.unique(episode)
    costs = np.array([int(follows[episode == number].sum()) for number in numbers])
    order = numbers[np.argsort(-costs, kind="stable")]
    fold_of = {int(number): place % FOLDS for place, number in enumerate(order)}
    return np.array([fold_of[int(number)] for number in episode])


def _gram(seen: NDArray[Any]) -> NDArray[np.float64]:
    """Return the products [N, N] of the samples, each value standardised over the samples."""
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
    """Return the scores of `asked` samples from a ridge regression in its dual form on `learned`
    ones; both are masks [N].
    """
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
    """Return the area under the ROC curve, over pairs of samples within a fold, whose scores come
    from one probe; ties count half. None without a pair.
    """
    won = 0.0
    pairs = 0.0
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
