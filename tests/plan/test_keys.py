import json
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wasp_cli.plan import node as keys
from wasp_cli.plan.node import LENGTH, canonical, key_of, libraries, recipe_of

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**60), 2**60) | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=4),
    max_leaves=12,
)
IDENTITIES = st.dictionaries(st.text(max_size=6), VALUES, max_size=5)


def reordered(value: Any) -> Any:
    """The same content with the keys of every mapping in the opposite order."""
    if isinstance(value, dict):
        return {key: reordered(value[key]) for key in reversed(list(value))}
    return [reordered(item) for item in value] if isinstance(value, list) else value


@settings(max_examples=30)
@given(IDENTITIES)
def test_the_order_of_keys_and_a_detour_over_json_do_not_count(identity):
    key = key_of(identity)
    assert len(key) == LENGTH
    assert set(key) <= set("0123456789abcdef")
    assert key_of(reordered(identity)) == key
    assert key_of(json.loads(json.dumps(identity))) == key


@settings(max_examples=30)
@given(IDENTITIES, IDENTITIES)
def test_same_content_if_and_only_if_same_key(one, other):
    assert (canonical(one) == canonical(other)) == (key_of(one) == key_of(other))


def test_what_is_no_number_has_no_key():
    with pytest.raises(ValueError, match="JSON"):
        key_of({"tau": float("nan")})


def test_every_library_that_computes_is_in_the_key():
    assert set(libraries()) == {"mujoco", "numpy", "stable-baselines3", "torch"}
    assert "absent" not in libraries().values()


def test_a_key_covers_schema_and_libraries_and_a_recipe_the_schema_alone(monkeypatch):
    identity = {"kind": "expert"}
    key, recipe = key_of(identity), recipe_of(identity)
    with monkeypatch.context() as other:
        changed = libraries() | {"torch": "0.1"}
        other.setattr(keys, "libraries", lambda: changed)
        assert key_of(identity) != key
        assert recipe_of(identity) == recipe
    monkeypatch.setattr(keys, "SCHEMA", keys.SCHEMA + 1)
    assert key_of(identity) != key
    assert recipe_of(identity) != recipe
