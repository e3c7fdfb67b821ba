"""No module of the package executes what it reads from a file."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import wasp_cli

UNSAFE_MODULES = {"pickle", "marshal", "shelve", "dill", "cloudpickle", "pickletools", "_pickle", "xml"}
UNSAFE_BUILTINS = {"eval", "exec", "compile", "__import__"}
UNSAFE_CALLS = {"torch.load", "joblib.load", "np.loads", "pd.read_pickle", "os.system", "os.popen", "yaml.load", "yaml.unsafe_load"}


def unsafe(tree: ast.AST) -> Iterator[str]:
    """What could execute what a file says."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else [node.module or ""]
            yield from (f"import {name}" for name in names if name.partition(".")[0] in UNSAFE_MODULES)
        if not isinstance(node, ast.Call):
            continue
        name, keywords = ast.unparse(node.func), {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
        if name in UNSAFE_BUILTINS or name in UNSAFE_CALLS or keywords.get("shell") == "True":
            yield name
        if name in ("np.load", "numpy.load") and keywords.get("allow_pickle") != "False":
            yield f"{name} without allow_pickle=False"
        if name.endswith("YAML") and keywords.get("typ") not in ("'rt'", "'safe'"):
            yield f"{name} of type {keywords.get('typ')}"
        if name.rpartition(".")[2] == "load" and name.partition(".")[0] in ("PPO", "SAC", "BaseAlgorithm"):
            yield name  # stable-baselines3 keeps pickles in its archives


@pytest.mark.parametrize(
    "source",
    [
        "import pickle", "from pickle import loads", "torch.load(p)", "np.load(p)", "np.load(p, allow_pickle=True)", "YAML(typ='unsafe')",
        "YAML()", "eval(x)", "subprocess.run(x, shell=True)", "PPO.load(p)", "yaml.load(x)",
    ],
)  # fmt: skip
def test_the_rule_sees_what_it_should(source):
    assert list(unsafe(ast.parse(source)))


def test_no_module_executes_what_it_reads():
    root = Path(wasp_cli.__file__).parent
    modules = sorted(root.rglob("*.py"))
    found = {str(path.relative_to(root)): list(unsafe(ast.parse(path.read_text(encoding="utf-8")))) for path in modules}
    assert {name: what for name, what in found.items() if what} == {}
    assert len(modules) > 100
    assert not list(unsafe(ast.parse("np.load(p, allow_pickle=False); YAML(typ='rt'); module.eval(); re.compile('x')")))
