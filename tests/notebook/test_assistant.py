"""`wasp_cli.load_assistant`: which assistant a text means, and that it decides in anybody's loop as
it does in evaluations.
"""

import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import wasp_cli
from tests.artifacts import tiny_artifacts
from tests.notebook.assistants import (
    PUBLISHED,
    PUDDLE,
    Episodes,
    evaluated,
    puddle_assistant,
    seeds_of,
    short_episodes,
)
from wasp_cli.errors import ArtifactError, StoreError, TaskError, UnknownName, UsageError
from wasp_cli.learning.configs import ReturnsConfig
from wasp_cli.notebook.assistant import LoadedAssistant
from wasp_cli.notebook.perceived import perceived, require_size
from wasp_cli.store.layout import Layout
from wasp_cli.tasks.make import make_task


@pytest.fixture(scope="module")
def ida() -> LoadedAssistant:
    """Of race1."""
    return wasp_cli.load_assistant(PUBLISHED, "race1 s1 ida")


def driven(assistant: LoadedAssistant, operator: str, value: float, episodes: int) -> Episodes:
    """Episodes of a loop of one's own around a task, side by side."""
    task = make_task(assistant.task, episodes, action_repeat=4, observe=("pixels",))
    worlds, mistakes, own = zip(
        *(seeds_of(assistant, operator, e) for e in range(episodes)), strict=True
    )
    seen = task.reset(worlds)
    assistant.reset(own, assistant.operator(operator, value, mistakes))
    rows: list[tuple[Any, ...]] = []
    ended = np.zeros(episodes, bool)
    while not ended.all():
        decision = assistant.act(seen)
        step = task.step(decision.action)
        rows.append((decision, step.reward.astype(np.float32), ~ended))
        if (step.ended & ~ended).any():
            assistant.rest(step.ended)
        seen, ended = step.observation, step.ended.copy()

    def of(e: int, values: list[Any]) -> Any:
        return [value[e] for value, (_, _, alive) in zip(values, rows, strict=True) if alive[e]]

    decisions, rewards, _ = zip(*rows, strict=True)
    each = range(episodes)
    return Episodes(
        [np.array(of(e, [d.command for d in decisions])) for e in each],
        [np.array(of(e, [d.action for d in decisions])) for e in each],
        [np.array(of(e, list(rewards))) for e in each],
        [[str(gate) for gate in of(e, [d.gate for d in decisions])] for e in each],
        [np.array(of(e, [d.predicted_cost for d in decisions]), np.float32) for e in each],
    )


# -- the same episodes as those of `wasp run` ------------------------------------------------------


def test_episodes_side_by_side_are_those_of_an_evaluation_to_the_bit(
    ida: LoadedAssistant, tmp_path: Path
) -> None:
    with short_episodes(60):
        expected = evaluated(ida, "laggy", 0.7, tmp_path, episodes=3)
        found = driven(ida.another(batch=3), "laggy", 0.7, 3)
    found.require_same(expected)
    assert "method" in found.gate[0]
    assert len({len(gates) for gates in found.gate}) > 1, "all end together: nothing rests"


def test_a_loaded_assistant_begins_each_episode_anew(ida: LoadedAssistant) -> None:
    assistant = ida.another(batch=2)
    with short_episodes(5):
        first = driven(assistant, "noisy", 0.45, 2)
        driven(assistant, "laggy", 0.7, 2)
        driven(assistant, "noisy", 0.45, 2).require_same(first)


def test_a_row_of_a_batch_begins_anew_alone(ida: LoadedAssistant) -> None:
    task = make_task("race1", 2, action_repeat=4, observe=("pixels",))
    assistant, command = ida.another(batch=2), np.array([[1.0, 0.8], [0.2, 1.0]])
    assistant.reset([1, 2])
    start = task.reset([5, 5])
    first = assistant.act(start, command)
    seen = task.step(first.action).observation
    assistant.act(seen, command)
    assistant.reset([1, 1], rows=[False, True])
    assistant.see(np.stack([seen.pixels[0], start.pixels[1]]))
    again = assistant.features
    assistant.reset([1, 2])
    assistant.see(start)
    assert np.array_equal(again[1], assistant.features[1])
    assert not np.array_equal(again[0], assistant.features[0])


