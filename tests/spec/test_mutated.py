"""Any text at all is a spec or a refusal with places; never another exception."""

from __future__ import annotations

from pathlib import Path

from hypothesis import given, settings
from hypothesis import strategies as st

from wasp_cli.spec.extend import chain_of
from wasp_cli.spec.load import loaded
from wasp_cli.spec.model import Spec
from wasp_cli.spec.problem import InvalidSpec
from wasp_cli.spec.read import parse

SPECS = [path.read_text(encoding="utf-8") for path in sorted((Path(__file__).parents[2] / "specs").glob("*.yaml"))]
SNIPPETS = [
    "{", "}", "[", "]", ":", ": ", "- ", "#", "&a ", "*a", "<<: *a", "!!x ", "'", '"', "|", ">", "\n", "\n  ", "\t", "~", "null", "true",
    "1e999", ".nan", "-1", "0.5", "0x1f", "2020-01-01", "goal1", "wasp", "noisy", "? ", "%", "@", "\x00", "é", "\N{BOM}", "---\n", "...",
]  # fmt: skip


@st.composite
def mutated(draw: st.DrawFn) -> str:
    text = draw(st.sampled_from(SPECS))
    for _ in range(draw(st.integers(1, 4))):
        start = draw(st.integers(0, len(text)))
        end = min(len(text), start + draw(st.integers(0, 12)))
        text = text[:start] + draw(st.sampled_from(SNIPPETS) | st.text(max_size=4)) + text[end:]
    return text


@st.composite
def shuffled_lines(draw: st.DrawFn) -> str:
    lines = draw(st.sampled_from(SPECS)).splitlines()
    chosen = draw(st.lists(st.sampled_from(lines), max_size=len(lines)))
    return "\n".join(("  " * draw(st.integers(0, 2))) + line for line in chosen)


def read(text: str) -> Spec | InvalidSpec:
    try:
        return loaded(chain_of(parse(text, "x.yaml"))).spec
    except InvalidSpec as error:
        return error


@settings(max_examples=200, deadline=None)
@given(st.one_of(mutated(), shuffled_lines(), st.text(max_size=60)))
def test_mutated_specs_are_specs_or_refusals_with_places(text: str) -> None:
    result = read(text)
    if isinstance(result, InvalidSpec):
        assert result.problems
        lines = text.splitlines() or [""]
        for problem in result.problems:
            assert problem.position is not None
            assert 1 <= problem.position.line <= len(lines) + 1
            assert problem.position.column >= 1
            assert str(problem).startswith("x.yaml:")
