"""A spec from files and the command line: its bases, its settings, validated."""

from __future__ import annotations

import copy
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from wasp_cli.errors import UsageError
from wasp_cli.spec.hints import Finding, findings, misplaced
from wasp_cli.spec.model import Spec, validate
from wasp_cli.spec.names import EXTENDS, SHORT
from wasp_cli.spec.presets import merged
from wasp_cli.spec.read import KEY, InvalidSpec, Loc, Place, Problem, Source, dotted, kind_of, meant, parse, read
from wasp_cli.spec.shipped import spec_path

USUAL = ("mild", "moderate", "severe")


@dataclass(frozen=True)
class Loaded:
    """A valid spec and where it came from."""

    spec: Spec
    chain: Chain
    overrides: tuple[Override, ...] = ()

    def problem(self, loc: Loc, message: str, hint: str | None = None) -> InvalidSpec:
        """Return a refusal that points at a place of this spec, for what only later steps can know."""
        return InvalidSpec([_placed(self.chain, self.overrides, Finding(loc, message, hint))])


def load(path: Path, settings: Sequence[str] = ()) -> Loaded:
    """Read and validate a spec file, or a spec that comes with the package by its name, under settings `a.b=value` as of `--set`.

    An InvalidSpec has every problem, each with file, line and column.
    """
    overrides = tuple(override(number, text) for number, text in enumerate(settings, start=1))
    return loaded(chain_of(read(spec_path(path))), overrides)


def loaded(chain: Chain, overrides: Sequence[Override] = ()) -> Loaded:
    """Validate the document of a spec file and those that it extends."""
    document, problems = chain.document(named=any(option.path == ("name",) for option in overrides))
    document = apply(document, overrides)
    places = {(problem.source, problem.position) for problem in problems}
    mistakes = misplaced(document)
    spec: Spec | None = None
    try:
        spec = validate(document)
    except ValidationError as error:
        mistakes += findings(error, document)
    placed = [_placed(chain, overrides, finding) for finding in mistakes]
    problems += [problem for problem in placed if problem.position is None or (problem.source, problem.position) not in places]
    if problems or spec is None:
        raise InvalidSpec(chain.ordered(problems))
    return Loaded(spec, chain, tuple(overrides))


def _placed(chain: Chain, overrides: Sequence[Override], finding: Finding) -> Problem:
    """The problem where its value was written: in an option, or in one of the files."""
    loc, depth = finding.loc, max(source.depth(finding.loc) for source in chain.sources)
    for option in reversed(overrides):
        shared = min(len(option.path), len(loc))
        # The option wins where the files have nothing nearer to the place.
        if tuple(map(str, loc[:shared])) == option.path[:shared] and shared >= min(depth, len(option.path)):
            message = f"{dotted(loc)}: {finding.message}" if loc else finding.message
            return Problem(f"{option.option} {option.text}", None, message, finding.hint)
    return chain.problem(loc, finding.message, finding.hint, at_key=finding.at_key)


LONGEST_CHAIN = 8
SUFFIX = ".yaml"


@dataclass(frozen=True)
class Chain:
    """A spec file and, behind it, the one that it extends, the one that this extends, and so on."""

    sources: tuple[Source, ...]

    @property
    def text(self) -> str:
        """All that was read: one file as it is; of several, each as a YAML document under a comment with its name."""
        if len(self.sources) == 1:
            return self.sources[0].text
        return "".join(f"---\n# {source.name}\n{source.text.rstrip()}\n" for source in self.sources)

    def document(self, *, named: bool = False) -> tuple[dict[str, Any], list[Problem]]:
        """Return the values of all files, nearer ones over farther ones, and what in them is none; `named`: an option brings the name."""
        values: dict[str, Any] = {}
        problems: list[Problem] = []
        for source in reversed(self.sources):
            problems += source.problems
            values = merged(values, {name: value for name, value in source.document.items() if name != EXTENDS})
        nearest = self.sources[0]
        if len(self.sources) > 1 and isinstance(operators := values.get("operators"), dict):
            for variant, severities in operators.items():
                # Merged, those of the farther file would come first. Other names stay as they are.
                if isinstance(severities, dict) and set(severities) <= {*USUAL}:
                    operators[variant] = {name: severities[name] for name in USUAL if name in severities}
        if len(self.sources) > 1 and not named and "name" not in nearest.document:
            hint = "every spec needs its own name: its reports are stored under it"
            problems.append(nearest.problem((EXTENDS, KEY), "missing key 'name'", hint))
        return values, problems

    def problem(self, loc: Loc, message: str, hint: str | None = None, *, at_key: bool = False) -> Problem:
        """Return a problem in the nearest of the files that have most of a place: its value is the one in force."""
        source = max(self.sources, key=lambda source: source.depth(loc))  # of equal ones the first
        return source.problem(loc, message, hint, at_key=at_key)

    def ordered(self, problems: Sequence[Problem]) -> list[Problem]:
        """Return the problems file by file, nearest first; those of no file (options) last."""
        names = [source.name for source in self.sources]
        return sorted(problems, key=lambda problem: names.index(problem.source) if problem.source in names else len(names))