def test_commands_come_from_outside() -> None:
    task = make_task("race1", 1, action_repeat=4, observe=("pixels",))
    seen = task.reset([3])
    for method, changes in (("human", False), ("diffusion", True)):
        assistant = wasp_cli.load_assistant(PUBLISHED, f"race1 s1 {method}")
        assistant.reset(seed=0)
        decision = assistant.act(seen, [1.7, -0.5])
        assert np.array_equal(decision.command, np.float32([1.0, -0.5])), "clipped"
        assert decision.intervened is changes
        assert (decision.action == decision.command).all() == (not changes)
        assert decision.gate == ("method" if changes else "none")
        assert np.isnan(decision.predicted_cost)
        assert decision.ms > 0


def test_a_decision_is_plain_values(ida: LoadedAssistant) -> None:
    pixels = make_task("race1", 1, observe=("pixels",)).reset([3]).pixels
    one, many = ida.another(), ida.another(batch=1)
    one.reset(0)
    many.reset([0])
    alone, row = one.act(pixels[0], np.zeros(2)), many.act(pixels, np.zeros((1, 2)))
    for name in ("gate", "intervened", "predicted_cost", "predicted_gain", "signal"):
        assert type(getattr(alone, name)) in (str, bool, float)
        assert getattr(row, name).shape == (1,)
    assert (alone.action.dtype, alone.action.shape) == (np.float32, (2,))
    assert np.array_equal(alone.action, row.action[0])
    assert one.features.shape == many.features.shape[1:]


def test_torch_is_left_as_it_was(ida: LoadedAssistant) -> None:
    pixels = make_task("race1", 1, observe=("pixels",)).reset([3]).pixels[0]
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        assistant = ida.another()
        assistant.reset(0)
        assistant.act(pixels, np.zeros(2))
        assert torch.get_num_threads() == 2
        assert not torch.is_inference_mode_enabled()
    finally:
        torch.set_num_threads(before)


def test_a_search_ends_where_time_is_up() -> None:
    """At these states of `printed` a search takes many times the time that it is given."""
    assistant = wasp_cli.load_assistant(PUBLISHED, "goal1 s1 printed candidates=64")
    with short_episodes(6):
        whole = driven(assistant.another(batch=1), "limited-skill", 0.25, 1)
        hurried = assistant.another(batch=1)
        hurried.within(1.0)
        cut = driven(hurried, "limited-skill", 0.25, 1)
    assert "safety" in whole.gate[0]
    assert not np.array_equal(whole.a[0], cut.a[0]), "the search went on"
    with pytest.raises(UsageError, match="no time in milliseconds"):
        hurried.within(-1.0)


# -- which assistant is meant ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "label", "tau_c"),
    [
        ("goal1 s1 wasp", "goal1 s1 wasp", 0.5),
        ("WASP, Goal1, seed 1, tau_c=1", "goal1 s1 wasp", 1.0),
        ("goal1 s313 wasp", "goal1 s1 wasp", 1.0),  # cells with worlds of another seed
        ("goal1 s1 wasp noisy=0.45", "goal1 s1 wasp", 0.5),
        ("goal1 wasp noisy=0.45 seed 1", "goal1 s1 wasp", 0.5),  # as reports name a cell
        ("wasp/SafetyPointGoal1-v0 wasp/no-case2", "goal1 s1 wasp/no-case2", 0.5),
        ("task=goal1 method=wasp variant=safety-only", "goal1 s1 wasp/safety-only", 0.5),
    ],
)
def test_a_text_names_an_assistant(text: str, label: str, tau_c: float) -> None:
    assistant = wasp_cli.load_assistant(PUBLISHED, text)
    assert (assistant.label, assistant.settings["tau_c"]) == (label, tau_c)
    assert (assistant.task, assistant.action_repeat, assistant.action_size) == ("goal1", 4, 2)


def test_a_cell_names_its_assistant() -> None:
    cell = wasp_cli.results(PUBLISHED).cell("race1 s1 wasp/no-case2 laggy=0.7")
    assert wasp_cli.load_assistant(PUBLISHED, cell.key[:8]).label == "race1 s1 wasp/no-case2"


def test_what_several_share_is_told_with_what_they_differ_in() -> None:
    with pytest.raises(UsageError, match="has 2 assistants 'goal1 s1 printed'") as told:
        wasp_cli.load_assistant(PUBLISHED, "goal1 s1 printed")
    assert "candidates=300" in told.value.message
    assert "candidates=64" in told.value.message
    with pytest.raises(UsageError, match=r"assistants 'wasp'[^$]*race1 s1 wasp"):
        wasp_cli.load_assistant(PUBLISHED, "wasp")


