import ast
import json
import sys
from collections.abc import Callable, Iterator
from functools import cache
from importlib.machinery import ModuleSpec
from importlib.util import find_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.plugins import forget
from wasp_cli.errors import WaspError
from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import OPERATORS
from wasp_cli.plan import keys, source
from wasp_cli.plan.grid import lay_out
from wasp_cli.plan.keys import LENGTH, canonical, key_of, libraries, recipe_of
from wasp_cli.plan.source import closure, closure_hash, source_hash
from wasp_cli.plan.syntax import keep_sources, read_source, syntax_hash
from wasp_cli.registry import module_of
from wasp_cli.spec.model import validate
from wasp_cli.spec.names import training_stages
from wasp_cli.stages.registry import STAGES
from wasp_cli.tasks.registry import TASKS

Write = Callable[[str, str], None]


@pytest.fixture
def write(tmp_path, monkeypatch) -> Iterator[Write]:
    """Writes a module of a package `house` and forgets what was read before."""
    monkeypatch.syspath_prepend(str(tmp_path))
    forget()

    def put(name: str, source: str) -> None:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(source, encoding="utf-8")
        forget()

    put("house/__init__.py", "")
    yield put
    forget()


def test_imports_are_followed_wherever_they_stand(write):
    write("house/a.py", "from house import b\nfrom .sub import c\nimport json, numpy\n")
    write("house/b.py", "def f():\n    if True:\n        from house.d import g\n        return g\n")
    write("house/sub/__init__.py", "")
    write("house/sub/c.py", "try:\n    from ..e import x\nexcept ImportError:\n    x = None\n")
    write("house/d.py", "from house.a import b\n")
    write("house/e.py", "from house import nothing_there\n")
    assert closure(["house.a"]) == {
        "house",
        "house.a",
        "house.b",
        "house.d",
        "house.sub",
        "house.sub.c",
        "house.e",
    }


def test_imports_for_type_checking_do_not_count(write):
    write(
        "house/a.py",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from house import "
        "b\nelse:\n    from house import c\n",
    )
    write("house/b.py", "")
    write("house/c.py", "")
    assert closure(["house.a"]) == {"house", "house.a", "house.c"}


@pytest.fixture
def at_home(monkeypatch) -> None:
    """`house` stands for the package itself, whose registries and config models have rules of
    their own.
    """
    monkeypatch.setattr(source, "PACKAGE", "house")


@pytest.mark.usefixtures("at_home")
def test_registries_are_not_followed(write):
    write("house/a.py", "from house.registry import THINGS\n")
    write("house/registry.py", "from house import b\n")
    write("house/b.py", "")
    assert closure(["house.a"]) == {"house.a"}


def test_comments_docstrings_and_layout_do_not_count(write):
    write("house/a.py", "class A:\n    x: int = 1\n\n    def f(self):\n        return 1 + 2\n")
    before = source_hash("house.a")
    documented = [
        '"""What."""',
        "# why",
        "class A:",
        '    """A."""',
        "    x: int = 1",
        '    """x."""',
    ]
    documented += [
        "    def f(self):",
        '        """f."""',
        "        return (1 +",
        "                2)",
    ]
    write("house/a.py", "\n".join(documented))
    assert source_hash("house.a") == before
    write("house/a.py", "class A:\n    x: int = 1\n\n    def f(self):\n        return 1 + 3\n")
    assert source_hash("house.a") != before


def test_a_change_far_down_counts_and_one_elsewhere_does_not(write):
    write("house/a.py", "from house import b\n")
    write("house/b.py", "from house import c\n")
    write("house/c.py", "x = 1\n")
    write("house/other.py", "y = 1\n")
    before = closure_hash(("house.a",))
    write("house/other.py", "y = 2\n")
    assert closure_hash(("house.a",)) == before
    write("house/c.py", "x = 2\n")
    assert closure_hash(("house.a",)) != before


@pytest.mark.usefixtures("at_home")
def test_fields_of_config_models_do_not_count_since_their_values_do(write):
    text = (
        "LADDER = (1, 2)\nclass C(Config):\n    x: int = 1\n    def twice(self):\n        "
        "return 2 * self.x\n"
    )
    write("house/configs.py", text)
    before = source_hash("house.configs")
    write(
        "house/configs.py",
        text.replace("x: int = 1", "x: int = 5\n    y: int = 3")
        + "class New(Config):\n    z: int = 1\n",
    )
    assert source_hash("house.configs") == before
    write("house/configs.py", text.replace("2 * self.x", "3 * self.x"))
    assert source_hash("house.configs") != before
    write("house/configs.py", text.replace("(1, 2)", "(1, 3)"))
    assert source_hash("house.configs") != before


