# /// script
# dependencies = ["nox>=2025.5.1"]
# ///
"""Everything that has to hold before a change goes in. `nox` runs it all, `nox -s tests` one
session, `nox -l` lists them.

torch takes minutes to install, so all sessions but `lint` share one environment: `project` builds
it, the others run in it.
"""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

import nox

nox.needs_version = ">=2025.5.1"
nox.options.reuse_existing_virtualenvs = True
nox.options.envdir = os.environ.get("NOX_ENVDIR", ".nox")  # `.ci/run` wants all of it anew

SPECS = sorted(path.as_posix() for path in Path("specs").glob("*.yaml"))
PEERS = (
    "gymnasium==1.4.0",
    "torch==2.13.0",
    "stable-baselines3==2.9.2",
    "torchrl==0.14.1",
    "minari[create,hdf5]==0.5.4",
    "skrl==2.1.1",
)
"""Packages of others whose suites and trainers run on the environments."""
OMNISAFE = "omnisafe==0.5.0"
OMNISAFE_NEEDS = ("tensorboard", "wandb", "moviepy", "gdown", "seaborn", "pandas", "pyyaml")
"""What it imports. Its own requirements hold safety-gymnasium, whose gymnasium 0.28.1 and
MuJoCo 2.3.3 exclude ours.
"""
LEROBOT = "lerobot[dataset]==0.6.1"
"""It pins torch below 2.12, and wants Python 3.12 or newer."""
EXTERNAL = "gymnasium[box2d]==1.4.0"
"""The physics of Lunar Lander."""
PYTHONS = ("3.11", "3.12", "3.13")
"""Those that the package supports."""
LARGEST_WHEEL = 50e6
"""Bytes. What is published grows; an install must not."""
CPU_TORCH = "https://download.pytorch.org/whl/cpu"
BIN = "Scripts" if sys.platform == "win32" else "bin"


def run(session: nox.Session, program: str, *arguments: str) -> None:
    """Run a program of the environment that the session `project` built."""
    environment = session.cache_dir.parent / "project"
    path = os.pathsep.join([str(environment / BIN), os.environ.get("PATH", "")])
    env = {
        "VIRTUAL_ENV": str(environment),
        "PATH": path,
        "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "1"),
    }
    session.run(str(environment / BIN / program), *arguments, env=env, external=True)


def install_cpu_torch(session: nox.Session) -> None:
    """Install the CPU build of torch on a machine without a GPU, where PyPI's brings gigabytes of
    CUDA. Where its index cannot be reached, PyPI's is what the next install takes.
    """
    if sys.platform != "linux" or shutil.which("nvidia-smi") is not None:
        return
    if os.environ.get("PIP_EXTRA_INDEX_URL") or os.environ.get("PIP_INDEX_URL"):
        return  # you have chosen where packages come from
    dependencies = nox.project.load_toml("pyproject.toml")["project"]["dependencies"]
    torch = next(line for line in dependencies if line.startswith("torch>"))
    patience = ("--retries", "0", "--timeout", "15")
    session.install("--no-deps", "--index-url", CPU_TORCH, *patience, torch, success_codes=[0, 1])


@nox.session
def lint(session: nox.Session) -> None:
    """Style: ruff's checks and its formatting."""
    session.install("ruff")
    session.run("ruff", "check", ".")
    session.run("ruff", "format", "--check", ".")


@nox.session
def project(session: nox.Session) -> None:
    """Install the package and the development tools into the shared environment."""
    install_cpu_torch(session)
    session.install("-e", ".[dev]")
    session.run("wasp", "--version")


@nox.session(venv_backend="none", requires=["project"])
def types(session: nox.Session) -> None:
    """mypy, strict."""
    run(session, "python", "-m", "mypy")


@nox.session(venv_backend="none", requires=["project"])
def layers(session: nox.Session) -> None:
    """The walls between the rooms (import-linter contracts in pyproject.toml)."""
    run(session, "lint-imports", "--no-cache")


