import ast
import sys
from collections.abc import Callable, Iterator
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_file_location

import pytest

from tests.plugins import forget
from wasp_cli.errors import WaspError
from wasp_cli.methods.registry import METHODS
from wasp_cli.plan import closure as module
from wasp_cli.plan.closure import closure, closure_hash, source_hash
from wasp_cli.registry import module_of

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
    assert closure(["house.a"]) == {"house", "house.a", "house.b", "house.d", "house.sub", "house.sub.c", "house.e"}


def test_imports_for_type_checking_do_not_count(write):
    write("house/a.py", "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from house import b\nelse:\n    from house import c\n")
    write("house/b.py", "")
    write("house/c.py", "")
    assert closure(["house.a"]) == {"house", "house.a", "house.c"}


@pytest.fixture
def at_home(monkeypatch) -> None:
    """`house` stands for the package itself, whose registries and config models have rules of their own."""
    monkeypatch.setattr(module, "PACKAGE", "house")


@pytest.mark.usefixtures("at_home")
def test_registries_are_not_followed(write):
    write("house/a.py", "from house.registry import THINGS\n")
    write("house/registry.py", "from house import b\n")
    write("house/b.py", "")
    assert closure(["house.a"]) == {"house.a"}


def test_comments_docstrings_and_layout_do_not_count(write):
    write("house/a.py", "class A:\n    x: int = 1\n\n    def f(self):\n        return 1 + 2\n")
    before = source_hash("house.a")
    documented = ['"""What."""', "# why", "class A:", '    """A."""', "    x: int = 1", '    """x."""']
    documented += ["    def f(self):", '        """f."""', "        return (1 +", "                2)"]
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
    text = "LADDER = (1, 2)\nclass C(Config):\n    x: int = 1\n    def twice(self):\n        return 2 * self.x\n"
    write("house/configs.py", text)
    before = source_hash("house.configs")
    write("house/configs.py", text.replace("x: int = 1", "x: int = 5\n    y: int = 3") + "class New(Config):\n    z: int = 1\n")
    assert source_hash("house.configs") == before
    write("house/configs.py", text.replace("2 * self.x", "3 * self.x"))
    assert source_hash("house.configs") != before
    write("house/configs.py", text.replace("(1, 2)", "(1, 3)"))
    assert source_hash("house.configs") != before


def test_in_packages_of_others_registries_and_configurations_count(write):
    write("house/a.py", "from house import registry\nfrom house.config import Field\nfrom house.configs import SIZE\n")
    write("house/registry.py", "from house import b\n")
    write("house/b.py", "x = 1\n")
    write("house/config.py", "class Field:\n    wet = 0.3\n")
    write("house/configs.py", "class Other:\n    wet: float = 0.3\n")
    assert closure(["house.a"]) == {"house", "house.a", "house.b", "house.registry", "house.config", "house.configs"}
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


def test_orchestration_is_in_no_closure():
    for name in closure(["wasp_cli.stages.evaluate", "wasp_cli.stages.residual"]):
        part = name.split(".")[1]
        assert part not in module.ORCHESTRATION


def test_nothing_is_imported():
    before = set(sys.modules)
    closure(["wasp_cli.stages.evaluate", module_of(METHODS["wasp"].target)])
    assert not {name for name in set(sys.modules) - before if name.partition(".")[0] in ("torch", "mujoco")}


def test_every_node_of_the_syntax_is_told_apart():
    def text(source: str) -> str:
        texts: list[str] = []
        module._syntax(ast.parse(source), texts)
        return "".join(texts)

    sources = [
        "x = 1", "x = 1.0", "x = '1'", "x = True", "x: int = 1", "x += 1", "y = 1", "x = -1",
        "def x(a=1): 0", "def x(*, a=1): 0", "x = [1]", "x = (1,)", "def x(a): 0", "async def x(a): 0", "x = lambda a: 0",
    ]  # fmt: skip
    assert len({text(source) for source in sources}) == len(sources)