def test_what_is_not_there_is_told_with_what_makes_it(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="no such folder"):
        wasp_cli.load_assistant(tmp_path / "nowhere", "goal1 s1 wasp")
    with pytest.raises(UnknownName, match="'goal7' is no task"):
        wasp_cli.load_assistant(PUBLISHED, "goal7 s1 wasp")
    with pytest.raises(UsageError, match="no assistant 'goal1 s1 qcbf'") as told:
        wasp_cli.load_assistant(PUBLISHED, "goal1 s1 qcbf")
    assert "--select 'task=goal1,seed=1,method=qcbf'" in str(told.value.hint)
    with pytest.raises(ArtifactError, match=r"has no .*world_model") as told_missing:
        wasp_cli.load_assistant(PUBLISHED, "goal1 s2 wasp")  # its rows alone are published
    assert "--select 'task=goal1,seed=2,method=wasp'" in str(told_missing.value.hint)


def test_a_copied_folder_without_runs_has_its_assistants(
    artifacts: Mapping[str, Path], tmp_path: Path
) -> None:
    puddle_assistant(artifacts, tmp_path / "before")
    (tmp_path / "before").rename(tmp_path / "moved")
    assistant = wasp_cli.load_assistant(tmp_path / "moved")
    assert assistant.label == f"{PUDDLE} s0 ida"
    assert wasp_cli.load_assistant(tmp_path / "moved", "ida Puddle-v0").label == assistant.label


def test_a_folder_of_models_alone_has_the_assistant_that_was_calibrated(
    artifacts: Mapping[str, Path], tmp_path: Path
) -> None:
    puddle_assistant(artifacts, tmp_path, cell=False)
    assert wasp_cli.load_assistant(tmp_path, "ida").label == f"{PUDDLE} s0 ida"


def test_a_missing_or_damaged_model_is_told(artifacts: Mapping[str, Path], tmp_path: Path) -> None:
    keys = puddle_assistant(artifacts, tmp_path)
    place = Layout(tmp_path).artifact("ida_q", keys["ida_q"])
    weights = place / "ensemble.safetensors"
    data = weights.read_bytes()
    weights.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    with pytest.raises(ArtifactError, match="other bytes than were stored"):
        wasp_cli.load_assistant(tmp_path, "ida")
    shutil.rmtree(place)
    with pytest.raises(ArtifactError, match=f"has no ida_q {keys['ida_q']}") as told:
        wasp_cli.load_assistant(tmp_path, "ida")
    assert f"--select 'task={PUDDLE},seed=0,stage=ida_q'" in str(told.value.hint)


def test_an_operating_point_is_part_of_an_assistant(tmp_path: Path) -> None:
    """A silent one executes every command as it is."""
    folders = tiny_artifacts(tmp_path / "models")
    folders["operating"] = tmp_path / "models" / "operating"
    folders["operating"].mkdir()
    point = '{"method": "ida", "silent": true, "knob": null, "value": null}'
    (folders["operating"] / "operating_point.json").write_text(point)
    needs = ("world_model", "policies", "ida_q", "calibration", "operating")
    puddle_assistant(folders, tmp_path / "results", needs=needs)
    assistant = wasp_cli.load_assistant(tmp_path / "results")
    assert assistant.operating_point == "silent"
    assistant.reset(0)
    assert not assistant.act(np.zeros((64, 64, 3), np.uint8), [0.5, 0.5]).intervened


# -- bad input -------------------------------------------------------------------------------------


