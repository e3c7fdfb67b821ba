"""A session: who drives which cells, in which order, and what is asked between them.

Cells that are there are not driven again, so that a session that broke off goes on where it was.
What a block leaves behind is a cell like any other, with what the clock and the connection were
like in two more files (`store.people`): `CellRecord` has every finished episode on disk before the
next one begins. A block that ends early is the cell of as many episodes as were finished, so that
it is never taken for whole; the same session continued takes these over.
"""

from __future__ import annotations

import itertools
import math
import shlex
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import torch

from wasp_cli import seeds
from wasp_cli.cells.cell import recorded_cell
from wasp_cli.console import plain
from wasp_cli.drive.block import ALONE, SHOWN, Beat, Block, Cut, Driven, How
from wasp_cli.drive.desk import END, NEXT, Desk
from wasp_cli.errors import UsageError
from wasp_cli.learning.assistants import load_parts
from wasp_cli.learning.device import training_device
from wasp_cli.metrics.episode import episode_metrics
from wasp_cli.operators.registry import PERSON
from wasp_cli.plan.grid import OPERATING, Grid, select
from wasp_cli.plan.node import Cell, Node, canonical
from wasp_cli.plan.plan import plan_against
from wasp_cli.plan.reuse import lay_out_over
from wasp_cli.report.operating import read_point, silence
from wasp_cli.run.record import new_run
from wasp_cli.run.runner import job_of
from wasp_cli.run.session import RunOptions, run_spec
from wasp_cli.run.worker import keep_memory, manifest_of, require_whole
from wasp_cli.spec.load import Loaded, limited, load
from wasp_cli.spec.model import QUESTIONS, Spec, StudyConfig, balanced_order
from wasp_cli.stages.evaluate import thresholds_of
from wasp_cli.stages.registry import stages_of
from wasp_cli.store.artifact import (
    commit,
    discard,
    exists,
    read_manifest,
    staging_folder,
    stored_keys,
)
from wasp_cli.store.layout import Layout
from wasp_cli.store.lock import held_if_free
from wasp_cli.store.parquet import write_table
from wasp_cli.store.people import BEAT, SESSION_FILE, TIMING_FILE, read_timing, timing_summary
from wasp_cli.store.records import read_record, write_record
from wasp_cli.store.tables import (
    EPISODES_FILE,
    STEPS_FILE,
    CellIdentity,
    Thresholds,
    first_rows,
    read_episodes,
    write_cell,
)
from wasp_cli.tasks.registry import TASKS

SHIPPED = Path("drive")  # the spec behind `wasp drive TASK`