def test_in_packages_of_others_registries_and_configurations_count(write):
    write(
        "house/a.py",
        "from house import registry\nfrom house.config import Field\nfrom house.configs "
        "import SIZE\n",
    )
    write("house/registry.py", "from house import b\n")
    write("house/b.py", "x = 1\n")
    write("house/config.py", "class Field:\n    wet = 0.3\n")
    write("house/configs.py", "class Other:\n    wet: float = 0.3\n")
    assert closure(["house.a"]) == {
        "house",
        "house.a",
        "house.b",
        "house.registry",
        "house.config",
        "house.configs",
    }
    for name, text in (
        ("registry", "from house import b\ny = 1\n"),
        ("b", "x = 2\n"),
        ("config", "class Field:\n    wet = 0.4\n"),
        ("configs", "class Other:\n    wet: float = 0.4\n"),
    ):
        before = closure_hash(("house.a",))
        write(f"house/{name}.py", text)
        assert closure_hash(("house.a",)) != before, name


def test_a_root_without_source_is_refused(write):
    for root in ("house.absent", "nowhere", "nowhere.at_all"):
        with pytest.raises(WaspError, match=f"the source of '{root}' cannot be found"):
            closure([root])


def test_a_package_without_init_is_covered(write):
    write("tent/a.py", "from tent import b\nfrom tent.deep.c import x\n")
    write("tent/b.py", "y = 1\n")
    write("tent/deep/c.py", "x = 1\n")
    assert {"tent.a", "tent.b", "tent.deep.c"} <= closure(["tent.a"])
    before = closure_hash(("tent.a",))
    write("tent/deep/c.py", "x = 2\n")
    assert closure_hash(("tent.a",)) != before


def test_what_lies_beside_a_file_of_one_s_own_is_covered_and_what_is_installed_is_not(write):
    write("mine.py", "import numpy\nfrom helper import SHARE\n")
    write("helper.py", "SHARE = 0.5\n")
    assert closure(["mine"]) == {"mine", "helper"}
    write("site-packages/there.py", "import beside\n")
    write("site-packages/beside.py", "")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(sys.path[0]) / "site-packages"))
        assert closure(["there"]) == {"there"}


def test_a_package_of_an_editable_installation_is_covered(write, tmp_path, monkeypatch):
    write("elsewhere/cabin/__init__.py", "")
    write("elsewhere/cabin/a.py", "x = 1\n")

    class Finder:
        @staticmethod
        def find_spec(name: str, path: object = None, target: object = None) -> ModuleSpec | None:
            place = tmp_path / "elsewhere" / "cabin" / "__init__.py"
            return spec_from_file_location(name, place) if name == "cabin" else None

    monkeypatch.setattr(sys, "meta_path", [*sys.meta_path, Finder])
    before = closure_hash(("cabin.a",))
    write("elsewhere/cabin/a.py", "x = 2\n")
    assert closure_hash(("cabin.a",)) != before


def test_nothing_is_imported():
    before = set(sys.modules)
    closure(["wasp_cli.stages.evaluate", module_of(METHODS["wasp"].target)])
    assert not {
        name for name in set(sys.modules) - before if name.partition(".")[0] in ("torch", "mujoco")
    }


def test_every_node_of_the_syntax_is_told_apart():
    sources = [
        "x = 1",
        "x = 1.0",
        "x = '1'",
        "x = True",
        "x: int = 1",
        "x += 1",
        "y = 1",
        "x = -1",
        "def x(a=1): 0",
        "def x(*, a=1): 0",
        "x = [1]",
        "x = (1,)",
        "def x(a): 0",
        "async def x(a): 0",
        "x = lambda a: 0",
    ]
    trees = [ast.parse(source) for source in sources]
    assert len({syntax_hash(tree, configured=False) for tree in trees}) == len(sources)