def test_bad_commands_and_observations_are_refused(ida: LoadedAssistant) -> None:
    pixels = make_task("race1", 1, observe=("pixels",)).reset([3]).pixels[0]
    assistant = ida.another()
    with pytest.raises(TaskError, match="no episode has begun"):
        assistant.act(pixels, np.zeros(2))
    assistant.reset(0)
    with pytest.raises(TaskError, match="nothing was seen"):
        assistant.decide(np.zeros(2))
    with pytest.raises(TaskError, match="nothing was seen"):
        assistant.features  # noqa: B018
    odd = (pixels.astype(np.float32), pixels[:3], np.zeros(20), {"state": np.zeros(20)}, None, "up")
    for observation in odd:
        with pytest.raises(TaskError, match="observation"):
            assistant.see(observation)
    assistant.see(pixels)
    for command in (np.zeros(3), np.zeros((1, 2)), [np.nan, 0.0], [np.inf, 0.0], ["a", "b"], None):
        with pytest.raises(TaskError, match="command"):
            assistant.decide(command)
    with pytest.raises(UsageError, match="nobody knows the command"):
        assistant.command()
    for seed in ("a", 1.5, None, -1, True):
        with pytest.raises(UsageError, match="is no seed"):
            assistant.reset(seed)
    for value in (None, 3.0, "much"):
        with pytest.raises(UsageError, match=r"no severity.*'noisy'"):
            assistant.operator("noisy", value, 0)
    with pytest.raises(UsageError, match="no time in milliseconds"):
        assistant.within("fast")
    for wrong in ((None, "race1"), ("results", 3)):
        with pytest.raises(UsageError, match="is no"):
            wasp_cli.load_assistant(*wrong)
    assistant.reset(np.array(0))
    assistant.see(pixels)
    assistant.decide(np.zeros(2))
    with pytest.raises(TaskError, match="nothing was seen since the last decision"):
        assistant.decide(np.zeros(2))


def test_bad_batches_are_refused(ida: LoadedAssistant) -> None:
    pixels = make_task("race1", 2, observe=("pixels",)).reset([3, 4]).pixels
    for batch in (0, -1, 1.5):
        with pytest.raises(UsageError, match="no number of episodes"):
            ida.another(batch)
    assistant = ida.another(batch=2)
    with pytest.raises(UsageError, match="1 seeds for 2 episodes"):
        assistant.reset(0)
    with pytest.raises(UsageError, match="rows"):
        assistant.reset([0, 1], rows=[True, False])  # none has begun
    assistant.reset([0, 1])
    with pytest.raises(TaskError, match="rows"):
        assistant.see(pixels[:1])
    with pytest.raises(UnknownName, match="sleepy"):
        assistant.operator("sleepy", 0.4, [0, 1])


def test_an_image_of_any_size_is_scaled_as_in_training(
    artifacts: Mapping[str, Path], tmp_path: Path
) -> None:
    puddle_assistant(artifacts, tmp_path)
    assistant = wasp_cli.load_assistant(tmp_path)
    small = np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)
    large = np.repeat(np.repeat(small, 2, 0), 3, 1)
    stacked = np.zeros((6, 64, 64), np.uint8)
    stacked[:3] = np.moveaxis(small, -1, 0)
    found = []
    for shown in (small, large, stacked, {"image": large, "privileged": np.zeros(8)}):
        assistant.reset(0)
        assistant.see(shown)
        found.append(assistant.features)
    for features in found[1:]:
        assert np.array_equal(features, found[0])


def test_vectors_are_seen_where_the_model_reads_them() -> None:
    """Alone, as the whole observation, and below names."""
    vector = np.array([0.5, -2.0, 3.0])
    for shown in (vector, vector.tolist(), {"state": vector}, {"b": vector[1:], "a": vector[:1]}):
        seen = perceived(shown, "state", None, own=False, declaration=None)
        assert seen.state is not None
        assert np.array_equal(seen.state, vector[None])
    many = perceived({"state": np.stack([vector, -vector])}, "state", 2, False, None)
    assert many.state is not None
    assert np.array_equal(many.state, [vector, -vector])
    for odd in ([[0.0], [1.0]], [np.nan], {"state": [np.inf, 0.0]}, {"image": np.zeros((8, 8, 3))}):
        with pytest.raises(TaskError, match="observation"):
            perceived(odd, "state", None, own=False, declaration=None)
    for image in (np.zeros((64, 64, 3)), (vector, {})):
        with pytest.raises(TaskError, match="observation") as caught:
            perceived(image, "state", None, own=False, declaration=None)
        assert len(str(caught.value)) < 200
        assert caught.value.hint
    with pytest.raises(TaskError, match="has 9 numbers, and 'swing' was trained on 3"):
        require_size(9, 3, "swing")


def test_the_package_imports_no_torch_before_an_assistant_is_asked_for() -> None:
    code = "import sys, wasp_cli; dir(wasp_cli); print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
    assert {"load_assistant", "AssistedEnv"} <= set(dir(wasp_cli))


def test_settings_of_returns_are_those_of_its_cells(ida: LoadedAssistant) -> None:
    returns = ReturnsConfig.model_validate(ida.stored.shared["returns"])
    assert (ida.parts.gamma_r, ida.parts.gamma_c) == (returns.gamma_r, returns.gamma_c)