@dataclass
class Session:
    loaded: Loaded
    layout: Layout
    run_id: str
    blocks: list[tuple[Cell, Node]]  # in the order in which they are driven
    how: How
    study: StudyConfig | None = None
    facts: dict[str, Any] = field(default_factory=dict)
    done: list[dict[str, Any]] = field(default_factory=list)
    failure: BaseException | None = None
    # by key of a cell, the folder of its first episodes: a sitting that ended early
    begun: dict[str, Path] = field(default_factory=dict)

    @property
    def participant(self) -> str:
        return str(self.blocks[0][0].severity)

    def run(self, desk: Desk) -> None:
        """Lead the driver through everything; returns when all is driven, or the driver ends."""
        if not self._consent(desk):
            desk.state("over", text="Nothing was recorded.", blocks=[])
            return
        practised = 0 if self.study is None else self.study.practice
        for number, (cell, node) in enumerate(self.blocks):
            with held_if_free(self.layout.lock(node.key)) as mine:
                if not mine:
                    raise UsageError(
                        f"{node.label} is driven in another window",
                        "end that session, then start this one again",
                    )
                if exists(self.layout, node.kind, node.key):
                    plain(f"{node.label}: driven before")
                    continue
                if practised and not self._practice(desk, cell, node, practised):
                    break
                practised = 0
                if not self._block(desk, number, cell, node):
                    break
        # In a study the driver is told nothing that tells the conditions apart.
        desk.state(
            "over",
            text="Thank you. You can close this page.",
            blocks=self.done if self.study is None else [],
        )

    def _consent(self, desk: Desk) -> bool:
        study = self.study
        if study is None or not study.consent:
            return True
        form = {
            "name": "consent",
            "title": study.title,
            "text": study.consent,
            "version": study.consent_version,
            "scales": [],
        }
        answers = desk.answers(form)
        agreed = answers is not None and answers.get("agreed") is True
        self.facts["consent"] = {"version": study.consent_version, "agreed": agreed}
        return agreed

    def _practice(self, desk: Desk, cell: Cell, node: Node, episodes: int) -> bool:
        block = self.built(desk, replace(cell, method=ALONE), node, {})
        try:
            for number in range(episodes):
                layout = seeds.derive("drive-practice", cell.task, cell.value, number)
                while isinstance(
                    driven := block.episode(number, layout, 0, {"practice": True, "of": episodes}),
                    Cut,
                ):
                    if driven.why == END:
                        return False
                    if driven.why == NEXT:
                        break
        finally:
            block.close()
        return True

    def _block(self, desk: Desk, number: int, cell: Cell, node: Node) -> bool:
        config = node.config
        goals = config["success_goals"] or TASKS[cell.task].success_goals
        identity = recorded_cell(self.layout, cell, node.key, self.loaded.spec.name).identity
        record = CellRecord(
            self.layout, node, identity, goals, self._facts(number, cell), self.begun.get(node.key)
        )
        desk.state("loading", block=number + 1, blocks=len(self.blocks))
        block = self.built(desk, cell, node, node.axes["method_config"])
        ended, lost, blurred = False, desk.lost, desk.blurred
        # in a study everyone drives the same worlds
        told = {"block": number + 1, "blocks": len(self.blocks), "skips": self.study is None}
        try:
            while record.finished < config["episodes"] and not ended:
                e = record.finished
                layout = seeds.layout_seed(
                    cell.task, cell.seed, e + (record.skipped if self.study is None else 0)
                )
                own = seeds.method_seed(cell.task, PERSON, cell.seed, e, cell.method)
                outcome = block.episode(e, layout, own, {**told, "of": config["episodes"]})
                if isinstance(outcome, Driven):
                    record.add(outcome, thresholds_of(block.assistant), config["safe_cost"])
                    if self.study is None:  # there it would tell the conditions apart
                        if cell.method != ALONE:
                            desk.state(
                                "loading",
                                text="Your commands are driven once more, without the assistant …",
                            )
                        desk.say(block.review(outcome))
                else:
                    record.cut(outcome)
                    ended = outcome.why == END
        finally:
            block.close()
            record.count(lost_connection=desk.lost - lost, lost_focus=desk.blurred - blurred)
        whole: bool = record.finished == config["episodes"]
        if whole and not self._ask(desk, record):
            plain(f"{node.label}: driven; the next sitting asks its questions")
            return False
        if record.finished:
            # Under the run of the session: one of fewer episodes would be the last of its spec, and
            # its report would show nothing else.
            of = (
                node
                if whole
                else dict(
                    lay_out_over(
                        limited(self.loaded, record.finished).spec, self.layout, None
                    ).cells
                )[cell]
            )
            timing = record.publish(self.run_id, of)
            self.done.append(
                {
                    "label": of.label,
                    "key": of.key,
                    "episodes": record.finished,
                    "of": config["episodes"],
                    **timing,
                }
            )
        return whole

    def _ask(self, desk: Desk, record: CellRecord) -> bool:
        """Ask all questions; False where the driver ends instead."""
        answers: dict[str, dict[str, float]] = {}
        for name in () if self.study is None else self.study.questionnaires:
            scales = [
                {"name": scale, "text": text, "low": low, "high": high}
                for scale, text, low, high in QUESTIONS[name]
            ]
            given = desk.answers({"name": name, "title": "", "text": "", "scales": scales})
            if given is None:
                return False
            answers[name] = {scale["name"]: float(given[scale["name"]]) for scale in scales}
        if answers:
            record.note(answers=answers)
        return True

    def _facts(self, number: int, cell: Cell) -> dict[str, Any]:
        return {
            "participant": self.participant,
            "number": int(cell.value or 0),
            "task": cell.task,
            "simulated": self.how.simulated,
            "block": number,
            "speed": self.how.speed,
            "shown": [name for name in SHOWN if name in self.how.shown],
            "spec": self.loaded.spec.name,
            "study": self.study is not None,
            **self.facts,
        }

    def built(self, desk: Desk, cell: Cell, node: Node, method_config: Mapping[str, Any]) -> Block:
        # As in evaluations: one thread, and memory that is kept. More threads would wait for each
        # other while the page is drawn.
        torch.set_num_threads(1)
        keep_memory()
        require_whole(self.layout, [(needed.kind, needed.key) for needed in node.needs.values()])
        inputs = {
            name: self.layout.artifact(needed.kind, needed.key)
            for name, needed in node.needs.items()
        }
        parts = load_parts(
            inputs, self.loaded.spec.returns, training_device(), motors=TASKS[cell.task].motors
        )
        self.loaded.spec.declare_tasks()
        repeat = self.loaded.spec.repeat_of(cell.task)
        declared = self.loaded.spec.environments.get(cell.task)
        keys = None if declared is None else declared.controls
        block = Block(cell, method_config, repeat, self.how, parts, desk, keys)
        operating = node.needs.get(OPERATING)
        if operating is not None and cell.method != ALONE:
            point = read_point(self.layout, operating.key)
            if point is not None and point.silent:
                plain(silence(point))  # here, and not on the page: a study is blind
        desk.world(block.hello())
        return block


