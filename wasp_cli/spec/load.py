"""A spec from files and the command line: the files that it extends and the settings of options,
merged and validated.

Also specs that are made from another one: a part of it, an ablation of a method, and a sweep, which
is the same spec once for each value of a setting.
"""

from __future__ import annotations

import copy
import json
import os
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from wasp_cli.errors import UnknownName, UsageError
from wasp_cli.methods.registry import METHODS
from wasp_cli.registry import search_beside
from wasp_cli.spec.hints import Finding, accepts_in, findings, misplaced
from wasp_cli.spec.model import Spec, method_sections, validate
from wasp_cli.spec.names import EXTENDS, SHORT, assistant_variants, spec_name
from wasp_cli.spec.presets import PRESETS, merged
from wasp_cli.spec.read import (
    KEY,
    InvalidSpec,
    Loc,
    Place,
    Problem,
    Source,
    dotted,
    kind_of,
    meant,
    parse,
    read,
)
from wasp_cli.spec.shipped import spec_path
from wasp_cli.spec.sizes import BY_TASK, resized
from wasp_cli.tasks.registry import TASKS

USUAL = ("mild", "moderate", "severe")
SET = "--set"


@dataclass(frozen=True)
class Loaded:
    """A valid spec, with what it was read from."""

    spec: Spec
    chain: Chain
    overrides: tuple[Override, ...] = ()
    # whether a run of it has only some cells or episodes of the spec (--task, --method, --limit)
    restricted: bool = False
    # sizes that its files have for another preset than the one that counts, by their places
    replaced: Mapping[tuple[str, ...], Any] = field(default_factory=dict)

    def problem(self, loc: Loc, message: str, hint: str | None = None) -> InvalidSpec:
        """Return an error that points at a place of this spec, for mistakes that only later steps
        can find.
        """
        return InvalidSpec([_placed(self.chain, self.overrides, Finding(loc, message, hint))])


def load(path: Path, settings: Sequence[str] = ()) -> Loaded:
    """Read and validate a spec.

    Args:
        path: a file, or the name of a spec that comes with the package.
        settings: `a.b=value`, as `--set` takes them.

    Raises:
        InvalidSpec: with every problem, each with file, line and column.
        UsageError: a setting has another form.
    """
    overrides = tuple(override(number, text) for number, text in enumerate(settings, start=1))
    return loaded(chain_of(read(spec_path(path))), overrides)


def loaded(chain: Chain, overrides: Sequence[Override] = ()) -> Loaded:
    """Validate the files of a chain under some overrides.

    Raises:
        InvalidSpec: with every problem, each with file, line and column.
    """
    # The values of the files, then those of options. A preset in an option replaces their sizes.
    document, replaced, problems = chain.document(
        named=any(option.path == ("name",) for option in overrides)
    )
    presets = [option.value for option in overrides if option.path == (PRESET,)]
    if presets and isinstance(presets[-1], str):
        document, more = resized(document, presets[-1])
        replaced |= more
    document = apply(document, overrides)

    # Every mistake, at the place of its value. A place has one problem.
    places = {(problem.source, problem.position) for problem in problems}
    mistakes = misplaced(document)
    spec: Spec | None = None
    try:
        spec = validate(document)
    except ValidationError as error:
        # What is set in the wrong place has to go, whatever its value.
        wrong_places = [finding.loc[:-1] for finding in mistakes]
        for finding in findings(error, document, accepts=accepts_in(document)):
            if not any(finding.loc[: len(place)] == place for place in wrong_places):
                mistakes.append(finding)
    placed = [_placed(chain, overrides, finding) for finding in mistakes]
    problems += [
        problem
        for problem in placed
        if problem.position is None or (problem.source, problem.position) not in places
    ]
    if problems or spec is None:
        # Those of nearer files come first, and those of options last.
        names = [source.name for source in chain.sources]
        raise InvalidSpec(
            sorted(problems, key=lambda problem: (*names, problem.source).index(problem.source))
        )

    # A setting that an option sets itself was not replaced by the preset.
    replaced = {place: value for place, value in replaced.items() if not _is_set(place, overrides)}
    return Loaded(spec, chain, tuple(overrides), replaced=replaced)


def _is_set(place: tuple[str, ...], overrides: Sequence[Override]) -> bool:
    of_all = place[2:] if place[0] == BY_TASK else place
    return any(
        option.path in (whole[: len(option.path)] for whole in (place, of_all))
        for option in overrides
    )


