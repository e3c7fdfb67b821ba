"""The values of `--vary`: how they are read, and what is refused before anything runs."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from wasp_cli.errors import UsageError
from wasp_cli.spec.load import CELLS, read_sweep, values_of
from wasp_cli.spec.names import LONGEST, spec_name
from wasp_cli.spec.read import InvalidSpec

SPEC = """\
name: little
preset: smoke
tasks: [goal1, race1]
methods: [human, ida, wasp, expert]
variants: [full, safety-only]
operators:
  laggy: {moderate: 0.7}
seeds: [0]
"""

PRINTABLE = st.text(
    st.characters(
        min_codepoint=32, max_codepoint=0xD7FF, exclude_categories=["Cc", "Cs", "Zl", "Zp", "Cn"]
    ),
    max_size=12,
)
SCALARS = (
    st.none()
    | st.booleans()
    | st.integers(-(10**9), 10**9)
    | st.floats(allow_nan=False, allow_infinity=False)
    | PRINTABLE
)
VALUES = st.lists(
    SCALARS | st.lists(SCALARS, max_size=3),
    min_size=2,
    max_size=6,
    unique_by=lambda value: json.dumps(as_stored(value)),
)


def as_stored(value: Any) -> Any:
    """1e6 is a count to people; specs store whole numbers as such."""
    if isinstance(value, list):
        return [as_stored(each) for each in value]
    if isinstance(value, float) and value.is_integer() and abs(value) < 2**53:
        return int(value)
    return value


def single_quoted(value: Any) -> str:
    """YAML's other quotes, in which only the quote itself is doubled."""
    return (
        "'" + value.replace("'", "''") + "'"
        if isinstance(value, str)
        else json.dumps(value, ensure_ascii=False)
    )


@pytest.fixture
def spec(tmp_path) -> Path:
    path = tmp_path / "little.yaml"
    path.write_text(SPEC, encoding="utf-8")
    return path


@given(VALUES, st.sampled_from([",", " , ", ",  "]))
def test_any_list_of_values_is_read_as_it_was_written(values, comma):
    for write in (lambda value: json.dumps(value, ensure_ascii=False), single_quoted):
        options = values_of("wasp.x=" + comma.join(map(write, values)))
        assert [option.path for option in options] == [("wasp", "x")] * len(values)
        found = [option.value for option in options]
        assert json.dumps(found) == json.dumps(as_stored(values))


@pytest.mark.parametrize(
    ("vary", "message"),
    [
        ("diffusion.ratio", "is not of the form KEY=V1,V2,..."),
        ("diffusion.=1,2", "is not of the form KEY=V1,V2,..."),
        ("diffusion.ratio=0.2", "has one value"),
        ("diffusion.ratio=0.2,", "has an empty value"),
        ("diffusion.ratio=", "has an empty value"),
        ("diffusion.ratio=0.2,0.4,0.20", "the value 0.2 is listed twice"),
        ("expert.hidden=[64, 64],[64,64]", "the value [64, 64] is listed twice"),
        ("expert.hidden=[64, 64],[32", "is not YAML"),
        ("wasp.tau_c=*a,1", "is not YAML"),
        *((f"{name}=1,2", f"'{name}' decides which cells there are") for name in CELLS),
        ("operators.laggy.moderate=0.5,0.7", "'operators' decides which cells there are"),
    ],
)
def test_what_is_no_sweep_is_refused(vary, message):
    with pytest.raises(UsageError) as caught:
        values_of(vary)
    assert message in caught.value.message
    assert caught.value.hint or "YAML" in message or "finite" in message


def test_every_mistake_of_every_value_is_told_and_what_all_share_once(spec):
    spec.write_text(SPEC.replace("goal1", "gaol1"), encoding="utf-8")
    with pytest.raises(InvalidSpec) as caught:
        read_sweep(
            spec, "wasp.tau_c=0.5,-1,no", settings=["ida.vote=9", "ida-guarded.tau_c=calibrated"]
        )
    assert [
        (problem.source, problem.message.partition(",")[0]) for problem in caught.value.problems
    ] == [
        (str(spec), "unknown task 'gaol1'"),
        ("--set ida.vote=9", "ida.vote: should be less than or equal to 1"),
        ("--set ida-guarded.tau_c=calibrated", "ida-guarded.tau_c: should be a number or 'auto'"),
        ("--vary wasp.tau_c=-1", "wasp.tau_c: should be greater than 0 or 'calibrated' or 'auto'"),
        ("--vary wasp.tau_c=no", "wasp.tau_c: should be a number or 'calibrated' or 'auto'"),
    ]


@pytest.mark.parametrize(
    ("vary", "wanted", "expected"),
    [
        ("wasp.tau_c=0.3,1", (), ("human", "wasp")),
        ("diffusion.ratio=0.2,0.4", (), ("human", "diffusion")),  # though the spec does not list it
        # a stage, and not the reference row
        ("expert.gamma=0.9,0.99", (), ("human", "ida", "wasp", "expert")),
        ("action_repeat=2,4", (), ("human", "ida", "wasp", "expert")),
        ("wasp.tau_c=0.3,1", ("wasp", "ida"), ("ida", "wasp")),
    ],
)
def test_which_methods_run(spec, vary, wanted, expected):
    assert {point.loaded.spec.methods for point in read_sweep(spec, vary, wanted).points} == {
        expected
    }


def test_each_value_has_a_spec_and_a_name_of_its_own(spec):
    found = read_sweep(spec, " ida.vote = 0.5, 0.99 ", settings=["episodes=3", "ida.vote=0"])
    assert (found.name, found.spec, found.key) == ("little-sweep-ida.vote", "little", "ida.vote")
    assert [(point.text, point.value, point.loaded.spec.name) for point in found.points] == [
        ("0.5", 0.5, "little-ida.vote-0.5"),
        ("0.99", 0.99, "little-ida.vote-0.99"),
    ]
    for point in found.points:
        section: Any = point.loaded.spec.method("ida")
        assert (section.vote, point.loaded.spec.episodes, point.loaded.spec.tasks) == (
            point.value,
            3,
            ("goal1", "race1"),
        )


@given(
    st.from_regex(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}", fullmatch=True),
    st.lists(st.text(max_size=80), min_size=1, max_size=6),
)
def test_names_are_those_of_specs_and_differ(head, tails):
    taken: list[str] = []
    for tail in tails:
        taken.append(spec_name(head, tail, taken))
    assert len(set(taken)) == len(tails)
    assert all(
        re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", name) and len(name) <= LONGEST for name in taken
    )
