"""`wasp check` and `wasp schema` from outside."""

import json
from pathlib import Path
from typing import Any

import pytest

from tests.commands import ROOT, run_here
from tests.spec.good import GOOD
from wasp_cli.spec.shipped import shipped_names


@pytest.fixture
def good(tmp_path: Path) -> Path:
    path = tmp_path / "good.yaml"
    path.write_text(GOOD, encoding="utf-8")
    return path


def checked(*arguments: str | Path, code: int) -> list[dict[str, Any]]:
    done = run_here("check", *arguments, "--json", columns=200)
    assert (done.exit_code, done.stderr) == (code, "")
    found: list[dict[str, Any]] = json.loads(done.stdout)
    return found


def test_check_tells_machines_what_is_valid(good: Path) -> None:
    assert checked(good, ROOT / "specs" / "worldmodel.yaml", code=0) == [
        {"file": str(good), "ok": True, "cells": 2, "problems": []},
        {"file": str(ROOT / "specs" / "worldmodel.yaml"), "ok": True, "cells": 0, "problems": []},
    ]


def test_check_tells_machines_every_problem_of_every_file(good: Path) -> None:
    bad = good.parent / "bad.yaml"
    bad.write_text("extends: good.yaml\nname: bad\nsedes: [1]\npreset: smok\n", encoding="utf-8")
    assert checked(good, bad, good.parent / "absent.yaml", code=3) == [
        {"file": str(good), "ok": True, "cells": 2, "problems": []},
        {
            "file": str(bad),
            "ok": False,
            "cells": None,
            "problems": [
                {
                    "file": str(bad),
                    "line": 3,
                    "column": 1,
                    "message": "unknown key 'sedes'",
                    "hint": "did you mean 'seeds'?",
                    "excerpt": "sedes: [1]",
                },
                {
                    "file": str(bad),
                    "line": 4,
                    "column": 9,
                    "message": "should be 'smoke', 'quick', 'cpu', 'gpu' or 'paper', not 'smok'",
                    "hint": "did you mean 'smoke'?",
                    "excerpt": "preset: smok",
                },
            ],
        },
        {
            "file": str(good.parent / "absent.yaml"),
            "ok": False,
            "cells": None,
            "problems": [
                {
                    "file": str(good.parent / "absent.yaml"),
                    "line": 1,
                    "column": 1,
                    "message": "no such file",
                    "hint": f"known: bad, good, {', '.join(shipped_names())}",
                    "excerpt": None,
                },
            ],
        },
    ]


def test_a_problem_of_a_base_or_an_option_is_told_as_such(good: Path) -> None:
    good.write_text(GOOD.replace("goal1", "gaol1"), encoding="utf-8")
    over = good.parent / "over.yaml"
    over.write_text("extends: good.yaml\nname: over\n", encoding="utf-8")
    (entry,) = checked(over, "--set", "seeds=x", code=3)
    assert [(problem["file"], problem["line"]) for problem in entry["problems"]] == [
        (str(good), 3),
        ("--set seeds=x", None),
    ]
    # People read once what is wrong with both.
    assert (
        run_here("check", good, over, columns=200, code=3).stderr.count("unknown task 'gaol1'") == 1
    )


def test_errors_are_read_from_top_to_bottom(good: Path) -> None:
    good.write_text(GOOD.replace("goal1", "gaol1").replace("[0]", "0"), encoding="utf-8")
    assert run_here("check", good, columns=40, code=3).stderr.splitlines() == [
        f"error: {good}:3:9: unknown task 'gaol1'",
        "    3 | tasks: [gaol1]",
        "      |         ^",
        "    did you mean 'goal1'?",
        f"{good}:7:8: should be a list, not 0",
        "    7 | seeds: 0",
        "      |        ^",
        "    write [0]",
    ]