def _placed(chain: Chain, overrides: Sequence[Override], finding: Finding) -> Problem:
    """The problem where its value was written: in an option, or in one of the files."""
    loc = tuple(part for part in finding.loc if part != KEY)
    # The file that has most of the path, and of several the nearest: its value is in force.
    source = max(chain.sources, key=lambda source: source.depth(finding.loc))
    depth = source.depth(finding.loc)

    # Options that set a value at the place, above it or below it, the last one first; unless a file
    # has more of the path.
    near: list[Override] = []
    for option in reversed(overrides):
        shared = min(len(option.path), len(loc))
        if _path(loc[:shared]) == option.path[:shared] and shared >= min(depth, len(option.path)):
            near.append(option)
    words = re.findall(r"\w+", finding.message)
    # If an option sets a field below the place, blame it only if the message names that field.
    blamed = [
        option for option in near if len(option.path) <= len(loc) or option.path[len(loc)] in words
    ]
    if not blamed and depth < len(loc):
        blamed = near
    for option in blamed[:1]:
        message = f"{dotted(loc)}: {finding.message}" if loc else finding.message
        hint = finding.hint
        if finding.written is not None and option.option == SET and _path(loc) == option.path:
            hint = f"write {SET} {shlex.quote(f'{dotted(loc)}={finding.written}')}"
        return Problem(f"{option.option} {option.text}", None, message, hint)
    return source.problem(finding.loc, finding.message, finding.hint, at_key=finding.at_key)


def _path(loc: Loc) -> tuple[str, ...]:
    return tuple(map(str, loc))


PRESET = "preset"
LONGEST_CHAIN = 8
SUFFIX = ".yaml"


@dataclass(frozen=True)
class Chain:
    """A spec file and those that it extends."""

    sources: tuple[Source, ...]

    @property
    def text(self) -> str:
        """The text of all files: a single one as it is; of several, each is a YAML document below a
        comment with its name.
        """
        if len(self.sources) == 1:
            return self.sources[0].text
        return "".join(f"---\n# {source.name}\n{source.text.rstrip()}\n" for source in self.sources)

    def document(
        self, *, named: bool = False
    ) -> tuple[dict[str, Any], dict[tuple[str, ...], Any], list[Problem]]:
        """Return the values of all files, nearer ones over farther ones; the sizes that a nearer
        preset has replaced; and the problems of the files.

        Args:
            named: whether an option sets the name, which otherwise the first file has to set.
        """
        values: dict[str, Any] = {}
        replaced: dict[tuple[str, ...], Any] = {}
        problems: list[Problem] = []
        for source in reversed(self.sources):
            problems += source.problems
            preset = source.document.get(PRESET)
            if values and isinstance(preset, str):
                values, more = resized(values, preset)
                replaced |= more
            values = merged(
                values,
                {name: value for name, value in source.document.items() if name != EXTENDS},
                removes=True,
            )

        # Severities with the usual names in their order: merged, those of farther files come first.
        operators = values.get("operators")
        if len(self.sources) > 1 and isinstance(operators, dict):
            for variant, severities in operators.items():
                if isinstance(severities, dict) and set(severities) <= {*USUAL}:
                    operators[variant] = {
                        name: severities[name] for name in USUAL if name in severities
                    }

        nearest = self.sources[0]
        if len(self.sources) > 1 and not named and "name" not in nearest.document:
            hint = "every spec needs its own name: its reports are stored under it"
            problems.append(nearest.problem((EXTENDS, KEY), "missing key 'name'", hint))
        return values, replaced, problems


