"""`wasp clone`: a policy fitted to what a participant commanded, which then drives in the grid.

The sessions are played again for what the world model saw. Every fourth episode is held out, to
compare the clone with baselines that need no learning: the last command again, the command of the
expert, and uniform commands. K decisions, F features, A actions.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from rich.table import Table as RichTable
from torch import Tensor

from wasp_cli.console import count_table, plain, say, waiting_aloud
from wasp_cli.drive.participants import driven
from wasp_cli.errors import UsageError
from wasp_cli.learning.clone import Issued, fit_clone
from wasp_cli.learning.configs.latent import CloneConfig
from wasp_cli.learning.rerun import Recorded, Rerun
from wasp_cli.models.clone import REPEAT, Clone
from wasp_cli.models.policy import load_skills
from wasp_cli.models.weights import save_weights
from wasp_cli.models.world_model import load_world_model
from wasp_cli.operators.base import Policy
from wasp_cli.operators.registry import PERSON
from wasp_cli.plan.grid import CLONE, OPERATOR_CLONE
from wasp_cli.plan.keys import canonical
from wasp_cli.plan.node import Node
from wasp_cli.plan.reuse import lay_out_over
from wasp_cli.run.runner import job_of
from wasp_cli.run.session import RunOptions, run_spec
from wasp_cli.run.worker import manifest_of, require_whole
from wasp_cli.seeds import derive
from wasp_cli.spec.load import Loaded
from wasp_cli.store import lock
from wasp_cli.store.artifact import (
    commit,
    discard,
    exists,
    read_manifest,
    staging_folder,
    stored_keys,
)
from wasp_cli.store.layout import Layout
from wasp_cli.store.people import SESSION_FILE
from wasp_cli.store.recorded import read_recorded
from wasp_cli.store.records import read_record
from wasp_cli.store.tables import cell_file
from wasp_cli.tasks.declared import declare_from
from wasp_cli.tasks.make import make_task
from wasp_cli.video.trace import SaidAgain, threads_of_evaluations

FEWEST = 4  # episodes that are needed
HELD_OUT = 4  # every episode of this number is held out
ROUNDS = 50  # of expectation and maximisation, in `fitted_mixture`


def clone_participant(
    loaded: Loaded, results: Path, participant: int, options: RunOptions
) -> dict[str, Any]:
    """Fit a clone to everything that a participant drove on a task with the models of a spec, and
    store it where plans look for it.

    Args:
        loaded: a spec of one cell, in which the clone drives.
        options: for models that are not here yet.

    Returns:
        Label, key and quality of the clone, as JSON values.

    Raises:
        UsageError: the participant drove too little with these models, or results were computed
            from an earlier clone.
    """
    layout = Layout(results.absolute())
    ((_, evaluation),) = lay_out_over(loaded.spec, layout, None).cells
    node = evaluation.needs[OPERATOR_CLONE]
    keys = _driven_with(layout, node, participant)
    _require_unused(layout, node)

    # The models that it reads. The run has a name of its own: under the name of the spec it would
    # be its last run, and a report would not show what was driven.
    asked = replace(
        loaded, spec=loaded.spec.model_copy(update={"name": f"{loaded.spec.name}-clone"})
    )
    made = run_spec(asked, results, options, ["stage=world_model|policies"])
    made.require_complete()
    read = [(kind, node.needs[kind].key) for kind in ("world_model", "policies")]
    require_whole(layout, [*read, *(("evaluate", key) for key in keys)])

    # The episodes, of which every fourth one is held out; and the clone, fitted to the others.
    model = load_world_model(layout.artifact("world_model", node.needs["world_model"].key))
    skills = load_skills(layout.artifact("policies", node.needs["policies"].key))
    with threads_of_evaluations():
        episodes = [episode for key in keys for episode in _episodes(layout, key, node, model)]
        if len(episodes) < FEWEST:
            drove = (
                f"participant {participant} drove {len(episodes)} episodes of {node.task} with "
                "these models"
            )
            raise UsageError(
                f"{drove}, and {FEWEST} are needed",
                f"wasp drive {node.task} --participant {participant}",
            )
        held = episodes[HELD_OUT - 1 :: HELD_OUT]
        learnt = [
            episode for number, episode in enumerate(episodes) if number % HELD_OUT != HELD_OUT - 1
        ]
        config = CloneConfig.model_validate(node.config)
        torch.manual_seed(derive("clone-weights", node.task, node.seed, PERSON, participant))
        stream = derive("clone", node.task, node.seed, PERSON, participant)
        clone, curve = fit_clone(
            together(learnt),
            skills.expert,
            config,
            stream,
            lambda share, text: plain(text) if share == 1 else None,
        )

    # How good it is.
    sessions = [read_record(layout.artifact("evaluate", key) / SESSION_FILE) for key in keys]
    document = {
        "participant": participant,
        "cells": keys,
        "simulated": any((session or {}).get("simulated", False) for session in sessions),
        "episodes": len(learnt),
        "heldout_episodes": len(held),
        "decisions": sum(len(episode.command) for episode in learnt),
        "ways": dict(
            zip(("repeat", "own", "uniform"), clone.weight_logits.softmax(-1).tolist(), strict=True)
        ),
        "models": judged(clone, skills.expert, together(learnt), together(held)),
    }
    models = cast(dict[str, dict[str, float]], document["models"])
    summary = {
        f"{name}_{figure}": round(number, 3)
        for name, row in models.items()
        for figure, number in row.items()
    }

    # The artifact, in the place of an earlier one.
    begun = read_manifest(layout, "evaluate", keys[0])["provenance"]["started_at"]
    arguments = {
        "features": learnt[0].features.shape[1],
        "hidden": list(config.hidden),
        "action": learnt[0].command.shape[1],
    }
    with lock.held(
        layout.lock(node.key),
        waiting_aloud(f"{node.label} is being written by another process; waiting"),
    ):
        staging = staging_folder(layout, node.key)
        save_weights(clone, staging / "clone.safetensors", **arguments)
        (staging / "curve.json").write_text(json.dumps(curve, indent=1))
        (staging / "quality.json").write_text(json.dumps(document, indent=1))
        if exists(layout, CLONE, node.key):
            say(f"{node.label}: fitted again; the earlier one is replaced")
            discard(layout.artifact(CLONE, node.key))
        commit(
            layout,
            CLONE,
            node.key,
            staging,
            manifest_of(job_of(layout, made.run_id, node), summary, 0.0, begun),
        )
    discard(layout.run(made.run_id))
    return {"label": node.label, "key": node.key, **document}


def quality_table(document: Mapping[str, Any]) -> RichTable:
    """Return how likely the held-out commands are under the clone and under each baseline, as a
    table.
    """
    held = document["heldout_episodes"]
    learnt = document["episodes"]
    table = count_table(
        f"on {held} held-out episode{'' if held == 1 else 's'}, learnt from {learnt}",
        "log-density",
        "squared error",
    )
    for name, row in document["models"].items():
        table.add_row(name, f"{row['log_density']:.2f}", f"{row['squared_error']:.3f}")
    return table


def _driven_with(layout: Layout, node: Node, participant: int) -> list[str]:
    """Keys of the cells that a participant drove with the models that the clone reads, in
    ascending order.
    """
    models = {name: needed.key for name, needed in node.needs.items()}
    # by seed and condition: a sitting that was continued has its first episodes in two cells
    whole: dict[str, tuple[int, str]] = {}
    others = 0
    for key, manifest in driven(layout, participant):
        if manifest.get("task") == node.task:
            same = all(
                manifest.get("upstream", {}).get(name) == needed for name, needed in models.items()
            )
            same &= manifest.get("settings", {}).get("action_repeat") == node.settings.get(
                "action_repeat"
            )
            if same:
                cell = canonical([manifest["seed"], manifest["axes"]])
                whole[cell] = max(
                    whole.get(cell, (0, "")), (int(manifest["config"]["episodes"]), key)
                )
            others += not same
    if not whole:
        more = ""
        if others:
            more = f"; {others} cells of theirs were driven with other models: --preset or --set"
        drove = (
            f"participant {participant} has driven nothing of {node.task} in '{layout.root}'{more}"
        )
        raise UsageError(drove, f"wasp drive {node.task} --participant {participant}")
    return sorted(key for _, key in whole.values())


def _require_unused(layout: Layout, node: Node) -> None:
    """Raise UsageError if a result was computed from an earlier clone under this key: it would seem
    to come from the new one.
    """
    if not exists(layout, node.kind, node.key):
        return
    using = []
    for kind in ("evaluate", "counterfactual", CLONE):
        for key in sorted(stored_keys(layout, kind)):
            manifest = read_manifest(layout, kind, key)
            if node.key in manifest.get("upstream", {}).values():
                using.append(str(manifest.get("label")))
    if using:
        more = f" and {len(using) - 1} more" if len(using) > 1 else ""
        hint = "use another results folder, or delete these results first"
        raise UsageError(f"{using[0]}{more} was computed from the clone that is there", hint)


def _episodes(layout: Layout, key: str, node: Node, model: Any) -> list[Issued]:
    recorded = Recorded(**read_recorded(cell_file(layout.artifact("evaluate", key))))
    episodes = []
    declare_from(node.task, node.settings)
    for e in range(len(recorded.a)):
        own = recorded.of(range(e, e + 1))
        world = make_task(
            node.task, 1, action_repeat=node.settings["action_repeat"], observe=(model.reads,)
        )
        moments = Rerun(world, model, SaidAgain(own, world.action_size), own)
        pairs = [(moment.latent.features[0].clone(), moment.a_h[0].clone()) for moment in moments]
        features = torch.stack([f for f, _ in pairs])
        command = torch.stack([a for _, a in pairs])
        last = torch.cat([torch.full_like(command[:1], torch.nan), command[:-1]])
        # What was computed without gradients cannot be learned from as it is.
        episodes.append(Issued(features.clone(), command.clone(), last))
    return episodes


def together(episodes: Sequence[Issued]) -> Issued:
    """Join the decisions of several episodes: [K, ...] each."""
    return Issued(*(torch.cat(parts) for parts in zip(*episodes, strict=True)))


@torch.no_grad()
def judged(
    clone: Clone, expert: Policy, learnt: Issued, held: Issued
) -> dict[str, dict[str, float]]:
    """Return the mean log-density and squared error of held-out decisions, for the clone and each
    baseline. The first decision of an episode does not count: it has no last command.
    """

    def later(seen: Issued) -> Issued:
        keep = ~seen.last.isnan().any(-1)
        return Issued(*(values[keep] for values in seen))

    learnt = later(learnt)
    held = later(held)
    right = expert(held.features)
    foretold = {
        "clone": (
            clone.log_density(held.command, held.features, held.last, right),
            clone.mean(held.features, held.last, right),
        )
    }
    for name, before, now in (
        ("repeat", learnt.last, held.last),
        ("expert", expert(learnt.features), right),
    ):
        foretold[name] = (
            mixture_density(held.command - now, *fitted_mixture(learnt.command - before)),
            now,
        )
    uniform = torch.full((len(held.command),), -held.command.shape[1] * math.log(2.0))
    foretold["uniform"] = uniform, torch.zeros_like(held.command)
    return {
        name: {
            "log_density": float(density.mean()),
            "squared_error": float((mean - held.command).square().sum(-1).mean()),
        }
        for name, (density, mean) in foretold.items()
    }


def fitted_mixture(residual: Tensor) -> tuple[Tensor, float]:
    """Fit residuals [K, A] by a mixture of a normal around zero and a uniform density, with ROUNDS
    of expectation and maximisation. Returns the spread [A] of the normal and its share.
    """
    spread = residual.square().mean(0).sqrt().clamp(REPEAT, 1.0)
    share = 0.5
    for _ in range(ROUNDS):
        near = share * _normal(residual, spread)
        own = near / (near + (1 - share) * 0.5 ** residual.shape[1])
        share = float(own.mean().clamp(0.001, 0.999))
        spread = (
            ((own.unsqueeze(-1) * residual.square()).sum(0) / own.sum().clamp_min(1e-6))
            .sqrt()
            .clamp(REPEAT, 1.0)
        )
    return spread, share


def mixture_density(residual: Tensor, spread: Tensor, share: float) -> Tensor:
    """Return the log-density [K] of residuals [K, A] under `fitted_mixture`."""
    return (share * _normal(residual, spread) + (1 - share) * 0.5 ** residual.shape[1]).log()


def _normal(residual: Tensor, spread: Tensor) -> Tensor:
    return torch.exp(-0.5 * (residual / spread).square().sum(-1)) / float(
        np.prod(spread.numpy() * math.sqrt(2 * math.pi))
    )
