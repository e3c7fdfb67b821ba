"""What the package imports is what it declares, and no more."""

import json
import re
import sys
import tomllib
from pathlib import Path

from tests.plan.test_closure import names_imported

ROOT = Path(__file__).parents[1]
NAMES = {"pillow": "PIL", "pyyaml": "yaml", "ruamel-yaml": "ruamel"}
"""Distributions whose module has another name."""
EXTRAS = ("dask", "slurm", "export", "minari", "pandas", "drive", "web")


def declared(*extras: str) -> set[str]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = [
        *project["dependencies"],
        *(line for extra in extras for line in project["optional-dependencies"][extra]),
    ]
    names = [re.sub(r"[._-]+", "-", re.split(r"[ <>=!~\[;]", line)[0]).lower() for line in lines]
    return {NAMES.get(name, name.replace("-", "_")) for name in names}


def test_every_import_is_declared():
    imported: dict[str, set[str]] = {}
    for path in sorted((ROOT / "wasp_cli").rglob("*.py")):
        for module in (
            {name.partition(".")[0] for name in names_imported(path)}
            - set(sys.stdlib_module_names)
            - {"wasp_cli"}
        ):
            imported.setdefault(module, set()).add(str(path.relative_to(ROOT)))
    missing = {
        module: places for module, places in imported.items() if module not in declared(*EXTRAS)
    }
    assert missing == {}
    assert declared() <= set(imported), "each is imported somewhere"


def test_the_lock_file_has_every_dependency_in_the_version_that_computed_what_is_published() -> (
    None
):
    lines = (ROOT / "requirements.lock").read_text(encoding="utf-8").splitlines()
    locked = dict(
        re.findall(r"^([\w.-]+)==([\w.+]+)", line)[0]
        for line in reversed(lines)
        if "==" in line and not line.startswith("#")
    )
    assert {NAMES.get(name, name.replace("-", "_")) for name in locked} >= declared(
        "dask", "slurm", "export", "pandas", "drive"
    )
    manifests = (ROOT / "results/published/store/evaluate").glob("*/_manifest.json")
    newest = max(
        (json.loads(path.read_bytes())["provenance"] for path in manifests),
        key=lambda told: told["started_at"],
    )
    assert (
        locked.items()
        >= {name: version.partition("+")[0] for name, version in newest["versions"].items()}.items()
    )
