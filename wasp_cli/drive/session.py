"""A session: who drives which cells, in which order, and what is asked between them.

Cells that are there are not driven again, so a session that broke off goes on where it was. A block
becomes a cell like any other, with two more files about the clock and the connection
(`store.people`). `CellRecord` writes every finished episode to disk before the next one begins. A
block that ends early becomes the cell of as many episodes as were finished, so that it is never
taken for the whole cell; if the session is continued, it starts with these episodes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from wasp_cli import seeds
from wasp_cli.cells.cell import recorded_cell
from wasp_cli.console import plain
from wasp_cli.drive.block import ALONE, SHOWN, Block, Cut, Driven, How
from wasp_cli.drive.desk import END, NEXT, Desk
from wasp_cli.drive.record import CellRecord
from wasp_cli.errors import UsageError
from wasp_cli.learning.assistants import load_parts
from wasp_cli.learning.device import training_device
from wasp_cli.operators.registry import PERSON
from wasp_cli.plan.grid import OPERATING
from wasp_cli.plan.node import Cell, Node
from wasp_cli.plan.reuse import lay_out_over
from wasp_cli.report.operating import read_point, silence
from wasp_cli.run.worker import keep_memory, require_whole
from wasp_cli.spec.load import Loaded, limited
from wasp_cli.spec.study import QUESTIONS, StudyConfig
from wasp_cli.stages.evaluate import thresholds_of
from wasp_cli.store.artifact import (
    exists,
)
from wasp_cli.store.layout import Layout
from wasp_cli.store.lock import held_if_free
from wasp_cli.tasks.registry import TASKS


@dataclass
class Session:
    """Leads a driver through the cells that are theirs: consent, practice, blocks, questions."""

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
        """The name of the participant in the spec."""
        return str(self.blocks[0][0].severity)

    def run(self, desk: Desk) -> None:
        """Lead the driver through consent, practice, blocks and questions, until everything is
        driven or the driver ends.

        Raises:
            UsageError: a cell is driven in another window.
        """
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
        # In a study the driver must not learn what the conditions were.
        blocks = []
        if self.study is None:
            blocks = self.done
        desk.state("over", text="Thank you. You can close this page.", blocks=blocks)

    def _consent(self, desk: Desk) -> bool:
        """Ask for consent where a study needs it; False where it is not given."""
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
        """Let the driver practise without an assistant; False where the driver ends."""
        block = self.built(desk, replace(cell, method=ALONE), node, {})
        try:
            for number in range(episodes):
                layout = seeds.derive("drive-practice", cell.task, cell.value, number)
                outcome: Driven | Cut | None = None
                while outcome is None or (isinstance(outcome, Cut) and outcome.why != NEXT):
                    outcome = block.episode(number, layout, 0, {"practice": True, "of": episodes})
                    if isinstance(outcome, Cut) and outcome.why == END:
                        return False
        finally:
            block.close()
        return True

    def _block(self, desk: Desk, number: int, cell: Cell, node: Node) -> bool:
        """Let the driver drive a cell, and store the episodes that were finished. Returns False if
        the driver ended early, or did not answer the questions.
        """
        # The record, and the world with its assistant.
        config = node.config
        goals = config["success_goals"] or TASKS[cell.task].success_goals
        identity = recorded_cell(self.layout, cell, node.key, self.loaded.spec.name).identity
        facts = self._facts(number, cell)
        begun = self.begun.get(node.key)
        record = CellRecord(self.layout, node, identity, goals, facts, begun)
        desk.state("loading", block=number + 1, blocks=len(self.blocks))
        block = self.built(desk, cell, node, node.axes["method_config"])
        lost = desk.lost
        blurred = desk.blurred
        ended = False

        # The episodes. In a study everyone drives the same worlds, and no review shows what the
        # assistant did.
        free = self.study is None
        page_facts = {"block": number + 1, "blocks": len(self.blocks), "skips": free}
        try:
            while record.finished < config["episodes"] and not ended:
                e = record.finished
                world = e + record.skipped if free else e
                layout = seeds.layout_seed(cell.task, cell.seed, world)
                own = seeds.method_seed(cell.task, PERSON, cell.seed, e, cell.method)
                outcome = block.episode(e, layout, own, {**page_facts, "of": config["episodes"]})
                if isinstance(outcome, Cut):
                    record.cut(outcome)
                    ended = outcome.why == END
                    continue
                record.add(outcome, thresholds_of(block.assistant), config["safe_cost"])
                if not free:
                    continue
                if cell.method != ALONE:
                    text = "Your commands are driven once more, without the assistant …"
                    desk.state("loading", text=text)
                desk.say(block.review(outcome))
        finally:
            block.close()
            record.count(lost_connection=desk.lost - lost, lost_focus=desk.blurred - blurred)

        # The questions, and the artifact.
        whole: bool = record.finished == config["episodes"]
        if whole and not self._ask(desk, record):
            plain(f"{node.label}: driven; the next sitting asks its questions")
            return False
        if record.finished:
            driven_node = node if whole else self._part(cell, record.finished)
            # It belongs to the run of the session. A run of fewer episodes would be the last one of
            # its spec, and a report would show nothing else.
            timing = record.publish(self.run_id, driven_node)
            self.done.append(
                {
                    "label": driven_node.label,
                    "key": driven_node.key,
                    "episodes": record.finished,
                    "of": config["episodes"],
                    **timing,
                }
            )
        return whole

    def _part(self, cell: Cell, episodes: int) -> Node:
        """The node of the first episodes of a cell."""
        part = limited(self.loaded, episodes)
        return dict(lay_out_over(part.spec, self.layout, None).cells)[cell]

    def _ask(self, desk: Desk, record: CellRecord) -> bool:
        """Ask all questions of a study; False if the driver ends instead."""
        answers: dict[str, dict[str, float]] = {}
        if self.study is None:
            return True
        for name in self.study.questionnaires:
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
        """What is recorded of a block beside its episodes."""
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
        """Load the models of a cell, and build its world and its assistant. The page is sent the
        block.

        Raises:
            StoreError: an input is damaged.
        """
        # One thread and kept memory, as in evaluations. More threads would wait for each other
        # while the page is drawn.
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
                plain(silence(point))  # in the terminal, not on the page: a study is blind
        desk.world(block.hello())
        return block