def prepared(
    loaded: Loaded,
    results: Path,
    options: RunOptions,
    participant: int | None,
    how: How,
    *,
    recorded: bool = True,
    trains: bool = True,
) -> Session:
    """Find the cells that a participant (None: the only one) is to drive, and compute or bring in
    everything that they need.

    Unless it is `recorded`, no run stays behind, only what had to be computed. Unless it `trains`,
    models have to be there or published.
    """
    spec, numbers = loaded.spec, drivers(loaded.spec)
    if participant is None and len(numbers) == 1:
        (participant,) = numbers
    if participant not in numbers:
        wrong = (
            "who drives?"
            if participant is None
            else f"'{spec.name}' has no participant {participant}"
        )
        raise UsageError(wrong, f"--participant takes {', '.join(map(str, numbers))}")
    if spec.side_by_side != 1:
        raise UsageError("a person drives one episode at a time", "set side_by_side: 1 in the spec")
    layout = Layout(results.absolute())
    grid = lay_out_over(spec, layout, None)
    read = dict.fromkeys(
        needed.kind
        for cell, node in grid.cells
        for needed in node.needs.values()
        if cell.operator == PERSON
    )
    chosen = [f"stage={'|'.join(read)}"]
    missing = [
        node
        for node in plan_against(grid, layout, wanted=select(grid, chosen)).to_run()
        if node.kind in stages_of("chain")
    ]
    if missing and not trains:
        same = [
            part
            for each in loaded.overrides
            if each.path[0] not in ("seeds", "operators", "episodes")
            for part in ("--set", each.text)
        ]
        command = shlex.join(
            ["wasp", "run", str(SHIPPED), *same, "--select", *chosen, "--results", str(results)]
        )
        wrong = (
            "driving trains nothing, and these are not there: "
            f"{', '.join(node.label for node in missing)}"
        )
        raise UsageError(wrong, f"train them first: {command}")
    # A check that is killed must not pass for the last run of its spec either.
    asked = (
        loaded
        if recorded
        else replace(loaded, spec=spec.model_copy(update={"name": f"{spec.name}-check"}))
    )
    made = run_spec(asked, results, options, chosen)
    made.require_complete()
    mine = cells_of(grid, participant)
    if not recorded:
        discard(layout.run(made.run_id))
        return Session(loaded, layout, made.run_id, ordered(mine, participant), how, spec.study)
    counts = {int(manifest["config"]["episodes"]) for _, manifest in driven(layout, participant)}
    shorter = [
        dict(lay_out_over(limited(loaded, count).spec, layout, None).cells)
        for count in sorted(counts)
        if count < spec.episodes
    ]
    begun: dict[str, Path] = {}
    for cell, node in mine:
        parts = [part[cell] for part in shorter if exists(layout, part[cell].kind, part[cell].key)]
        folders = [layout.artifact(each.kind, each.key) for each in (node, *parts)]
        # No trial of a script passes for a person's session, no free drive for a study's, nor the
        # other way round; no part either.
        for before in filter(
            None,
            (read_record(folder / SESSION_FILE) for folder in (*folders, layout.work(node.key))),
        ):
            elsewhere = (spec.study is not None or before.get("study", False)) and before.get(
                "spec"
            ) != spec.name
            if elsewhere or before.get("simulated", False) != how.simulated:
                by = (
                    f"for '{before.get('spec')}'"
                    if elsewhere
                    else "by a person"
                    if how.simulated
                    else "by a script"
                )
                hint = "use another folder with --results, or delete it: --participant N --withdraw"
                raise UsageError(f"{node.label} was driven {by} in '{layout.root}'", hint)
        # before anybody drives: what is damaged ends no session, and no session replaces it
        if not exists(layout, node.kind, node.key):
            own = [node] if (folders[0] / SESSION_FILE).exists() else parts[-1:]
            require_whole(layout, [(each.kind, each.key) for each in (*own, *node.needs.values())])
            begun.update((node.key, folder) for folder in folders[1:])  # the longest comes last
    run_id = new_run(layout, loaded, plan_against(grid, layout))
    return Session(loaded, layout, run_id, ordered(mine, participant), how, spec.study, begun=begun)


