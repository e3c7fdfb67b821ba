"""Films of stored episodes: they show the world that was recorded, or nothing."""

from importlib.util import find_spec
from typing import Any

import gymnasium
import numpy as np
import pytest
from PIL import ImageColor

from tests.driver import drive
from wasp_cli.errors import ArtifactError
from wasp_cli.tasks.camera.appearance import HasScene
from wasp_cli.tasks.declared import Declaration, declare
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.pictures import PICTURE, picture_of
from wasp_cli.video.film import film
from wasp_cli.video.map import COMMAND, COST, EXECUTED, FREE, MapView, poses_of, stick
from wasp_cli.video.trace import displacements

SIZE = 96
ORANGE = np.array(ImageColor.getrgb(COST))


class Meter(gymnasium.Env[Any, Any]):
    """Shows its clock as a colour, rewards it, costs at times, and ends early."""

    metadata = {"render_modes": [], "render_fps": 25}
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,))
    observation_space = gymnasium.spaces.Box(0, 255, (64, 64, 3), np.uint8)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.clock = 0
        return self.seen(), {}

    def seen(self):
        return np.full((64, 64, 3), 40 + self.clock // 2, np.uint8)

    def step(self, action):
        self.clock += 1
        return (
            self.seen(),
            float(self.clock),
            self.clock >= 20,
            False,
            {"cost": float(self.clock in (5, 6))},
        )


gymnasium.register("FilmMeter-v0", entry_point=Meter, max_episode_steps=40)


def pose(task: Any) -> Any:
    return poses_of(task.appearance(), task.scene(np.array([0])))[0]


class Driven:
    """An episode of a task, driven by the script, with some commands overruled."""

    def __init__(self, name: str, seed: int) -> None:
        task = make_task(name, 1, observe=())
        task.reset([seed])
        self.name, self.seed = name, seed
        actions, rewards, costs, places = [], [], [], [pose(task)[:2]]
        for _ in range(task.max_decisions):
            action = np.clip(8 * drive(task), -1, 1).astype(np.float32)
            step = task.step(action)
            actions.append(action[0])
            rewards.append(np.float32(step.reward[0]))
            costs.append(bool(step.cost[0]))
            places.append(pose(task)[:2])
            if step.ended[0]:
                break
        self.a, self.reward, self.cost, self.places = (
            np.array(actions),
            np.array(rewards),
            np.array(costs),
            np.array(places),
        )
        self.a_h = self.a.copy()
        self.a_h[::5] = -self.a[::5]

    def arguments(self) -> tuple[Any, ...]:
        return self.name, 4, self.seed, self.a, self.a_h, self.reward


@pytest.fixture(scope="module", params=["goal1", "race1"])
def driven(request: pytest.FixtureRequest) -> Driven:
    return Driven(request.param, 3)


def edged(frame: Any) -> bool:
    return bool((np.abs(frame[0].astype(int) - ORANGE) < 12).all())


def test_a_film_shows_the_recorded_way_and_its_costs(driven: Driven) -> None:
    moments = list(film(*driven.arguments(), every=7, size=SIZE))
    length, decisions = len(driven.a), [moment.decision for moment in moments]
    assert decisions == [*range(0, length, 7), length]
    assert {moment.frame.shape for moment in moments} == {(SIZE, SIZE, 3)}
    np.testing.assert_array_equal(moments[-1].positions, driven.places)
    since = [driven.cost[a:b].any() for a, b in zip([0, *decisions], decisions, strict=False)]
    assert driven.cost.any()
    assert [edged(moment.frame) for moment in moments] == since


def test_what_was_executed_is_shown_where_it_is_not_the_command(driven: Driven) -> None:
    changed = film(*driven.arguments(), every=15, size=SIZE)
    same = film(driven.name, 4, driven.seed, driven.a, driven.a, driven.reward, every=15, size=SIZE)
    apart = [
        np.abs(one.frame.astype(int) - other.frame).max() > 60
        for one, other in zip(changed, same, strict=True)
    ]
    moved = [bool(np.abs(action).max() > 0.05) for action in driven.a[::15]]
    assert apart[: len(moved)] == moved
    assert not apart[-1] or len(apart) == len(moved), "after the last decision nothing is commanded"


@pytest.mark.parametrize("spoil", ["reward", "shorter", "longer", "world"])
def test_a_film_of_another_world_is_refused(driven: Driven, spoil: str) -> None:
    a, reward, seed = driven.a, driven.reward.copy(), driven.seed
    if spoil == "reward":
        reward[4] += 0.01
    elif spoil == "shorter":
        a, reward = a[:-1], reward[:-1]
    elif spoil == "longer":
        a, reward = np.concatenate([a, a[:1]]), np.concatenate([reward, reward[:1]])
    else:
        seed += 1
    with pytest.raises(ArtifactError, match="the same actions lead elsewhere") as caught:
        list(film(driven.name, 4, seed, a, a, reward, every=50, size=16))
    assert "other libraries" in str(caught.value.hint)


def test_others_tasks_show_what_their_camera_sees() -> None:
    rewards = np.array([[1 + i, 2 + i] for i in range(0, 20, 2)], float).sum(1)
    actions = np.zeros((10, 2), np.float32)
    moments = list(film("FilmMeter-v0", 2, 0, actions, actions, rewards, every=3, size=32))
    assert [moment.decision for moment in moments] == [0, 3, 6, 9, 10]
    assert [int(moment.frame[16, 16, 0]) for moment in moments] == [
        40 + moment.decision for moment in moments
    ]
    assert [edged(moment.frame) for moment in moments] == [False, True, False, False, False]
    assert not len(moments[-1].positions)


class Painted(Meter):
    """Draws its clock beside what its camera shows, in another shape."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 25}

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode

    def render(self):
        return np.full((20, 40, 3), 100 + self.clock, np.uint8)


gymnasium.register("FilmPainted-v0", entry_point=Painted, max_episode_steps=40)


def test_others_tasks_that_draw_themselves_are_shown_as_they_do() -> None:
    rewards = np.array([[1 + i, 2 + i] for i in range(0, 20, 2)], float).sum(1)
    actions = np.zeros((10, 2), np.float32)
    moments = list(film("FilmPainted-v0", 2, 0, actions, actions, rewards, every=3, size=32))
    assert [int(moment.frame[16, 16, 0]) for moment in moments] == [
        100 + 2 * moment.decision for moment in moments
    ]
    assert (moments[0].frame[:8] == 255).all(), "white above a picture that is wider than high"
    assert [edged(moment.frame) for moment in moments] == [False, True, False, False, False]


SWING_COSTS = """
def fast(env, action, info):
    return abs(env.unwrapped.state[1]) > 2.0
"""


@pytest.mark.skipif(find_spec("pygame") is None, reason="Pendulum draws with pygame")
def test_a_world_of_vectors_is_shown_as_it_draws_itself(tmp_path, monkeypatch) -> None:
    (tmp_path / "swing_costs.py").write_text(SWING_COSTS, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    declare("swing", Declaration(id="Pendulum-v1", cost="swing_costs:fast", limit=40))
    task = make_task("swing", 1, action_repeat=4, observe=(PICTURE,))
    task.reset([2])
    actions = np.ones((10, 1), np.float32)
    drawn, rewards, costs = [picture_of(task)], [], []
    for action in actions:
        step = task.step(action[None])
        rewards.append(step.reward[0])
        costs.append(bool(step.cost[0]))
        drawn.append(picture_of(task))
    moments = list(film("swing", 4, 2, actions, actions, np.array(rewards), every=1, size=500))
    assert [edged(moment.frame) for moment in moments] == [False, *costs]
    assert len(set(costs)) == 2
    inside = slice(20, -20)
    for moment, picture in zip(moments, drawn, strict=True):
        np.testing.assert_array_equal(moment.frame[inside, inside], picture[inside, inside])


@pytest.mark.parametrize("name", ["goal1", "race1"])
def test_arrows_point_to_where_actions_lead(name: str) -> None:
    task = make_task(name, 1, observe=())
    assert isinstance(task, HasScene)
    assert stick(object(), np.array([1.0, 0.0])) is None, (
        "of a task that does not say how it is driven"
    )
    full = {"goal1": 0.05, "race1": 0.02}[name]
    pushes = {
        "forward": [1.0, 0.0] if name == "goal1" else [full, full],
        "left": [0.0, 1.0] if name == "goal1" else [full, -full],
    }
    for way, action in pushes.items():
        push = stick(task, np.array(action))
        assert push is not None
        assert (np.abs(push) > 1e-9).tolist() == [way == "forward", way == "left"]
        assert (push >= 0).all()
        task.reset([3])
        before = pose(task)
        for _ in range(6):
            task.step(np.array([action]))
        after = pose(task)
        (ahead, _, turned) = displacements(np.stack([before, after]))[0]
        assert (ahead if way == "forward" else np.sin(turned)) > {"forward": 0.05, "left": 0.1}[way]


@pytest.mark.parametrize("name", ["goal1", "formula1"])
def test_the_map_follows_a_robot_that_leaves_it(name: str) -> None:
    task = make_task(name, 1, observe=())
    assert isinstance(task, HasScene)
    task.reset([5])
    view = MapView(task.appearance(), 40)
    centres = []
    for decision in range(60):
        if decision % 20 == 0:
            picture = view.picture(task.scene(np.array([0])))
            centres.append(picture._centre)
            assert (
                np.abs(pose(task)[:2] - picture._centre).max()
                <= view.half * (FREE if name == "formula1" else 0.9) + 1e-9
            )
        task.step(np.full((1, 2), 1.0) if name == "goal1" else np.clip(8 * drive(task), -1, 1))  # type: ignore[arg-type]
    assert len(centres) == 3


def test_marks_lie_where_their_places_are() -> None:
    task = make_task("goal1", 1, observe=())
    assert isinstance(task, HasScene)
    task.reset([0])
    picture = MapView(task.appearance(), 200).picture(task.scene(np.array([0])))
    # of 2 m: three quarters to the right, a quarter below the middle
    place = np.array([[1.0, -0.5]])
    picture.dots(place, "#FF00FF", 3)
    shown = np.asarray(picture.finished()).astype(int)
    rows, columns = np.nonzero((np.abs(shown - [255, 0, 255]) < 9).all(-1))
    assert (columns.mean(), rows.mean()) == pytest.approx((149.5, 124.5), abs=1.0)
    assert len({COMMAND, EXECUTED, COST}) == 3
