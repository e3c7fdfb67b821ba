"""Arrays say how they are shaped: the docstrings of public functions, read as text."""

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "wasp_cli"

ROOMS_OF_ARRAYS = ("learning", "models", "methods", "operators", "tasks", "metrics", "video")
ARRAYS = re.compile(r"\b(Tensor|NDArray|ndarray|Floats|Bools|Ints|Images|Pixels)\b")
NAMED = re.compile(r"dict\[str, [\w.]+(\[\w+\])?\]")
"""a dictionary of arrays: it says their names instead"""
SHAPE = re.compile(r"\[[^\]]+\]|shape", re.IGNORECASE)


@dataclass(frozen=True)
class Function:
    """A public function or method, as it stands in a file."""

    place: str
    docstring: str | None
    signature: str
    legend: str
    """docstrings of the class and of the module"""


def _functions(tree: ast.Module, place: str) -> Iterator[Function]:
    def inside(body: list[ast.stmt], owner: ast.ClassDef | None) -> Iterator[Function]:
        for item in body:
            if isinstance(item, ast.ClassDef) and not item.name.startswith("_"):
                yield from inside(item.body, item)
            elif isinstance(item, ast.FunctionDef) and not item.name.startswith("_"):
                if any("property" in ast.unparse(decorator) for decorator in item.decorator_list):
                    continue
                legend = (ast.get_docstring(tree) or "") + (ast.get_docstring(owner) or "" if owner else "")
                types = [argument.annotation for argument in ast.walk(item.args) if isinstance(argument, ast.arg)]
                signature = " ".join(ast.unparse(each) for each in [*types, item.returns] if each is not None)
                name, line = (f"{owner.name}.{item.name}" if owner else item.name), item.lineno
                yield Function(f"{place}:{line} {name}", ast.get_docstring(item), signature, legend)

    yield from inside(tree.body, None)


def _package() -> list[Function]:
    return [
        function
        for path in sorted(PACKAGE.rglob("*.py"))
        for function in _functions(ast.parse(path.read_text()), path.relative_to(PACKAGE).as_posix())
    ]


def test_arrays_have_shapes():
    # In brackets, in the docstring or in the legend of the class or the module.
    silent = [
        each.place
        for each in _package()
        if each.place.startswith(ROOMS_OF_ARRAYS)
        and each.docstring
        and not each.docstring.startswith("See `")
        and ARRAYS.search(NAMED.sub("", each.signature))
        and not SHAPE.search(each.docstring + each.legend)
    ]
    assert not silent
