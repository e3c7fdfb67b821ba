"""`extends: other.yaml`: a spec over another one. Sections merge key by key, everything else replaces, and every value keeps its place."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wasp_cli.spec.names import EXTENDS, SHORT
from wasp_cli.spec.plain import plain
from wasp_cli.spec.presets import merged
from wasp_cli.spec.problem import InvalidSpec, Problem
from wasp_cli.spec.read import Source, beside, kind_of, read
from wasp_cli.spec.where import KEY, Loc, locate

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
        """The values of all files, nearer ones over farther ones, and what in them is none.

        Args:
            named: the spec has a name from elsewhere, so that its file need not say one.
        """
        values: dict[str, Any] = {}
        problems: list[Problem] = []
        for source in reversed(self.sources):
            document, found = plain(source)
            document.pop(EXTENDS, None)
            document, also = _listed(source, document)
            problems += found + also
            values = merged(values, document)
        nearest = self.sources[0]
        if len(self.sources) > 1 and not named and "name" not in nearest.document:
            hint = "a spec has its own name, since reports are kept under it"
            problems.append(nearest.problem((EXTENDS, KEY), "missing key 'name'", hint))
        return values, problems

    def depth(self, loc: Loc) -> int:
        """How many parts of a place the files have."""
        return max(_depth(source, loc) for source in self.sources)

    def problem(self, loc: Loc, message: str, hint: str | None = None, *, at_key: bool = False) -> Problem:
        """A problem in the nearest of the files that have most of a place: its value is the one in force."""
        source = max(self.sources, key=lambda source: _depth(source, loc))  # of equal ones the first
        return source.problem(_as_written(source, loc), message, hint, at_key=at_key)

    def ordered(self, problems: Sequence[Problem]) -> list[Problem]:
        """Problems file by file, nearest first; those of no file (options) last."""
        names = [source.name for source in self.sources]
        return sorted(problems, key=lambda problem: names.index(problem.source) if problem.source in names else len(names))


def chain_of(source: Source) -> Chain:
    """A source with all files that it extends.

    Raises:
        InvalidSpec: one of them cannot be read, is named wrongly, or the chain is too long or comes back to one of its files.
    """
    sources, seen = [source], [_identity(source.name)]
    while EXTENDS in sources[-1].document:
        last = sources[-1]
        path = _extended(last)
        if _identity(str(path)) in seen:
            round_ = " -> ".join([*(each.name for each in sources[seen.index(_identity(str(path))) :]), str(path)])
            raise _refused(last, f"extends itself: {round_}")
        if len(sources) == LONGEST_CHAIN:
            raise _refused(last, f"a chain of more than {LONGEST_CHAIN} files", "write what they share into one of them")
        if not os.path.exists(path):
            raise _refused(last, f"no such file: '{path}'", beside(path.parent, path.name))
        sources.append(read(path))
        seen.append(_identity(str(path)))
    return Chain(tuple(sources))


def _extended(source: Source) -> Path:
    """The file that a source extends; a relative path begins at the folder of the source."""
    value = source.document[EXTENDS]
    if not isinstance(value, str):
        shown = "nothing" if value is None else "a number" if isinstance(value, int | float) else kind_of(value)
        raise _refused(source, f"should be the name of one file, not {shown}")
    if not value.endswith(SUFFIX) or not value.isprintable():
        raise _refused(source, f"should be the name of a {SUFFIX} file, not {value!r}")
    return Path(source.name).parent / value


def _refused(source: Source, message: str, hint: str | None = None) -> InvalidSpec:
    return InvalidSpec([source.problem((EXTENDS,), message, hint)])


def _identity(name: str) -> str:
    return os.path.realpath(name)


def _as_written(source: Source, loc: Loc) -> Loc:
    """`task: a` in a file is `tasks: [a]` in its document."""
    return (SHORT,) if loc[:1] == ("tasks",) and SHORT in source.document else loc


def _depth(source: Source, loc: Loc) -> int:
    """How many parts of a place a file has."""
    written = _as_written(source, loc)
    return locate(source.document, written).depth if written == loc else len(loc)


def _listed(source: Source, document: dict[str, Any]) -> tuple[dict[str, Any], list[Problem]]:
    """`task: a` is a short way to write `tasks: [a]`."""
    if SHORT not in document:
        return document, []
    rest = {name: value for name, value in document.items() if name != SHORT}
    if "tasks" in document:
        return rest, [source.problem((SHORT, KEY), "'task' beside 'tasks'", "write one of them")]
    if isinstance(document[SHORT], list):
        return rest | {"tasks": document[SHORT]}, [source.problem((SHORT,), "should be one name, not a list", "write tasks: [...]")]
    return rest | {"tasks": [document[SHORT]]}, []