def chain_of(source: Source) -> Chain:
    """Return a source with all files that it extends: each lies beside the file that names it, or
    comes with the package. Modules that they name may lie beside any of them.

    Raises:
        InvalidSpec: a file is missing or extends itself, or there are more than LONGEST_CHAIN.
    """
    sources = [_with_list(source)]
    while EXTENDS in sources[-1].document:
        last = sources[-1]
        value = last.document[EXTENDS]
        if value is None and last.problems:  # it is a value that JSON does not have
            raise InvalidSpec(last.problems)
        if not _is_spec_name(value):
            shown = repr(value) if isinstance(value, str) else kind_of(value)
            message = f"should be the name of a spec or of a {SUFFIX} file, not {shown}"
            raise InvalidSpec([last.problem((EXTENDS,), message)])

        # The file that is named, unless it is missing or would make the chain endless.
        path = spec_path(Path(value), Path(last.name).parent)
        files = [os.path.realpath(before.name) for before in sources]
        message = ""
        hint = None
        if os.path.realpath(path) in files:
            first = files.index(os.path.realpath(path))
            circle = [*(before.name for before in sources[first:]), str(path)]
            message = f"extends itself: {' -> '.join(circle)}"
        elif len(sources) == LONGEST_CHAIN:
            message = f"a chain of more than {LONGEST_CHAIN} files"
            hint = "write what they share into one of them"
        elif not os.path.exists(path):
            message = f"no such file: '{path}'"
            hint = meant(path)
        if message:
            raise InvalidSpec([last.problem((EXTENDS,), message, hint)])
        sources.append(_with_list(read(path)))
    search_beside(Path(each.name).parent for each in sources)
    return Chain(tuple(sources))


def _is_spec_name(value: Any) -> bool:
    """Whether a value can be the name of a spec or of its file."""
    if not isinstance(value, str) or not value.isprintable():
        return False
    path = Path(value)
    return bool(path.name) and path.suffix in ("", SUFFIX)


def _with_list(source: Source) -> Source:
    """A source with `task: x` written as `tasks: [x]`."""
    if SHORT not in source.document:
        return source
    document = dict(source.document)
    places = dict(source.places)
    problems = list(source.problems)
    name = document.pop(SHORT)
    place = places[SHORT,]
    if "tasks" in document:
        problems.append(
            source.problem((SHORT, KEY), "both 'task' and 'tasks' are given", "write one of them")
        )
    else:
        if isinstance(name, list):
            problems.append(
                source.problem((SHORT,), "should be one name, not a list", "write tasks: [...]")
            )
        document["tasks"] = name if isinstance(name, list) else [name]
        below = [loc for loc in places if loc[:1] == (SHORT,) and len(loc) > 1]
        places |= {("tasks", 0, *loc[1:]): places[loc] for loc in below}
        places |= {("tasks",): place, ("tasks", 0): Place(place.value, place.value)}
    return replace(source, document=document, places=places, problems=problems)


@dataclass(frozen=True)
class Override:
    """A value that an option sets."""

    text: str
    path: tuple[str, ...]
    value: Any
    option: str = SET  # the option that brought it, for messages


def override(number: int, text: str) -> Override:
    """Read a setting `a.b=value`. The value is YAML, so that lists, numbers and null keep their
    types.

    Args:
        number: of the option, for messages.

    Raises:
        UsageError: it has another form.
    """
    place = f"--set #{number}"
    key, equals, value = text.partition("=")
    path = path_of(key)
    if not equals or not all(path):
        example = "for example --set wasp.candidates=64 or --set 'seeds=[0, 1]'"
        raise UsageError(f"{place}: '{text}' is not of the form key=value", example)
    parsed = value_of(value, text, place)
    if path == ("task",):  # the short form, as in a file
        tasks = parsed if isinstance(parsed, list) else [parsed]
        return Override(text, ("tasks",), tasks)
    return Override(text, path, parsed)


def path_of(key: str) -> tuple[str, ...]:
    """Return the names in `a.b`. One of them is empty if the key is malformed."""
    return tuple(part.strip() for part in key.split("."))


def value_of(value: str, text: str, place: str) -> Any:
    """Return the value of an option, read as YAML.

    Args:
        value: the text of the value.
        text: of the whole option, for messages.
        place: which option it is, for messages.

    Raises:
        UsageError: it is not YAML, or is more than one value.
    """
    try:
        source = parse(f"value: {value.strip()}", text)
    except InvalidSpec as error:
        raise UsageError(
            f"{place}: the value of '{text}' is not YAML: {error.problems[0].message}"
        ) from error
    if source.problems or set(source.document) != {"value"}:
        reason = source.problems[0].message if source.problems else "more than one value"
        raise UsageError(f"{place}: '{text}': {reason}")
    return source.document["value"]