def chain_of(source: Source) -> Chain:
    """Return a source with all files that it extends: each one beside the file that names it, or a spec that comes with the package."""
    sources = [_with_list(source)]
    while EXTENDS in sources[-1].document:
        last = sources[-1]
        value, message, hint = last.document[EXTENDS], "", None
        if value is None and last.problems:  # what stands there is no value at all
            raise InvalidSpec(last.problems)
        if not isinstance(value, str) or Path(value).suffix not in ("", SUFFIX) or not Path(value).name or not value.isprintable():
            shown = repr(value) if isinstance(value, str) else kind_of(value)
            raise InvalidSpec([last.problem((EXTENDS,), f"should be the name of a spec or of a {SUFFIX} file, not {shown}")])
        path = spec_path(Path(value), Path(last.name).parent)
        files = [os.path.realpath(before.name) for before in sources]
        if os.path.realpath(path) in files:
            circle = [*(before.name for before in sources[files.index(os.path.realpath(path)) :]), str(path)]
            message = f"extends itself: {' -> '.join(circle)}"
        elif len(sources) == LONGEST_CHAIN:
            message, hint = f"a chain of more than {LONGEST_CHAIN} files", "write what they share into one of them"
        elif not os.path.exists(path):
            message, hint = f"no such file: '{path}'", meant(path)
        if message:
            raise InvalidSpec([last.problem((EXTENDS,), message, hint)])
        sources.append(_with_list(read(path)))
    return Chain(tuple(sources))


def _with_list(source: Source) -> Source:
    """`task: a` is a short way to write `tasks: [a]`."""
    if SHORT not in source.document:
        return source
    document, places, problems = dict(source.document), dict(source.places), list(source.problems)
    name, place = document.pop(SHORT), places[SHORT,]
    if "tasks" in document:
        problems.append(source.problem((SHORT, KEY), "both 'task' and 'tasks' are given", "write one of them"))
    else:
        if isinstance(name, list):
            problems.append(source.problem((SHORT,), "should be one name, not a list", "write tasks: [...]"))
        document["tasks"] = name if isinstance(name, list) else [name]
        places |= {("tasks",): place, ("tasks", 0): Place(place.value, place.value)}
    return replace(source, document=document, places=places, problems=problems)


@dataclass(frozen=True)
class Override:
    """One option: where it puts which value."""

    text: str
    path: tuple[str, ...]
    value: Any
    option: str = "--set"  # the option that brought it, for messages


def override(number: int, text: str) -> Override:
    """Read `a.b=value`; the value is YAML, so that lists, numbers and null keep their types."""
    place = f"--set #{number}"
    key, equals, value = text.partition("=")
    path = path_of(key)
    if not equals or not all(path):
        example = "for example --set wasp.candidates=64 or --set 'seeds=[0, 1]'"
        raise UsageError(f"{place}: '{text}' is not of the form key=value", example)
    meant_value = value_of(value, text, place)
    if path == ("task",):  # the short form, as in a file
        return Override(text, ("tasks",), meant_value if isinstance(meant_value, list) else [meant_value])
    return Override(text, path, meant_value)


def path_of(key: str) -> tuple[str, ...]:
    """Return `a.b` as the names on the way to a value; one of them is empty where the key is none."""
    return tuple(part.strip() for part in key.split("."))


def value_of(value: str, text: str, place: str) -> Any:
    """Return the value that a text on the command line stands for."""
    try:
        source = parse(f"value: {value.strip()}", text)
    except InvalidSpec as error:
        raise UsageError(f"{place}: the value of '{text}' is not YAML: {error.problems[0].message}") from error
    if source.problems or set(source.document) != {"value"}:
        reason = source.problems[0].message if source.problems else "more than one value"
        raise UsageError(f"{place}: '{text}': {reason}")
    return source.document["value"]


def apply(document: dict[str, Any], overrides: Sequence[Override]) -> dict[str, Any]:
    """Return the document with the options in it, later ones over earlier ones."""
    result = copy.deepcopy(document)
    for option in overrides:
        node = result
        for part in option.path[:-1]:
            below = node.get(part)
            node[part] = below = below if isinstance(below, dict) else {}
            node = below
        node[option.path[-1]] = option.value
    return result
