"""Whether an episode of a foreign environment is the same in another process.

Workers are other processes. There, strings have other hashes, so that sets have another order, and
objects lie at other addresses.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys

from wasp_cli.errors import TaskError
from wasp_cli.tasks.declared import declaration_of, declare, text_of
from wasp_cli.tasks.foreign.calls import GymEnv
from wasp_cli.tasks.foreign.make import made
from wasp_cli.tasks.foreign.worlds import Episode, random_actions

REMEDY = (
    "sort what comes out of a set, and draw nothing from hash(), id(), the clock or the number of "
    "the process: these are others in every process"
)
PROCESS_SECONDS = 120.0
"""Time after which the other process is given up."""


def require_same_elsewhere(name: str, one: GymEnv, steps: int) -> None:
    """Check that an episode is the same in another process.

    Strings have other hashes there, so that sets have another order.

    Args:
        name: its gymnasium id, with the module before the colon.
        one: an instance in this process.
        steps: env steps of the episode.

    Raises:
        TaskError: the episode differs, or the environment cannot be made in the other process.
    """
    here = Episode(one, 0).through(random_actions(one, steps, seed=1)).digest()
    for hash_seed in ("1", "2"):
        if _digest_elsewhere(name, steps, hash_seed) != here:
            raise TaskError(
                "the same seed and actions give another episode in another process", REMEDY
            )


def _digest_elsewhere(name: str, steps: int, hash_seed: str) -> str:
    """The digest of an episode in a process in which strings have the hashes of a seed."""
    declared = text_of(declaration_of(name))
    command = f"from {__name__} import print_digest; print_digest({name!r}, {steps}, {declared!r})"
    try:
        done = subprocess.run(
            [sys.executable, "-W", "ignore", "-c", command],
            env={**os.environ, "PYTHONHASHSEED": hash_seed},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=PROCESS_SECONDS,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise TaskError(
            f"an episode of {steps} env steps does not end in another process within "
            f"{PROCESS_SECONDS:g} seconds"
        ) from error
    said = done.stdout.split()
    if done.returncode != 0 or not said:
        errors = done.stderr.strip().splitlines()
        raise TaskError(
            f"it does not work in another process: {errors[-1] if errors else 'no message'}",
            "workers are other processes: its module has to be found there too",
        )
    return said[-1]


def print_digest(name: str, steps: int, declared: str) -> None:
    """Print the digest of an episode, for `require_same_elsewhere` in another process.

    `declared` is what a spec says of the environment, as JSON.
    """
    declare(name, json.loads(declared))
    with made(name) as env:
        print(Episode(env, 0).through(random_actions(env, steps, seed=1)).digest())
