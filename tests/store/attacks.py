"""What an untrusted results folder may hold."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

from tests.run.recorded import key
from tests.store.untrusted import LABEL, RUN, UntrustedStore
from wasp_cli.store.records import write_record
from wasp_cli.store.tables import EPISODES_FILE

SCRIPT = "<script>alert(1)</script>"
ESCAPE = "\x1b]0;owned\x07"
DEEP = '{"a": ' * 300 + "1" + "}" * 300
Attack = Callable[[UntrustedStore, Path], None]
ATTACKS: dict[str, Attack] = {}


def attack(make: Attack) -> Attack:
    ATTACKS[make.__name__] = make
    return make


@attack
def nothing_at_all(it: UntrustedStore, outside: Path) -> None:
    """The folder that the others change is whole."""


@attack
def files_elsewhere(it: UntrustedStore, outside: Path) -> None:
    names = (
        "../../../../outside/secret.json",
        str(outside / "secret.json"),
        "..",
        "",
        "a\0b",
        "x" * 5000,
        "deep/../../x",
    )
    it.manifest(files={name: {"size": 1, "sha256": "0"} for name in names})


@attack
def a_task_that_would_be_imported(it: UntrustedStore, outside: Path) -> None:
    it.specification(tasks=["evil_module:X-v0"])
    it.fails()


@attack
def a_cell_of_a_task_that_would_be_imported(it: UntrustedStore, outside: Path) -> None:
    it.rows(task=["evil_module:X-v0"])
    it.plan(cells=[{**it.cell, "task": "evil_module:X-v0"}])
    it.fails()


@attack
def labels_that_command_the_terminal(it: UntrustedStore, outside: Path) -> None:
    it.plan(
        nodes=[{**node, "label": ESCAPE + node["label"]} for node in it.nodes()],
        spec=f"tiny{ESCAPE}\ud800",
    )
    it.manifest(
        label=ESCAPE, summary={ESCAPE: ESCAPE}, provenance={ESCAPE: ESCAPE, "started_at": ESCAPE}
    )
    it.fails(message=ESCAPE, label=ESCAPE, log=ESCAPE, hint=ESCAPE)
    events = [
        {"event": "failed", "key": ESCAPE, "label": ESCAPE, "message": ESCAPE, "log": ESCAPE},
        {"event": ESCAPE, "at": ESCAPE},
    ]
    with (it.layout.run(RUN) / "journal.jsonl").open("a") as file:
        file.writelines(json.dumps(event) + "\n" for event in events)
    write_record(
        it.layout.running(RUN, it.key),
        {"label": ESCAPE, "text": ESCAPE, "share": ESCAPE, "pid": 0, "host": ESCAPE},
    )


@attack
def deep_nesting(it: UntrustedStore, outside: Path) -> None:
    run = it.layout.run(RUN)
    for path in (
        it.artifact / "_manifest.json",
        run / "plan.json",
        run / "spec.json",
        it.layout.failure(key(1)),
    ):
        path.write_text(DEEP)
    it.layout.running(RUN, it.key).write_text("[" * 100_000)
    (run / "journal.jsonl").write_text(f"{DEEP}\n" + "[" * 100_000)


@attack
def linked_records(it: UntrustedStore, outside: Path) -> None:
    for path in (
        it.layout.failure(it.key),
        it.layout.running(RUN, it.key),
        it.layout.run(RUN) / "journal.jsonl",
    ):
        link(path, outside / "secret.json")
    link(it.layout.lock(it.key), outside / "secret.json")
    link(it.layout.work(it.key), outside / "inner")
    link(it.layout.tmp / f"{it.key}-left", outside / "inner")


@attack
def pipes(it: UntrustedStore, outside: Path) -> None:
    paths = (
        it.artifact / EPISODES_FILE,
        it.layout.failure(it.key),
        it.layout.run(RUN) / "spec.json",
        it.layout.log(RUN, LABEL, it.key),
    )
    for path in (
        *paths,
        it.layout.running(RUN, it.key),
        it.layout.lock(it.key),
        it.layout.tmp / f"{it.key}-x",
    ):
        path.unlink(missing_ok=True)
        os.mkfifo(path)


@attack
def needs_that_are_paths(it: UntrustedStore, outside: Path) -> None:
    it.plan(
        nodes=[
            {**node, "needs": {"a": "../../outside", "b": 7, "c": node["key"]}, "seconds": "x"}
            for node in it.nodes()
        ]
    )
    it.fails()


@attack
def upstream_of_a_replay_elsewhere(it: UntrustedStore, outside: Path) -> None:
    kinds = ("world_model", "policies", "calibration")
    it.manifest(
        upstream_kinds={kind: kind for kind in kinds},
        upstream=dict.fromkeys(kinds, "../../../outside"),
    )
    it.layout.kind("counterfactual").mkdir(exist_ok=True)
    link(it.layout.artifact("counterfactual", key(3)), outside)
    write_record(
        it.layout.manifest("counterfactual", key(4)),
        {"kind": "counterfactual", "upstream": [it.key], "config": 7},
    )


def link(path: Path, target: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)
    path.symlink_to(target)


@attack
def cells_that_are_markup(it: UntrustedStore, outside: Path) -> None:
    """The page of a report runs its own script and no other."""
    it.plan(cells=[{**it.cell, "severity": SCRIPT, "operator": SCRIPT}])
    it.manifest(label=SCRIPT, summary={SCRIPT: 1})
    it.fails(message=SCRIPT, label=SCRIPT)


ATTACKS.update(
    {
        "upstream_elsewhere": lambda it, outside: it.manifest(
            upstream={"a": "../../../outside", "b": key(1), "c": [1], "d": {}},
            upstream_kinds={"b": "../../outside", "d": 7},
        ),
        "a_manifest_of_wrong_types": lambda it, outside: it.manifest(
            upstream=7,
            upstream_kinds=[],
            config=[1],
            settings="x",
            axes=[],
            provenance=[],
            summary=7,
            label={"a": 1},
            seed="x",
            task=5,
        ),
        "long_numbers": lambda it, outside: it.manifest(
            files={"x": {"size": 10**400}}, provenance={"seconds": 10**400}
        ),
        "a_name_that_is_a_path": lambda it, outside: it.specification(name="../../outside"),
        "cells_of_no_form": lambda it, outside: it.plan(cells=7, parts="x", nodes={"a": 1}),
        "a_linked_artifact": lambda it, outside: link(it.artifact, outside),
        "a_linked_table": lambda it, outside: link(
            it.artifact / EPISODES_FILE, outside / EPISODES_FILE
        ),
        "a_linked_run": lambda it, outside: link(it.layout.run(RUN), outside),
        "cells_that_are_paths": lambda it, outside: it.plan(
            cells=[{**it.cell, "key": "../../../outside"}]
        ),
        "rows_that_command_the_terminal": lambda it, outside: it.rows(
            task=[ESCAPE], method=[ESCAPE], variant=[ESCAPE], operator=[ESCAPE]
        ),
        "linked_logs": lambda it, outside: link(
            it.layout.log(RUN, LABEL, it.key), outside / "secret.json"
        ),
        "a_linked_spec": lambda it, outside: link(
            it.layout.run(RUN) / "spec.json", outside / "secret.json"
        ),
        "a_linked_report": lambda it, outside: link(it.layout.root / "reports", outside),
        "a_linked_store": lambda it, outside: link(it.layout.store, outside),
        "a_table_of_wrong_types": lambda it, outside: it.rows(cost=["x"], tau_c=["y"]),
    }
)