@nox.session(venv_backend="none", requires=["project"])
def tests(session: nox.Session) -> None:
    """The fast tests, as many side by side as there are cores; arguments go to pytest."""
    # By file, since what a file's tests share is made once in each process; in their order, which
    # ends with short ones. A test that hangs is named after twenty minutes; none takes one.
    options = (
        "-n",
        "auto",
        "--dist",
        "loadfile",
        "--no-loadscope-reorder",
        "--timeout",
        "1200",
        "--durations=10",
    )
    run(session, "python", "-m", "pytest", "-m", "not slow", *options, *session.posargs)


@nox.session(venv_backend="none", requires=["project"])
def specs(session: nox.Session) -> None:
    """Every shipped spec reads and validates, and so does the paper."""
    for spec in SPECS:
        run(session, "wasp", "check", spec)


@nox.session(venv_backend="none", requires=["project"])
def smoke(session: nox.Session) -> None:
    """The main job end to end in a fresh folder; a second run must compute nothing; then the
    other tasks, and what shows results.
    """
    results = Path(session.create_tmp()).resolve() / "results"
    shutil.rmtree(results, ignore_errors=True)
    run(session, "wasp", "run", "specs/smoke.yaml", "--results", str(results))
    before = artifacts(results)
    run(session, "wasp", "run", "specs/smoke.yaml", "--results", str(results))
    if not before or artifacts(results) != before:
        session.error("the second run of specs/smoke.yaml touched artifacts of the first one")
    others = (
        "--set",
        "name=smoke-cars",
        "--set",
        "tasks=[race1, formula1]",
        "--set",
        "operators={laggy: {severe: 0.85}}",
    )
    run(session, "wasp", "run", "specs/smoke.yaml", *others, "--results", str(results))
    run(session, "wasp", "report", str(results), "--strict")
    run(session, "wasp", "compare", str(results), str(results), "--spec", "smoke", "--strict")
    for step in ((), ("--step", "3")):
        video = str(results.parent / f"replay{len(step)}.webp")
        run(
            session,
            "wasp",
            "replay",
            "goal1 s0 wasp laggy=0.7",
            "--episode",
            "0",
            *step,
            "--results",
            str(results),
            "--out",
            video,
        )


@nox.session(venv_backend="none", requires=["project"], default=False)
def docs(session: nox.Session) -> None:
    """The site of the documentation; a link or an anchor that leads nowhere fails. Arguments go to
    sphinx-build.
    """
    site = session.cache_dir.resolve() / "site"
    run(session, "python", "-m", "pip", "install", "-q", "-e", ".[docs]")
    # -W: a warning is an error, after all of them were shown; -E: nothing is left of another build
    strict = ("-q", "-E", "-W", "--keep-going")
    run(session, "sphinx-build", *strict, "-c", "docs/site", ".", str(site), *session.posargs)
    session.log(f"the site begins with {site / 'index.html'}")


@nox.session(venv_backend="none", requires=["project"], default=False)
def slow(session: nox.Session) -> None:
    """Tests that take minutes."""
    run(session, "python", "-m", "pytest", "-m", "slow", *session.posargs)


@nox.session(venv_backend="none", requires=["project"], default=False)
def gpu(session: nox.Session) -> None:
    """The smoke spec on a GPU, and every assistant's decisions there held against those on the
    CPU; without a GPU nothing runs.
    """
    asked = [
        str(session.cache_dir.parent / "project" / BIN / "python"),
        "-c",
        "import torch; print(torch.cuda.is_available())",
    ]
    if "True" not in str(session.run(*asked, external=True, silent=True)):
        session.log("nothing was run: torch sees no GPU here")
        return
    results = Path(session.create_tmp()).resolve() / "gpu"
    shutil.rmtree(results, ignore_errors=True)
    session.env["WASP_DEVICE"] = "cuda"
    run(session, "wasp", "run", "specs/smoke.yaml", "--results", str(results))
    run(session, "wasp", "report", str(results), "--strict")
    run(
        session,
        "python",
        "-m",
        "pytest",
        "tests/methods/test_device.py",
        "tests/learning/test_device.py",
        *session.posargs,
    )


def test_peers(session: nox.Session, tests: str, **variables: str) -> None:
    """Run tests with packages of others; arguments go to pytest."""
    options = "addopts=-ra --import-mode=importlib -p no:cacheprovider"
    env = {"WASP_PEERS": "1", "OMP_NUM_THREADS": "1", **variables}
    session.run("python", "-m", "pytest", "-o", options, tests, *session.posargs, env=env)


