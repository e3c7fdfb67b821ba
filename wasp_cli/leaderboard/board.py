"""The board: which worlds every assistant meets, and in which class it is listed."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from pathlib import Path

from wasp_cli.errors import StoreError
from wasp_cli.plan.keys import digest
from wasp_cli.spec.load import Loaded, load
from wasp_cli.spec.model import Spec
from wasp_cli.spec.shipped import SUFFIX, published_folder, specs_folder
from wasp_cli.store.tables import CellIdentity

BOARD = "field"
"""The shipped spec whose tasks, operators, seeds, episodes and models are the board's."""

CLASSES = (0.1, 0.2, 0.4, 1.0)
"""The upper bounds of the classes, as effective intervention rates. An assistant is listed in the
first class whose bound its rate on a task does not exceed. The rate is the column `int_eff`, the
share of the decisions at which the executed action is another force than the command, pooled over
the episodes of a cell and averaged over the cells, and is compared before it is rounded.
"""

DEVELOPMENT = 500
"""Evaluation seeds from here on are for development: no table of the board uses them."""

TRAINED = (1, 2, 3, 4, 5)
"""Seeds of the published trainings (specs/table1.yaml)."""


@dataclass(frozen=True)
class Board:
    """A board: a spec, and the published results whose models it uses."""

    loaded: Loaded
    published: Path

    @property
    def spec(self) -> Spec:
        """The spec that says which worlds there are."""
        return self.loaded.spec

    @property
    def digest(self) -> str:
        """A hash of what every submission has in common; two boards of one hash are comparable."""
        spec = self.spec
        worlds = {
            "tasks": list(spec.tasks),
            "operators": {name: dict(values) for name, values in spec.operators.items()},
            "seeds": list(spec.seeds),
            "training_seed": spec.training_seed,
            "episodes": spec.episodes,
            "action_repeat": spec.action_repeat,
        }
        return digest(worlds)

    def cells(self, method: str) -> list[CellIdentity]:
        """Return the cells that an assistant is evaluated in, in the order of the board."""
        spec = self.spec
        drivers = [
            (operator, float(value))
            for operator, severities in spec.operators.items()
            for value in severities.values()
        ]
        return [
            CellIdentity(task, method, "full", operator, value, seed)
            for task, (operator, value), seed in product(spec.tasks, drivers, spec.seeds)
        ]


def board_of(path: Path | None = None) -> Board:
    """Return the shipped board, or the one of a spec of your own.

    Raises:
        InvalidSpec: the spec does not read.
        StoreError: no published results come with this package.
    """
    loaded = load(specs_folder() / f"{BOARD}{SUFFIX}" if path is None else path)
    published = published_folder()
    if published is None:
        raise StoreError(
            "this installation has no published results, whose models a submission uses",
            "install the package from a wheel or a checkout",
        )
    return Board(loaded, published.absolute())


def class_of(rate: float) -> float:
    """Return the bound of the class of an effective intervention rate."""
    return next(bound for bound in CLASSES if rate <= bound)
