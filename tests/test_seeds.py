import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from wasp_cli.seeds import derive, layout_seed, method_seed, operator_seed

PARTS = st.lists(
    st.one_of(
        st.none(), st.integers(), st.floats(allow_nan=False, allow_infinity=False), st.text()
    ),
    max_size=5,
)


def test_known_values_never_change():
    assert layout_seed("goal1", 0, 0) == 86649723
    assert operator_seed("goal1", "noisy", 0, 3) == 160405183


@given(PARTS)
def test_fits_31_bits_and_is_stable(parts):
    assert 0 <= derive(*parts) < 2**31
    assert derive(*parts) == derive(*parts)


def test_types_count_but_integer_width_does_not():
    assert len({derive(1), derive(1.0), derive("1"), derive(None)}) == 4
    assert derive(np.int64(7)) == derive(7)
    assert derive(np.float64(0.2)) == derive(0.2)


def test_parts_do_not_run_together():
    assert derive("ab", "c") != derive("a", "bc") != derive("abc")


def test_roles_differ_for_the_same_identity():
    methods = {method_seed("goal1", "noisy", 0, 3, name) for name in ("wasp", "ida")}
    assert len({layout_seed("goal1", 0, 3), operator_seed("goal1", "noisy", 0, 3)} | methods) == 4