def test_what_is_kept_of_a_source_is_what_its_bytes_give(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    data = b"from wasp_cli import seeds\nclass A:\n    x = 1\n"
    expected = {}
    for configured in (False, True):
        forget()
        expected[configured] = read_source(data, "a.py", configured=configured)
        keep_sources()
    assert expected[True].syntax != expected[False].syntax
    (path,) = tmp_path.rglob("sources-*.json")
    for damage in (lambda whole: whole, lambda whole: whole[:-9], lambda whole: b""):
        path.write_bytes(damage(path.read_bytes()))
        forget()
        for configured, found in expected.items():
            assert read_source(data, "a.py", configured=configured) == found
    changed = read_source(data.replace(b"1", b"2"), "a.py", configured=False)
    assert changed.syntax != expected[False].syntax


# What the key of each sort of node may cover: a training module in an evaluation, or a picture in a
# stage, fails here.


NEVER = ("tasks.sheet", "tasks.camera.topdown", "tasks.camera.view3d")
"""What only checks and shows worlds."""
STAGES_MAY_HAVE = frozenset({"stages", "stages.base", "stages.expert_limit", "stages.finite"})
SECTIONS = {
    "recorded": "expert dataset",
    "world": "world_model latents diagnostics",
    "latent": "policies critics clone",
    "baselines": "ida_q denoiser residual",
    "consistency": "consistency",
    "reachability": "reachability",
    "fallback": "fallback",
    "adversary": "adversary",
    "judged": "heldout calibration evaluate counterfactual",
    "severity": "severity",
    "operating": "operating",
}
"""By file of `learning.configs`, the kinds whose sections are in it."""


@cache
def closures() -> dict[str, frozenset[str]]:
    """By node kind, every module in the closure of one, over all tasks, methods, their
    variants, and operators.
    """
    document = {
        "name": "all",
        "preset": "smoke",
        "tasks": list(TASKS),
        "methods": list(METHODS),
        "seeds": [0],
        "stages": training_stages(),
        "operators": {
            name: {"some": 0.25} | ({"chosen": "auto"} if info.simulated else {})
            for name, info in OPERATORS.items()
        },
        "operating_points": "chosen",
    }
    found: dict[str, frozenset[str]] = {}
    for node in lay_out(validate(document)).nodes:
        found[node.kind] = found.get(node.kind, frozenset()) | closure(node.modules)
    return found


def short(modules: frozenset[str]) -> set[str]:
    return {module.removeprefix("wasp_cli.") for module in modules}


@pytest.mark.parametrize("kind", sorted(STAGES))
def test_a_node_s_key_covers_its_own_stage_and_settings_and_nobody_else_s(kind):
    covered = short(closures()[kind])
    (section,) = (file for file, kinds in SECTIONS.items() if kind in kinds.split())
    assert {module for module in covered if module.startswith("stages")} - STAGES_MAY_HAVE == {
        f"stages.{kind}"
    }
    configs = {module for module in covered if module.startswith("learning.configs.")}
    assert configs <= {"learning.configs.shared", f"learning.configs.{section}"}
    assert not covered & set(NEVER)


@pytest.mark.parametrize("kind", ["evaluate", "calibration", "heldout", "counterfactual"])
def test_what_is_evaluated_trains_nothing_and_reads_no_dataset(kind):
    reached = {module for module in short(closures()[kind]) if module.startswith("learning.")}
    known = "configs configs.judged configs.shared assistants closed_loop device evaluation "
    known += "heldout informed nominal counterfactual playback rerun"
    assert reached <= {f"learning.{name}" for name in known.split()}


DRAWS = (
    "matplotlib",
    "PIL.ImageDraw",
    "PIL.ImageFont",
    "imageio",
    "rich",
    "jinja2",
    "markupsafe",
    "typer",
    "click",
)
ROOMS = ("report", "video", "cli", "compare")


def names_imported(path: Path) -> Iterator[str]:
    """Everything that a source imports anywhere, functions included, whoever's it is."""
    for node in ast.walk(ast.parse(path.read_bytes())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def imported(module: str) -> Iterator[str]:
    spec = find_spec(module)
    return names_imported(Path(spec.origin)) if spec.origin is not None else iter(())


def test_nothing_in_a_key_draws_lays_out_or_belongs_to_a_report():
    everything = frozenset().union(*closures().values())
    forbidden = (*DRAWS, *(f"wasp_cli.{room}" for room in ROOMS))
    found = {
        (module, name)
        for module in everything
        for name in imported(module)
        if any(f"{name}.".startswith(f"{part}.") for part in forbidden)
    }
    assert found == set()
    assert not {module for module in everything if module.split(".")[1] in ROOMS}


VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**60), 2**60)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=4)
    ),
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
