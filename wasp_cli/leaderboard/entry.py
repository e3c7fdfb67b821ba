"""What of a spec is submitted: one assistant of your own with its settings. All else is the
board's, and a spec that says otherwise is refused at the line that does.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from wasp_cli.config import Config
from wasp_cli.errors import UnknownName
from wasp_cli.leaderboard.board import DEVELOPMENT, TRAINED, Board
from wasp_cli.methods.registry import METHODS
from wasp_cli.spec.load import Chain, Loaded, apply, loaded
from wasp_cli.spec.model import Spec
from wasp_cli.spec.read import KEY, InvalidSpec, Loc, dotted, parse
from wasp_cli.stages.registry import STAGES

SHARED = (
    "preset",
    "training_seed",
    "episodes",
    "side_by_side",
    "action_repeat",
    "returns",
    "operating_points",
)
"""Fields of a spec that are the board's."""
ELSEWHERE = ("clone", "counterfactual", "diagnostics", "operating", "severity")
"""Stages of ours that no cell of a submission reads: what a spec says of them does not matter."""
OF_SPEC = ("extends", "name", "methods", "by_task")
"""What the spec of a submission has beside sections of its own."""


@dataclass(frozen=True)
class Entry:
    """An assistant that may be submitted."""

    method: str
    text: str  # the spec that is evaluated and kept: it extends the board
    loaded: Loaded  # the same, validated: all cells of the board for this assistant alone


def entry_of(asked: Loaded, board: Board, method: str | None = None) -> Entry:
    """Return what of a spec is submitted.

    Args:
        asked: the spec as its author wrote it. Of the board's tasks, operators and seeds it may
            name a part: a submission is evaluated in all.
        board: what it is submitted to.
        method: which assistant, where the spec lists several of your own.

    Raises:
        InvalidSpec: the spec has no assistant of your own, or several; or it changes what is the
            board's. Each problem has its place.
        UnknownName: the spec has no assistant of this name.
    """
    chosen = _own_method(asked, method)
    problems = [
        asked.problem(loc, message, hint).problems[0]
        for loc, message, hint in _changes(asked.spec, board)
    ]
    if problems:
        raise InvalidSpec(problems)
    document = apply(asked.chain.document(named=True)[0], asked.overrides)
    text = _written(asked.spec.name, board.spec.name, chosen, document)
    return entry_from(text, f"the submission of {asked.spec.name}", board)


def entry_from(text: str, name: str, board: Board) -> Entry:
    """Return the entry whose spec reads so; the assistant's module is imported.

    Args:
        text: the spec of a submission.
        name: what messages call it.
        board: what it extends, whatever it calls it.

    Raises:
        InvalidSpec: the spec is invalid, or has more than a submission may say.
    """
    source = parse(text, name)
    methods = source.document.get("methods")
    if not isinstance(methods, list) or len(methods) != 1 or not isinstance(methods[0], str):
        raise InvalidSpec([source.problem(("methods",), "a submission has one assistant")])
    problems = list(_strangers(source.document, methods[0]))
    if problems:
        raise InvalidSpec([source.problem(*problem, at_key=True) for problem in problems])
    source.document.pop("extends", None)
    source.document.update(variants=["full"], stages=[])
    found = loaded(Chain((source, *board.loaded.chain.sources)))
    return Entry(methods[0], text, found)


def _strangers(document: Mapping[str, Any], method: str) -> Iterator[tuple[Loc, str, str]]:
    """Yield the place of every section that is not the assistant's own, and why it is refused."""
    own = {method, *_own_stages()}
    hint = "a submission has the settings of its assistant and of stages of its own"
    for name in document:
        if name not in own and name not in OF_SPEC:
            yield (name,), f"'{name}' is the board's", hint
    by_task = document.get("by_task")
    for task, sections in by_task.items() if isinstance(by_task, dict) else ():
        for name in sections if isinstance(sections, dict) else ():
            if name not in own:
                yield ("by_task", task, name), f"'{name}' is the board's", hint


def _own_stages() -> set[str]:
    return set(STAGES) - set(STAGES.own)


def _own_method(asked: Loaded, method: str | None) -> str:
    """Return the one assistant of a spec that is submitted."""
    own = [name for name in asked.spec.methods if name not in METHODS.own]
    if not own:
        raise asked.problem(
            ("methods",),
            "no assistant of your own is listed, and the shipped ones are on the board",
            'add the class of a file beside the spec, as in methods: ["halfway:Halfway"]',
        )
    if method is not None:
        if method not in own:
            raise UnknownName("assistant of your own in this spec", method, own)
        return method
    if len(own) > 1:
        place = asked.spec.methods.index(own[1])
        message = f"{len(own)} assistants of your own are listed, and a submission has one"
        raise asked.problem(("methods", place), message, "choose it with --method NAME")
    return own[0]


