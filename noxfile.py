# /// script
# dependencies = ["nox>=2025.5.1"]
# ///
"""Everything that has to hold before a change goes in. `nox` runs it all, `nox -s tests` one session, `nox -l` lists them.

torch takes minutes to install, so all sessions but `lint` share one environment: `project` builds it, the others run in it.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import nox

nox.needs_version = ">=2025.5.1"
nox.options.reuse_existing_virtualenvs = True

SPECS = sorted(path.as_posix() for path in Path("specs").glob("*.yaml") if path.name != "paper.yaml")
BIN = "Scripts" if sys.platform == "win32" else "bin"


def enter(session: nox.Session) -> None:
    """Put the environment of the session `project` first on the path."""
    environment = session.cache_dir.parent / "project"
    session.env["VIRTUAL_ENV"] = str(environment)
    session.env["PATH"] = os.pathsep.join([str(environment / BIN), os.environ.get("PATH", "")])
    # Two libraries that each start a thread per core make everything slower on a small machine.
    session.env.setdefault("OMP_NUM_THREADS", "1")


@nox.session
def lint(session: nox.Session) -> None:
    """Style: ruff's checks and its formatting."""
    session.install("ruff")
    session.run("ruff", "check", ".")
    session.run("ruff", "format", "--check", ".")


@nox.session
def project(session: nox.Session) -> None:
    """Install the package and the development tools into the shared environment."""
    session.install("-e", ".[dev]")
    session.run("wasp", "--version")


@nox.session(venv_backend="none", requires=["project"])
def types(session: nox.Session) -> None:
    """mypy, strict."""
    enter(session)
    session.run("python", "-m", "mypy", external=True)


@nox.session(venv_backend="none", requires=["project"])
def layers(session: nox.Session) -> None:
    """The walls between the rooms (import-linter contracts in pyproject.toml)."""
    enter(session)
    session.run("lint-imports", "--no-cache", external=True)


@nox.session(venv_backend="none", requires=["project"])
def tests(session: nox.Session) -> None:
    """The fast tests; arguments go to pytest."""
    enter(session)
    session.run("python", "-m", "pytest", "-m", "not slow", "--durations=10", *session.posargs, external=True)


@nox.session(venv_backend="none", requires=["project"])
def specs(session: nox.Session) -> None:
    """Every shipped spec reads and validates."""
    enter(session)
    for spec in SPECS:
        session.run("wasp", "check", spec, external=True)


@nox.session(venv_backend="none", requires=["project"])
def smoke(session: nox.Session) -> None:
    """The main job end to end in a fresh folder; a second run must compute nothing; then the report."""
    enter(session)
    results = Path(session.create_tmp()).resolve() / "results"
    session.run("python", "-c", "import shutil, sys; shutil.rmtree(sys.argv[1], ignore_errors=True)", str(results), external=True)
    session.run("wasp", "run", "specs/smoke.yaml", "--results", str(results), external=True)
    before = artifacts(results)
    session.run("wasp", "run", "specs/smoke.yaml", "--results", str(results), external=True)
    if not before or artifacts(results) != before:
        session.error("the second run of specs/smoke.yaml touched artifacts of the first one")
    session.run("wasp", "report", str(results), external=True)


@nox.session(venv_backend="none", requires=["project"], default=False)
def slow(session: nox.Session) -> None:
    """Tests that take minutes."""
    enter(session)
    session.run("python", "-m", "pytest", "-m", "slow", *session.posargs, external=True)


@nox.session(venv_backend="none", requires=["project"], default=False)
def benchmarks(session: nox.Session) -> None:
    """Speed, as ratios to a limit measured in the same run."""
    enter(session)
    session.run("python", "-m", "pytest", "tests/benchmarks", "--benchmark-enable", "--benchmark-only", *session.posargs, external=True)


def artifacts(results: Path) -> dict[str, int]:
    """Every file of the store and when it was written."""
    store = results / "store"
    return {str(path.relative_to(store)): path.stat().st_mtime_ns for path in sorted(store.rglob("*")) if path.is_file()}