@nox.session(default=False)
def peers(session: nox.Session) -> None:
    """The checkers, collectors and trainers of others on our environments, in an environment of
    their own; results in docs/tasks.md.
    """
    install_cpu_torch(session)
    session.install("-e", ".", "pytest>=8", *PEERS, *OMNISAFE_NEEDS)
    session.install("--no-deps", OMNISAFE)
    test_peers(session, "tests/peers")


@nox.session(default=False, python=["3.12", "3.13"])
def lerobot(session: nox.Session) -> None:
    """LeRobot's own loaders on what `wasp export` writes, in an environment of their own."""
    session.install("-e", ".", "pytest>=8", LEROBOT)
    test_peers(session, "tests/peers/test_lerobot.py", HF_HUB_OFFLINE="1")


@nox.session(default=False)
def external(session: nox.Session) -> None:
    """Our Diffusion and IDA against the figures of their own papers: hours, in an environment of
    its own; results in docs/baselines.md.

    What is trained and measured stays in the session's cache (an argument names another folder),
    and a second run goes on.
    """
    install_cpu_torch(session)
    session.install("-e", ".", "pytest>=8", EXTERNAL)
    folder = (
        session.posargs[0]
        if session.posargs
        else str(session.cache_dir.resolve() / "external-worlds")
    )
    env = {
        "WASP_EXTERNAL": "1",
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": os.pathsep.join([".", "docs/examples"]),
    }
    options = "addopts=-ra --import-mode=importlib -p no:cacheprovider"
    session.run("python", "-m", "pytest", "-o", options, "tests/external", env=env)
    session.run("python", "-m", "tests.external.measure", folder, env=env)


@nox.session(default=False)
def package(session: nox.Session) -> None:
    """Build what PyPI gets, the source archive and from it the wheel, and check both as PyPI
    does.
    """
    folder = packages(session)
    shutil.rmtree(folder, ignore_errors=True)
    session.install("build", "twine")
    session.run("python", "-m", "build", "--outdir", str(folder))
    built = sorted(folder.iterdir())
    session.run("twine", "check", "--strict", *map(str, built))
    for path in built:
        session.log(f"{path.name}: {path.stat().st_size / 1e6:.1f} MB")
    (wheel,) = folder.glob("*.whl")
    if wheel.stat().st_size > LARGEST_WHEEL:
        session.error(f"{wheel.name} has more than {LARGEST_WHEEL / 1e6:.0f} MB")


@nox.session(python=PYTHONS, reuse_venv=False, requires=["package"], default=False)
def wheel(session: nox.Session) -> None:
    """The built wheel in an environment of its own, with the newest version of everything that it
    needs: the quickstart and its report, from an empty folder.
    """
    (built,) = packages(session).glob("*.whl")
    install_cpu_torch(session)
    session.install(str(built))
    session.run("python", "-m", "pip", "check")
    session.run("python", "-m", "pip", "list")
    empty = Path(session.create_tmp()).resolve() / "empty"
    shutil.rmtree(empty, ignore_errors=True)
    empty.mkdir()
    with session.chdir(empty):
        session.run("wasp", "--version")
        session.run("wasp", "run", "quickstart")
        session.run("wasp", "report", "results")


def packages(session: nox.Session) -> Path:
    """The folder that the session `package` builds into."""
    return session.cache_dir.resolve() / "dist"


@nox.session(venv_backend="none", requires=["project"], default=False)
def benchmarks(session: nox.Session) -> None:
    """Speed, as ratios to a limit measured in the same run."""
    run(
        session,
        "python",
        "-m",
        "pytest",
        "-o",
        "addopts=--import-mode=importlib --benchmark-only",
        "tests/benchmarks",
        *session.posargs,
    )


def artifacts(results: Path) -> dict[str, int]:
    """Every file of the store and when it was written."""
    store = results / "store"
    return {
        str(path.relative_to(store)): path.stat().st_mtime_ns
        for path in sorted(store.rglob("*"))
        if path.is_file()
    }
