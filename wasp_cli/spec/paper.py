"""What a paper prints and states: its tables number by number, and its claims as comparisons that
rows can answer.

The shipped file explains its keys in comments. Mistakes are reported like those of a spec, with
file, line and column.
"""

from __future__ import annotations

import hashlib
import json
import re
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import AfterValidator, Field, PlainValidator, ValidationError, model_validator
from pydantic_core import PydanticCustomError

from wasp_cli.config import Config
from wasp_cli.errors import did_you_mean
from wasp_cli.methods.registry import METHODS
from wasp_cli.metrics.episode import WEIGHTS
from wasp_cli.spec import kept
from wasp_cli.spec import read as reading
from wasp_cli.spec.hints import findings
from wasp_cli.spec.model import Problem, refuse
from wasp_cli.spec.names import NO_REPEATS, TaskName, known, unknown
from wasp_cli.spec.read import InvalidSpec, Loc, Source, parse, text_of
from wasp_cli.spec.shipped import PAPER, SUFFIX, specs_folder

COLUMNS = (*WEIGHTS, "uir", "uir_swapped", "uir_eff", "rho", "at_risk", "delta_c", "delta_r")
"""What a claim may be about: the columns of an episode, and those of the counterfactual
evaluation (section 5.3).
"""
FULL = "full"
KEPT = "paper"  # the name under which the document of a valid paper is kept

Relation = Literal["lower", "higher", "not_lower", "not_higher", "at_least", "at_most"]
BOUNDS = ("at_least", "at_most")
TOLERANT = ("not_lower", "not_higher")


class Printed(NamedTuple):
    """A printed number: a mean, and what stands after ± (None if nothing does)."""

    mean: float
    spread: float | None = None  # after ±


class Who(NamedTuple):
    """A row of a table: a method, or one of its ablations; `wasp` or `wasp/no-case2` as text."""

    method: str
    variant: str = FULL

    def __str__(self) -> str:
        return self.method if self.variant == FULL else f"{self.method}/{self.variant}"


_PRINTED = re.compile(r"(-?\d+(?:\.\d+)?)(?: ?(?:±|\+-|\+/-) ?(\d+(?:\.\d+)?))?")


def _printed(value: Any) -> Printed:
    if isinstance(value, int | float) and not isinstance(value, bool):
        return Printed(float(value))
    match = _PRINTED.fullmatch(value) if isinstance(value, str) and len(value) <= 40 else None
    if match is None:
        context = {"hint": "write it as the paper prints it: 13.74 ± 4.15, or 0"}
        raise PydanticCustomError("printed", "no printed number", context)
    return Printed(float(match[1]), None if match[2] is None else float(match[2]))


def _who(value: Any) -> Who:
    if not isinstance(value, str):
        raise PydanticCustomError(
            "who", "should be a method or method/variant", {"hint": "wasp, or wasp/no-case2"}
        )
    method, slash, variant = value.partition("/")
    if method not in METHODS:
        raise unknown("method", method, METHODS)
    # `wasp/full` is refused: the whole method has one spelling, so that a table cannot have two
    # rows of it.
    ablations = [name for name in METHODS[method].variants if name != FULL]
    if slash and variant not in ablations:
        raise unknown("ablation", variant, ablations)
    return Who(method, variant or FULL)


PrintedNumber = Annotated[Printed, PlainValidator(_printed)]
WhoName = Annotated[Who, PlainValidator(_who)]
ColumnName = Annotated[str, known("column", lambda: COLUMNS)]
Text = Annotated[str, Field(min_length=1)]
Tasks = Annotated[tuple[TaskName, ...], Field(min_length=1), NO_REPEATS]
Columns = Annotated[tuple[ColumnName, ...], Field(min_length=1), NO_REPEATS]
Whos = Annotated[tuple[WhoName, ...], Field(min_length=1), NO_REPEATS]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")]


class PrintedTable(Config):
    """A table of the paper: by task and row, a number for each of its columns."""

    name: Text
    columns: Columns
    rows: dict[TaskName, dict[WhoName, tuple[PrintedNumber, ...]]]

    @model_validator(mode="after")
    def _rectangular(self) -> PrintedTable:
        width = len(self.columns)
        problems: list[Problem] = []
        for task, rows in self.rows.items():
            for who, numbers in rows.items():
                if len(numbers) != width:
                    text = f"{len(numbers)} numbers for {width} columns"
                    what = PydanticCustomError("repeated", text, {})
                    problems.append((("rows", task, str(who)), what, None))
        refuse(problems)
        return self


@dataclass(frozen=True)
class Comparison:
    """A question that rows can answer: is `left` lower (or another relation) than `right` or
    `bound` in a column on a task?
    """

    task: str
    column: str
    left: Who
    relation: Relation
    right: Who | None = None
    bound: float | None = None
    margin: float = 0.0  # share of the right side's value