def _changes(spec: Spec, board: Board) -> Iterator[tuple[Loc, str, str | None]]:
    """Yield what a spec has otherwise than the board: the place, a message and a hint."""
    yield from _other_tasks(spec, board.spec)
    yield from _other_operators(spec, board.spec)
    yield from _other_seeds(spec, board.spec)
    yield from _other_settings(spec, board.spec)


def _other_tasks(spec: Spec, board: Spec) -> Iterator[tuple[Loc, str, str | None]]:
    hint = f"the board has {', '.join(board.tasks)}: only their models are published"
    for place, task in enumerate(spec.tasks):
        if task not in board.tasks:
            yield ("tasks", place), f"'{task}' is no task of the board", hint


def _other_operators(spec: Spec, board: Spec) -> Iterator[tuple[Loc, str, str | None]]:
    for operator, severities in spec.operators.items():
        known = board.operators.get(operator)
        if known is None:
            hint = f"the board has {', '.join(board.operators)}"
            yield ("operators", operator, KEY), f"'{operator}' is no operator of the board", hint
            continue
        values = ", ".join(f"{value:g}" for value in known.values())
        for severity, value in severities.items():
            if value not in known.values():
                message = f"the board's severity of '{operator}' is {values}, not {value}"
                yield ("operators", operator, severity), message, "leave the line out"


def _other_seeds(spec: Spec, board: Spec) -> Iterator[tuple[Loc, str, str | None]]:
    listed = ", ".join(map(str, board.seeds))
    hint = f"write seeds: [{listed}], or leave the line out"
    for place, seed in enumerate(spec.seeds):
        if seed in board.seeds:
            continue
        if seed >= DEVELOPMENT:
            said = f"seed {seed} is for development: a submission is evaluated on {listed}"
        elif seed in TRAINED:
            said = f"seed {seed} was trained on: a submission is evaluated on {listed}"
        else:
            said = f"seed {seed} is none of the board's"
        yield ("seeds", place), said, hint


def _other_settings(spec: Spec, board: Spec) -> Iterator[tuple[Loc, str, str | None]]:
    stages = [kind for kind in STAGES.own if kind not in ELSEWHERE]
    for name in (*SHARED, *stages):
        for loc, here, there in _differences(getattr(spec, name), getattr(board, name), (name,)):
            if loc == ("evaluate", "episodes"):  # said of `episodes`
                continue
            yield loc, f"{dotted(loc)} is {there} on the board, not {here}", "leave the line out"
    for task in board.tasks:
        for kind in stages:
            mine = spec.by_task.get(task, {}).get(kind, {})
            boards = board.by_task.get(task, {}).get(kind, {})
            for loc, here, there in _differences(mine, boards, ("by_task", task, kind)):
                yield (
                    loc,
                    f"{dotted(loc)} is {there} on the board, not {here}",
                    "leave the line out",
                )


def _differences(here: Any, there: Any, loc: Loc) -> Iterator[tuple[Loc, str, str]]:
    """Yield the place of every value that differs, and how both read."""
    one = here.model_dump(mode="json") if isinstance(here, Config) else here
    other = there.model_dump(mode="json") if isinstance(there, Config) else there
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        for name in dict.fromkeys([*one, *other]):
            yield from _differences(one.get(name), other.get(name), (*loc, name))
    elif one != other:
        yield loc, json.dumps(one), json.dumps(other)


def _written(name: str, board: str, method: str, document: Mapping[str, Any]) -> str:
    """Write the spec of a submission: YAML that `wasp run` takes too."""
    own = [method, *sorted(_own_stages())]
    lines = [
        f"extends: {board}",
        f"name: {json.dumps(name)}",
        f"methods: [{json.dumps(method)}]",
    ]
    lines += [f"{each}: {json.dumps(document[each])}" for each in own if document.get(each)]
    by_task: dict[str, dict[str, Any]] = {}
    written = document.get("by_task")
    for task, sections in written.items() if isinstance(written, Mapping) else ():
        kept = {each: sections[each] for each in own if each in sections}
        if kept:
            by_task[task] = kept
    if by_task:
        lines.append(f"by_task: {json.dumps(by_task)}")
    return "\n".join(lines) + "\n"
