"""What of a configuration enters a key."""

from __future__ import annotations

from wasp_cli.config import OPTIONAL, Config, assumed
from wasp_cli.learning.configs.recorded import Bars, ExpertConfig


class Inner(Config):
    size: int = assumed(3, "a size")
    later: int = assumed(0, "came later", in_key=OPTIONAL)


class Outer(Config):
    inner: Inner = Inner()
    every: int = assumed(5, "moves no result", in_key=False)
    bars: dict[str, int] = assumed({}, "came later", in_key=OPTIONAL)


def test_an_optional_field_enters_the_identity_only_where_it_is_not_its_default() -> None:
    assert Outer().identity() == {"inner": {"size": 3}}
    changed = Outer(inner=Inner(later=1), bars={"goal1": 2})
    assert changed.identity() == {"inner": {"size": 3, "later": 1}, "bars": {"goal1": 2}}


def test_the_expert_of_the_first_edition_keeps_its_identity() -> None:
    new = {"late_cost_limit", "bars", "acceptance_episodes", "extension", "extensions"}
    assert not new & set(ExpertConfig().identity())
    asked = ExpertConfig(late_cost_limit=5.0, bars={"goal1": Bars(least_return=18.0)}).identity()
    assert new & set(asked) == {"late_cost_limit", "bars"}