def apply(document: dict[str, Any], overrides: Sequence[Override]) -> dict[str, Any]:
    """Return a document with the values of options in it. An option counts for every task, so that
    settings which single tasks have at its place are removed.
    """
    result = copy.deepcopy(document)
    for option in overrides:
        # Sections on the way to the value are made where there are none.
        node = result
        for part in option.path[:-1]:
            if not isinstance(node.get(part), dict):
                node[part] = {}
            node = node[part]
        node[option.path[-1]] = option.value

        tasks = result.get("by_task")
        if isinstance(tasks, dict):
            for own in tasks.values():
                _forget(own, option.path)
    return result


def _forget(document: Any, path: tuple[str, ...]) -> None:
    """Remove the value at a path, if there is one."""
    for part in path[:-1]:
        if not isinstance(document, dict):
            return
        document = document.get(part)
    if isinstance(document, dict):
        document.pop(path[-1], None)


WHOLE = "full"  # the variant without an ablation
AS_PRINTED = "as-printed"  # the name of `printed` in `wasp ablate`: the paper's WASP, a method


def sized(preset: str | None, settings: Sequence[str] | None = None) -> list[str]:
    """Return settings, with one for a preset before them if it is given.

    Raises:
        UnknownName: there is no such preset.
    """
    if preset is not None and preset not in PRESETS:
        raise UnknownName("preset", preset, PRESETS)
    if preset is None:
        return list(settings or ())
    return [f"preset={preset}", *(settings or ())]


def restricted(
    loaded: Loaded, tasks: Sequence[str] | None, methods: Sequence[str] | None = None
) -> Loaded:
    """Return the spec with only some of its tasks and methods, in its own order. Without any names
    it has all of them.

    Raises:
        UnknownName: the spec has no such task or method.
    """
    update: dict[str, tuple[str, ...]] = {}
    for what, chosen, listed in (
        ("task", tasks, loaded.spec.tasks),
        ("method", methods, loaded.spec.methods),
    ):
        for name in chosen or ():
            if name not in listed:
                raise UnknownName(f"{what} of this spec", name, listed)
        if chosen:
            update[f"{what}s"] = tuple(name for name in listed if name in chosen)
    if not update:
        return loaded
    spec = loaded.spec.model_copy(update=update)
    return replace(loaded, spec=spec, restricted=spec != loaded.spec)


def with_episodes(spec: Spec, episodes: int) -> Spec:
    """Return a spec with this number of episodes for each cell."""
    evaluate = spec.stage("evaluate").model_copy(update={"episodes": episodes})
    return spec.model_copy(update={"episodes": episodes, "evaluate": evaluate})


def limited(loaded: Loaded, episodes: int | None) -> Loaded:
    """Return a spec with at most this number of episodes for each cell; None: all of them."""
    if episodes is None:
        return loaded
    spec = with_episodes(loaded.spec, min(episodes, loaded.spec.episodes))
    return replace(loaded, spec=spec, restricted=loaded.restricted or spec != loaded.spec)


def ablation(
    path: Path,
    variant: str,
    tasks: Sequence[str] | None = None,
    preset: str | None = None,
    settings: Sequence[str] = (),
) -> Loaded:
    """Return the spec of `wasp ablate`: a method and one of its ablations, beside the operators
    alone.

    Raises:
        UnknownName: there is no such ablation.
        InvalidSpec: as `load`.
    """
    known = [*assistant_variants(), AS_PRINTED]
    if variant not in known:
        raise UnknownName("assistant variant", variant, known)
    if variant == AS_PRINTED:
        narrowed = ["methods=[human, wasp, printed]", f"variants=[{WHOLE}]"]
    else:
        # The first method with ablations that has this one.
        method = next(
            info.name
            for info in METHODS.values()
            if variant in info.variants and len(info.variants) > 1
        )
        narrowed = [
            f"methods=[human, {method}]",
            f"variants=[{', '.join(dict.fromkeys((WHOLE, variant)))}]",
        ]
    if tasks:
        narrowed.append(f"tasks=[{', '.join(TASKS[task].name for task in tasks)}]")
    whole = load(path, [*narrowed, *sized(preset, settings)])
    named = whole.spec.model_copy(update={"name": spec_name(whole.spec.name, f"ablate-{variant}")})
    return replace(whole, spec=named, restricted=bool(tasks))