def shipped(
    task: str,
    methods: Sequence[str],
    participant: int,
    seeds: Sequence[int],
    preset: str | None = None,
    settings: Sequence[str] = (),
) -> Loaded:
    """Return the spec behind `wasp drive TASK`; seeds are sessions, and without a preset the
    models are those that are published.
    """
    sizes = []
    if preset is not None:
        # A preset sizes what is trained, and not how long a person sits there.
        sizes = [f"preset={preset}", f"episodes={load(SHIPPED).spec.episodes}"]
    return load(
        SHIPPED,
        [
            *sizes,
            f"tasks=[{task}]",
            f"methods=[{', '.join(methods)}]",
            f"seeds=[{', '.join(map(str, seeds))}]",
            f"operators={{{PERSON}: {{p{participant}: {participant}}}}}",
            *settings,
        ],
    )


def participants(spec: Spec) -> dict[int, str]:
    return {int(value): name for name, value in spec.operators.get(PERSON, {}).items()}


def drivers(spec: Spec) -> dict[int, str]:
    """Return `participants`; UsageError where there is none."""
    if found := participants(spec):
        return found
    raise UsageError(
        f"nobody drives in '{spec.name}'",
        "name participants in it: operators: {person: {p1: 1, p2: 2}}, with side_by_side: 1",
    )


def cells_of(grid: Grid, participant: int) -> list[tuple[Cell, Node]]:
    return [
        (cell, node)
        for cell, node in grid.cells
        if cell.operator == PERSON and cell.value == participant
    ]


def ordered(cells: list[tuple[Cell, Node]], participant: int) -> list[tuple[Cell, Node]]:
    """Return the cells of a participant task by task; within a task, and for each seed, in the
    participant's row of a Williams square.
    """
    groups: dict[tuple[str, int], list[tuple[Cell, Node]]] = {}
    for cell, node in cells:
        groups.setdefault((cell.task, cell.seed), []).append((cell, node))
    return [
        group[place]
        for group in groups.values()
        for place in balanced_order(len(group), participant - 1)
    ]


def driven_by(manifest: Mapping[str, Any], participant: int | None) -> bool:
    axes = manifest.get("axes", {})
    return axes.get("operator") == PERSON and participant in (None, axes.get("value"))


