"""What of a configuration enters a key; `python -m tests.spec.test_identity` writes the
defaults anew after a change that is wanted.
"""

import json
from pathlib import Path
from typing import Any, ClassVar, get_args

from pydantic import BaseModel

from wasp_cli.config import Config, assumed
from wasp_cli.methods.registry import METHODS
from wasp_cli.registry import load_target
from wasp_cli.spec.model import Spec
from wasp_cli.stages.registry import STAGES

GOLDEN = Path(__file__).parents[1] / "golden" / "defaults.json"


class Inner(Config):
    size: int = assumed(3, "a size")
    later: int = assumed(0, "came later")


class Outer(Config):
    inner: Inner = Inner()
    larger: Inner = Inner(size=4)
    perhaps: Inner | None = None
    every: int = assumed(5, "moves no result", in_key=False)
    bars: dict[str, int] = assumed({}, "came later")


class Raised(Inner):
    edition: ClassVar[int] = 2


def test_only_values_that_are_not_their_defaults_enter_the_identity():
    assert Outer().identity() == {"larger": {"size": 4}}
    assert Outer(every=6).identity() == Outer().identity()
    changed = Outer(inner=Inner(later=1), bars={"goal1": 2})
    assert changed.identity() == {
        "inner": {"later": 1},
        "larger": {"size": 4},
        "bars": {"goal1": 2},
    }
    assert Outer(perhaps=Inner()).identity()["perhaps"] == {}, (
        "a section at its defaults is not the same as no section"
    )
    assert Raised().identity() == {"edition": 2}


def defaults() -> dict[str, Any]:
    """Every configuration of a stage or a method with its edition and its defaults, as far as
    it has them.
    """
    models = (
        {load_target(info.target).config for info in STAGES.values()}
        | {info.config_model() for info in METHODS.values()}
        | nested(Spec)
    )
    told = {}
    for model in sorted(models.union(*map(nested, models)), key=lambda model: model.__name__):
        fields = {name: info for name, info in model.model_fields.items() if not info.is_required()}
        values = {
            name: info.get_default(call_default_factory=True) for name, info in fields.items()
        }
        plain = {
            name: value.identity() if isinstance(value, Config) else value
            for name, value in values.items()
        }
        told[model.__name__] = {"edition": model.edition, **plain}
    return told


def nested(model: type[BaseModel]) -> set[type[Config]]:
    """The configurations that are sections of a model."""
    inner = {kind for info in model.model_fields.values() for kind in kinds(info.annotation)}
    return inner.union(*map(nested, inner))


def kinds(annotation: Any) -> set[type[Config]]:
    if isinstance(annotation, type) and issubclass(annotation, Config):
        return {annotation}
    return set().union(*map(kinds, get_args(annotation)))


def test_a_changed_default_raises_the_edition():
    """Keys do not see defaults. Where this fails: a new field is fine, a changed default needs
    another `edition` of its class.
    """
    golden, now = json.loads(GOLDEN.read_text()), json.loads(json.dumps(defaults(), default=str))
    changed = [
        f"{model}.{name}"
        for model, values in golden.items()
        for name, value in values.items()
        if model in now
        and name in now[model]
        and now[model][name] != value
        and now[model]["edition"] == values["edition"]
    ]
    assert changed == []
    assert now == golden, "the file of defaults is old: python -m tests.spec.test_identity"


if __name__ == "__main__":
    GOLDEN.write_text(json.dumps(defaults(), indent=1, default=str) + "\n")