OPTION = "--vary"
EXAMPLE = "for example --vary diffusion.ratio=0.2,0.4,0.6"
# runs beside the method whose setting varies, as the reference of its differences
UNIMPAIRED_REFERENCE = "human"
CELLS = {
    "name": "a sweep names its own reports",
    "task": "name one with --task; without it every task of the spec has its rows",
    "tasks": "name one with --task; without it every task of the spec has its rows",
    "methods": "name them with --method; every method has its rows",
    "seeds": "list them in the spec: a row is the mean over all seeds",
    "operators": "list the severities in the spec: the table per operator has rows for each",
    "variants": "list them in the spec: each has its rows",
}
"""Settings that decide which cells there are, and what to do instead of varying them."""


@dataclass(frozen=True)
class Point:
    """One value of a sweep."""

    text: str
    value: Any
    loaded: Loaded  # the spec with it, under a name of its own


@dataclass(frozen=True)
class Sweep:
    """A spec under several values of one setting."""

    name: str  # of the reports
    spec: str  # the name of the spec without any of the values
    key: str
    points: tuple[Point, ...]


def read_sweep(
    path: Path,
    vary: str,
    methods: Sequence[str] = (),
    settings: Sequence[str] = (),
    tasks: Sequence[str] | None = None,
) -> Sweep:
    """Read and validate a spec under every value of a setting.

    Args:
        path: a file, or the name of a spec that comes with the package.
        vary: `KEY=V1,V2,...`.
        methods: to run. Without any, the setting of a method runs this method and Human-only, and
            any other setting all that the spec lists.
        settings: `a.b=value`, as `--set` takes them.
        tasks: to run; None: all of the spec.

    Raises:
        InvalidSpec: with the problems of all values, each once.
        UsageError: as `values_of`.
    """
    options = values_of(vary)
    overrides = [override(number, text) for number, text in enumerate(settings, start=1)]
    chain = chain_of(read(spec_path(path)))
    specs: list[Loaded] = []
    problems: dict[Problem, None] = {}  # a problem of several values is reported once
    for option in options:
        try:
            specs.append(loaded(chain, (*overrides, option)))
        except InvalidSpec as error:
            problems |= dict.fromkeys(error.problems)
    if problems:
        raise InvalidSpec(list(problems))
    key = ".".join(options[0].path)
    name = specs[0].spec.name
    points: list[Point] = []
    for option, valid in zip(options, specs, strict=True):
        text = shown(option.value)
        earlier = [point.loaded.spec.name for point in points]
        # The copy is not validated: it keeps `variants` that are listed for other methods.
        update: dict[str, Any] = {"name": spec_name(name, f"{key}-{text}", earlier)}
        if not methods and options[0].path[0] in method_sections():
            update["methods"] = tuple(dict.fromkeys((UNIMPAIRED_REFERENCE, options[0].path[0])))
        named = replace(valid, spec=valid.spec.model_copy(update=update))
        points.append(Point(text, option.value, restricted(named, tasks, methods)))
    return Sweep(spec_name(name, f"sweep-{key}"), name, key, tuple(points))


def values_of(vary: str) -> list[Override]:
    """Return the values of `--vary KEY=V1,V2,...`, each as an override.

    Raises:
        UsageError: it has another form, fewer than two values or one twice, or its key decides
            which cells there are.
    """
    key, equals, rest = vary.partition("=")
    path = path_of(key)
    if not equals or not all(path):
        raise UsageError(f"{OPTION}: '{vary}' is not of the form KEY=V1,V2,...", EXAMPLE)
    if path[0] in CELLS:
        raise UsageError(
            f"{OPTION}: '{path[0]}' decides which cells there are; a sweep compares the same ones",
            CELLS[path[0]],
        )
    name = ".".join(path)
    values = value_of(f"[{rest}]", rest, OPTION)
    if not values or rest.rstrip().endswith(","):
        raise UsageError(f"{OPTION}: '{rest}' has an empty value", "write null for no value")
    if len(values) < 2:
        raise UsageError(
            f"{OPTION}: '{vary}' has one value; a sweep compares at least two", EXAMPLE
        )
    # Compared as JSON, since 1 and true are equal in Python.
    texts = [json.dumps(value, sort_keys=True) for value in values]
    for place, text in enumerate(texts):
        if text in texts[:place]:
            raise UsageError(f"{OPTION}: the value {text} is listed twice", "write each value once")
    return [Override(f"{name}={shown(value)}", path, value, OPTION) for value in values]


def shown(value: Any) -> str:
    """Return a value as `--set` takes it."""
    if isinstance(value, str) and value.isprintable():
        return value
    return json.dumps(value)
