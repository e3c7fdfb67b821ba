"""A spec file to a `Spec`, or to all of its problems at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from wasp_cli.spec.extend import Chain, chain_of
from wasp_cli.spec.model import Spec, validate
from wasp_cli.spec.overrides import Override, apply, override
from wasp_cli.spec.problem import InvalidSpec, Problem
from wasp_cli.spec.read import dotted, read
from wasp_cli.spec.where import Loc
from wasp_cli.spec.wording import Finding, findings, misplaced


@dataclass(frozen=True)
class Loaded:
    """A valid spec and where it came from."""

    spec: Spec
    chain: Chain
    overrides: tuple[Override, ...] = ()

    def problem(self, loc: Loc, message: str, hint: str | None = None) -> InvalidSpec:
        """A refusal that points at a place of this spec, for what only later steps can know."""
        return InvalidSpec([_placed(self.chain, self.overrides, Finding(loc, message, hint))])


def load(path: Path, settings: Sequence[str] = ()) -> Loaded:
    """Read and validate a spec file under `--set` options.

    Args:
        path: the YAML file.
        settings: texts `a.b=value`, validated as if they stood in the file.

    Raises:
        InvalidSpec: with every problem, each with file, line and column.
        UsageError: a setting is not of the form `a.b=value`.
    """
    overrides = tuple(override(number, text) for number, text in enumerate(settings, start=1))
    return loaded(chain_of(read(path)), overrides)


def loaded(chain: Chain, overrides: Sequence[Override] = ()) -> Loaded:
    """Validate the document of a spec file and those that it extends.

    Raises:
        InvalidSpec: with every problem, each with file, line and column.
    """
    document, problems = chain.document(named=any(option.path == ("name",) for option in overrides))
    document = apply(document, overrides)
    seen = {(problem.source, problem.position) for problem in problems}
    found = misplaced(document)
    spec: Spec | None = None
    try:
        spec = validate(document)
    except ValidationError as error:
        found += findings(error, document)
    for finding in found:
        problem = _placed(chain, overrides, finding)
        if problem.position is None or (problem.source, problem.position) not in seen:
            problems.append(problem)
    if problems or spec is None:
        # An alias may lead to one mistake from several sections.
        raise InvalidSpec(chain.ordered(list(dict.fromkeys(problems))))
    return Loaded(spec, chain, tuple(overrides))


def _placed(chain: Chain, overrides: Sequence[Override], finding: Finding) -> Problem:
    """The problem where its value was written: in an option, or in one of the files."""
    loc, depth = finding.loc, chain.depth(finding.loc)
    for option in reversed(overrides):
        shared = min(len(option.path), len(loc))
        # The option wins where the files have nothing nearer to the place.
        if tuple(map(str, loc[:shared])) == option.path[:shared] and shared >= min(depth, len(option.path)):
            message = f"{dotted(loc)}: {finding.message}" if loc else finding.message
            return Problem(f"{option.option} {option.text}", None, message, finding.hint)
    return chain.problem(loc, finding.message, finding.hint, at_key=finding.at_key)
