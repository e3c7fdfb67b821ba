"""The words of a label, as people write them: in any order, in capitals or not, with commas or
without.

    words = read_words("WASP, Goal1, seed 1, laggy=0.7", known, layout.root)
    words.tasks, words.methods, words.seeds         {"goal1"}, {"wasp"}, {1}
    words.fit_assistant("goal1", "wasp", "full")    True

Both labels of a cell read so, that of a run (`goal1 s1 wasp laggy=0.7`) and that of a report
(`goal1 wasp laggy=0.7 seed 1`). What is left out may be anything.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from wasp_cli.errors import UnknownName, UsageError
from wasp_cli.methods.registry import METHODS
from wasp_cli.metrics.severity import AUTO
from wasp_cli.operators.registry import OPERATORS, UNIMPAIRED
from wasp_cli.plan.node import driver_label
from wasp_cli.tasks.registry import TASKS

WHOLE = "full"
"""The variant of a method without ablation."""

_SEED = re.compile(r"(?:s|seed|training)=?(\d{1,18})", re.IGNORECASE)
_EXAMPLE = (
    "its words are those of a label, such as 'goal1 s1 wasp laggy=0.7'; or give the beginning of a "
    "key"
)

Thing = TypeVar("Thing")


@dataclass(frozen=True)
class KnownWords:
    """The names that words may be, beside those of what is installed: a folder may have a task or
    a method of somebody else.
    """

    tasks: Collection[str] = ()
    methods: Collection[str] = ()
    operators: Collection[str] = ()
    settings: Collection[str] = ()  # of methods: `tau_c`
    kinds: Collection[str] = ()  # of nodes: `dataset`


@dataclass
class Words:
    """The conditions that words make. One that is empty holds of everything."""

    tasks: set[str] = field(default_factory=set)
    methods: set[str] = field(default_factory=set)
    variants: set[str] = field(default_factory=set)
    seeds: set[int] = field(default_factory=set)
    # operators, each with its severity; None: with any
    operators: set[tuple[str, float | None]] = field(default_factory=set)
    settings: dict[str, str] = field(default_factory=dict)
    kinds: set[str] = field(default_factory=set)

    def fit_assistant(self, task: str, method: str | None, variant: str | None) -> bool:
        """Return whether task, method and ablation are asked for; a method of None is that of a
        node without assistant.
        """
        return (
            fits(task, self.tasks) and fits(method, self.methods) and fits(variant, self.variants)
        )

    def fit_operator(self, operator: str | None, value: float | None) -> bool:
        """Return whether an operator with a severity is asked for. Severities are compared with as
        many digits as a label has.
        """
        if not self.operators:
            return True
        for name, severity in self.operators:
            if name == operator and (severity is None or _same_number(value, severity)):
                return True
        return False

    def fit_settings(self, settings: Mapping[str, Any]) -> bool:
        """Return whether the settings of a method have the values that are asked for."""
        return all(_same_setting(settings.get(name), text) for name, text in self.settings.items())

    def whole_first(self, meant: list[Thing], variants: Iterable[str | None]) -> list[Thing]:
        """Return of things that fit those that are meant: the name of a method alone is the whole
        method, unless only ablations of it are there.

        Args:
            meant: those that fit.
            variants: of each, its ablation.
        """
        if not self.methods or self.variants:
            return meant
        whole = [thing for thing, variant in zip(meant, variants, strict=True) if variant == WHOLE]
        return whole or meant


def read_words(text: str, known: KnownWords, where: Path) -> Words:
    """Read the words of a label.

    Args:
        text: task, seed (`s1`, `seed=1`, `seed 1`), method with its ablation (`wasp/no-case2`),
            operator with its severity (`laggy=0.7`), settings of the method (`tau_c=0.5`). Names
            may have what they are before them (`task=goal1`), and tasks their title or gymnasium
            id in their place.
        known: what words may be beside the names of what is installed.
        where: the folder in which is looked, for errors.

    Raises:
        UnknownName: a word is none of them.
        UsageError: the severity of an operator is no number.
    """
    tasks = _by_name({*known.tasks, *TASKS}, TASKS)
    methods = _by_name({*known.methods, *METHODS}, METHODS)
    operators = _by_name({*known.operators, *OPERATORS, UNIMPAIRED}, OPERATORS)
    operators[driver_label(UNIMPAIRED, None)] = UNIMPAIRED  # as labels call it

    words = Words()
    pending = text.replace(",", " ").split()
    while pending:
        word = pending.pop(0)
        small = word.casefold()
        name, equals, value = word.partition("=")
        method, _, variant = word.removeprefix("method=").partition("/")
        seed = _SEED.fullmatch(word)

        # Words that say themselves what they are.
        if small in ("seed", "training") and pending and _SEED.fullmatch(f"s{pending[0]}"):
            words.seeds.add(int(pending.pop(0)))
        elif seed is not None:
            words.seeds.add(int(seed[1]))
        elif name == "variant" and equals:
            words.variants.add(value)
        elif name in known.settings and equals:
            words.settings[name] = value

        # Names, of which that of a task may have a slash too.
        elif word in known.kinds:
            words.kinds.add(word)
        elif small.removeprefix("task=") in tasks:
            words.tasks.add(tasks[small.removeprefix("task=")])
        elif small.removeprefix("operator=") in operators:
            words.operators.add((operators[small.removeprefix("operator=")], None))
        elif name.casefold() in operators:
            words.operators.add((operators[name.casefold()], _severity(value)))
        elif method.casefold() in methods:
            words.methods.add(methods[method.casefold()])
            if variant:
                words.variants.add(variant)
        else:
            names = {*tasks.values(), *methods.values(), *operators.values(), *known.settings}
            raise UnknownName(
                "word of a label",
                word,
                names,
                f"'{text}' means nothing in '{where}': '{word}' is no task, seed, method, operator "
                "or setting there",
                _EXAMPLE,
            )
    return words


def _by_name(names: Iterable[str], registry: Mapping[str, Any]) -> dict[str, str]:
    """Names, titles and gymnasium ids, in small letters, with the name that each stands for. A
    title of several words is not among them.
    """
    every = sorted(names)
    found = {name.casefold(): name for name in every}
    for name in every:
        others = [name.rpartition(":")[2]]
        if name in registry:
            others += [registry[name].title, getattr(registry[name], "gym_id", "")]
        for other in others:
            if other and " " not in other:
                found.setdefault(other.casefold(), name)
    return found


def _severity(text: str) -> float | None:
    """The number; None of `auto`, since at most one severity of an operator is chosen."""
    if text.casefold() == AUTO:
        return None
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise UsageError(f"'{text}' is no severity of an operator", "it is a number")
    return number


def fits(value: object, wanted: Collection[object]) -> bool:
    """Return whether a value is one of those that are asked for, or nothing is. It may be anything
    that a manifest holds, also what has no hash.
    """
    return not wanted or any(value == one for one in wanted)


def _same_number(value: float | None, severity: float) -> bool:
    return value is not None and f"{value:g}" == f"{severity:g}"


def _same_setting(value: Any, text: str) -> bool:
    """Whether a setting has the value that was written."""
    try:
        return float(value) == float(text)
    except (OverflowError, TypeError, ValueError):
        return str(value).casefold() == text.casefold()