class Statement(Config):
    """Comparisons that belong together: on every task, in every column, of every `left` with every
    `right`. With `either` in place of `columns`, one of the columns is enough.
    """

    tasks: Tasks
    columns: Columns | None = None
    either: Columns | None = None
    left: Whos
    relation: Relation
    right: Whos | None = None
    bound: Annotated[float, Field(allow_inf_nan=False)] | None = None
    margin: Annotated[float, Field(ge=0, lt=1)] = 0.0

    @model_validator(mode="after")
    def _answerable(self) -> Statement:
        if (self.columns is None) == (self.either is None):
            raise ValueError(
                "one of 'columns' (all of them) and 'either' (one is enough) is needed"
            )
        if self.relation in BOUNDS and (
            self.bound is None or self.right is not None or self.margin
        ):
            raise ValueError(
                f"'{self.relation}' needs 'bound', a number, and neither 'right' nor 'margin'"
            )
        if self.relation not in BOUNDS and (self.right is None or self.bound is not None):
            raise ValueError(
                f"'{self.relation}' needs 'right', the rows to compare with, and no 'bound'"
            )
        if self.relation in TOLERANT and not self.margin:
            raise ValueError(
                f"'{self.relation}' needs a 'margin' above 0: no number of seeds can show that two "
                "means are equal"
            )
        return self

    def questions(self) -> Iterator[tuple[Comparison, ...]]:
        """Yield the questions that have to hold; of the comparisons in a tuple one is enough."""
        columns: list[tuple[str, ...]] = [self.either or ()]
        if self.columns is not None:
            columns = [(column,) for column in self.columns]
        for task, left, right, alternatives in product(
            self.tasks, self.left, self.right or (None,), columns
        ):
            yield tuple(
                Comparison(task, column, left, self.relation, right, self.bound, self.margin)
                for column in alternatives
            )


class Claim(Config):
    """A sentence of the paper (`says`, in `section`), and the statements that it is taken to
    make.
    """

    id: Name
    section: Text
    says: Text
    reading: str | None = None  # how the words were made answerable, where that is not obvious
    statements: Annotated[tuple[Statement, ...], Field(min_length=1)]

    def questions(self) -> list[tuple[Comparison, ...]]:
        """Return the questions that have to hold; of the comparisons in a tuple one is enough."""
        return [question for statement in self.statements for question in statement.questions()]


def _distinct(claims: tuple[Claim, ...]) -> tuple[Claim, ...]:
    ids = [claim.id for claim in claims]
    twice = PydanticCustomError("repeated", "an earlier claim has this id", {})
    refuse([((index, "id"), twice, name) for index, name in enumerate(ids) if name in ids[:index]])
    return claims


class Paper(Config):
    """The printed tables and the claims of a paper."""

    title: Text
    tables: tuple[PrintedTable, ...]
    claims: Annotated[tuple[Claim, ...], AfterValidator(_distinct)]

    @property
    def tasks(self) -> frozenset[str]:
        """The tasks that its tables or claims are about."""
        stated = (
            task
            for claim in self.claims
            for statement in claim.statements
            for task in statement.tasks
        )
        return frozenset(task for table in self.tables for task in table.rows).union(stated)

    def printed(self, task: str, who: Who, column: str) -> Printed | None:
        """Return the number that the paper prints for a row and a column; None if it does not print
        one.
        """
        for table in self.tables:
            row = table.rows.get(task, {}).get(who)
            if row is not None and column in table.columns:
                return row[table.columns.index(column)]
        return None


def load_paper(path: Path | None = None) -> Paper:
    """Read and validate a paper; None: the one that this project reproduces. Raises InvalidSpec."""
    path = path or specs_folder() / f"{PAPER}{SUFFIX}"
    text = text_of(path)
    # Parsing its YAML takes half as long as a plan, so a valid document is kept under the digest of
    # its text.
    version = kept.code_version(reading, sys.modules[__name__])
    digest = hashlib.sha256(text.encode()).hexdigest()
    before = kept.read_kept(KEPT, version)
    if before.get("of") == digest:
        with suppress(ValidationError):  # a plugin that it names may have been uninstalled
            return Paper.model_validate_json(json.dumps(before["document"]), strict=True)
    source = parse(text, str(path))
    paper = paper_of(source)
    kept.keep(KEPT, version, {"of": digest, "document": source.document})
    return paper


def is_paper(source: Source) -> bool:
    """Return whether a file is a paper rather than a spec: it has claims or tables."""
    return any(key in source.document for key in ("claims", "tables"))


def paper_of(source: Source) -> Paper:
    """Return the paper that a parsed file describes. Raises InvalidSpec with every problem, at its
    place.
    """
    document = source.document
    problems = list(source.problems)
    places = {problem.position for problem in problems}
    try:
        paper = Paper.model_validate_json(json.dumps(document), strict=True)
    except ValidationError as error:
        placed = [
            source.problem(finding.loc, finding.message, finding.hint, at_key=finding.at_key)
            for finding in findings(error, document, _key_hint, lambda _: None)
        ]
        problems += [problem for problem in placed if problem.position not in places]
        raise InvalidSpec(list(dict.fromkeys(problems))) from error
    if problems:
        raise InvalidSpec(problems)
    return paper


def _key_hint(loc: Loc) -> str | None:
    fields = {
        field for model in (Paper, PrintedTable, Claim, Statement) for field in model.model_fields
    }
    return did_you_mean(str(loc[-1]), sorted(fields))