def driven(layout: Layout, participant: int | None = None) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield key and manifest of what a participant, or anybody, drove."""
    for key in sorted(stored_keys(layout, "evaluate")):
        manifest = read_manifest(layout, "evaluate", key)
        if driven_by(manifest, participant):
            yield key, manifest


def driven_tasks(results: Path, participant: int) -> list[str]:
    """Return the tasks of which a participant has driven anything; a UsageError where there is
    none.
    """
    tasks = {
        str(manifest.get("task")) for _, manifest in driven(Layout(results.absolute()), participant)
    }
    if not tasks:
        raise UsageError(
            f"participant {participant} has driven nothing in '{results}'",
            f"wasp drive TASK --participant {participant}",
        )
    return sorted(tasks)


def free_session(layout: Layout, of: Callable[[int], Loaded]) -> int:
    """Return the first number of a session whose worlds nobody has driven in these cells yet,
    or one that ended early and goes on.
    """
    # episodes by cell; a whole one counts as endless, however many were asked for
    most: dict[str, float] = {}
    for key, manifest in driven(layout):
        cuts, episodes = (
            (read_record(layout.artifact("evaluate", key) / SESSION_FILE) or {}).get("cut", ()),
            manifest["config"]["episodes"],
        )
        early = any(cut["why"] == END and cut["before_episode"] == episodes for cut in cuts)
        cell = canonical([manifest["task"], manifest["seed"], manifest["axes"]])
        most[cell] = max(most.get(cell, 0), episodes if early else math.inf)
    for number in itertools.count():
        nodes = [node for _, node in lay_out_over(of(number).spec, layout, None).cells]
        if all(
            most.get(canonical([node.task, node.seed, node.axes]), 0) < node.config["episodes"]
            for node in nodes
        ):
            break
    return number


class CellRecord:
    def __init__(
        self,
        layout: Layout,
        node: Node,
        identity: CellIdentity,
        goals: int,
        facts: Mapping[str, Any],
        begun: Path | None = None,
    ) -> None:
        self._layout, self._node, self._identity, self._goals = layout, node, identity, goals
        self._folder = layout.work(node.key)
        self._folder.mkdir(parents=True, exist_ok=True)
        if begun is not None and not (self._folder / EPISODES_FILE).exists():
            for name in (TIMING_FILE, SESSION_FILE, STEPS_FILE, EPISODES_FILE):
                shutil.copyfile(begun / name, self._folder / name)
        earlier = self._earlier()
        self.finished = 0 if earlier is None else len(earlier.episodes)
        self._session = {
            **(read_record(self._folder / SESSION_FILE) or {"cut": [], "sittings": []}),
            **facts,
        }
        # a later sitting may have another speed
        how = {name: facts[name] for name in ("speed", "shown") if name in facts}
        self._session["sittings"].append({"begun": _now(), "first_episode": self.finished, **how})
        self.note()

    @property
    def skipped(self) -> int:
        return sum(cut["why"] == NEXT for cut in self._session["cut"])

    def _earlier(self) -> Any:
        return first_rows(self._folder, 1) if (self._folder / EPISODES_FILE).exists() else None

    def add(self, driven: Driven, thresholds: Thresholds, safe_cost: float) -> None:
        row = episode_metrics(
            driven.trajectory, self._goals, safe_cost, TASKS[self._identity.task].motors.force
        )
        count = len(driven.beats)
        columns: dict[str, list[Any]] = {
            "episode": [self.finished] * count,
            "t": list(range(count)),
        }
        columns |= {name: [getattr(beat, name) for beat in driven.beats] for name in Beat._fields}
        rows = pa.table(
            {
                field.name: pa.array(columns[field.name], field.type, from_pandas=True)
                for field in BEAT
            },
            schema=BEAT,
        )
        # The timing first: an episode counts once its rows are there, and the timing of one that
        # does not is written again.
        write_table(pa.concat_tables([self._timing(), rows]), self._folder / TIMING_FILE)
        write_cell(
            self._folder,
            self._identity,
            [driven.trajectory],
            [row],
            thresholds,
            [driven.decision_ms],
            [driven.layout],
            self._earlier(),
        )
        sitting = self._session["sittings"][-1]
        sitting["pauses"] = sitting.get("pauses", 0) + driven.pauses
        sitting["paused_seconds"] = sitting.get("paused_seconds", 0) + round(
            driven.paused_seconds, 1
        )
        sitting["ended"] = _now()
        self.note()
        self.finished += 1

    def cut(self, cut: Cut) -> None:
        self._session["cut"].append({"before_episode": self.finished, **asdict(cut)})
        self.note()

    def count(self, **more: int) -> None:
        self.note(**{name: self._session.get(name, 0) + number for name, number in more.items()})

    def note(self, **facts: Any) -> None:
        self._session |= facts
        write_record(self._folder / SESSION_FILE, self._session)

    def _timing(self) -> pa.Table:
        path = self._folder / TIMING_FILE
        known = read_timing(path) if path.exists() else BEAT.empty_table()
        return known.filter(pc.less(known["episode"], self.finished))

    def publish(self, run_id: str, node: Node) -> dict[str, Any]:
        summary = timing_summary(self._timing())
        numbers = read_episodes([self._folder / EPISODES_FILE])
        shown = {"return": ("return", 2), "cost": ("cost", 1), "int": ("int_rate", 3)}
        measures = {
            name: round(float(np.mean(numbers[column])), digits)
            for name, (column, digits) in shown.items()
        }
        begun = str(self._session["sittings"][0]["begun"])
        seconds = float(self._timing()["at"].to_numpy().max(initial=0.0))
        manifest = manifest_of(
            job_of(self._layout, run_id, node),
            {**measures, "late": summary["late_share"]},
            seconds,
            begun,
        )
        # whose lock is held: nobody takes it for what a killed process left
        staging = staging_folder(self._layout, self._node.key)
        shutil.copytree(self._folder, staging, dirs_exist_ok=True)
        place = self._layout.artifact(node.kind, node.key)
        # The same episodes may be there, with less that is known of them: this sitting skipped
        # worlds or paused, and finished nothing.
        if (before := read_record(place / SESSION_FILE)) and before["sittings"] == self._session[
            "sittings"
        ][: len(before["sittings"])]:
            discard(place)
        commit(self._layout, node.kind, node.key, staging, manifest)
        shutil.rmtree(self._folder, ignore_errors=True)
        return summary


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
