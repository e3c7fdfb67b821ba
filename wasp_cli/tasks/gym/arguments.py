"""The arguments that callers give an environment: options, seeds, and actions."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from wasp_cli.errors import TaskError, UnknownOption, UsageError, did_you_mean
from wasp_cli.tasks.base import Floats
from wasp_cli.tasks.layout import SEED_LIMIT
from wasp_cli.tasks.registry import TASKS


def refuse_other_task(task: str, registered: str | None) -> None:
    """Check that an id makes the task that is `registered` under it, so that results are never
    reported under the name of another. Raises UsageError.
    """
    if registered is not None and task != registered:
        hint = "leave task= out"
        if task in TASKS:
            hint = f"that is gymnasium.make('{TASKS[task].gym_id}')"
        raise UsageError(
            f"'{TASKS[registered].gym_id}' is the task '{registered}', and task={task!r} "
            "cannot change it",
            hint,
        )


def refuse_unknown(made: str, task: str, options: Iterable[str], known: tuple[str, ...]) -> None:
    """Check that all options are `known`; `made` is the class that got them. Raises UnknownOption,
    which is a TypeError too.
    """
    for option in options:
        if option in known:
            continue
        words = f"{made}.__init__() got an unexpected keyword argument '{option}'"
        raise UnknownOption(
            f"{words}: task '{task}' has no option '{option}' ({did_you_mean(option, known)})"
        )


def drawn_layout(draws: np.random.Generator, seed: int | None) -> int:
    """Return the layout that a seed names. Without a seed, or for one that is too large to name a
    layout (and that `draws` is seeded with), it is the next one that `draws` draws.
    """
    if seed is None or seed >= SEED_LIMIT:
        return int(draws.integers(SEED_LIMIT))
    return int(seed)


def checked_control(action: Any, shape: tuple[int, ...]) -> Floats:
    """Return an action as float64 of a shape. Raises TaskError where it is no array of real
    numbers, has another shape, or is not finite.
    """
    try:
        given = np.asarray(action)
        # NumPy would drop imaginary parts, and read texts of digits.
        if given.dtype.kind not in "biufO":
            raise TypeError(given.dtype)
        control = given.astype(np.float64)
    except (TypeError, ValueError) as error:
        kind = type(action).__name__
        if isinstance(action, np.ndarray):
            kind = f"{kind} of {action.dtype}"
        raise TaskError(f"an action is an array of real numbers, not {kind}") from error
    if control.shape != shape:
        raise TaskError(f"action has shape {control.shape}, expected {shape}")
    if not np.isfinite(control).all():
        raise TaskError(f"action is not finite: {control.tolist()}")
    return control
