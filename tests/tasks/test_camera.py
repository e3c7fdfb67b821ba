"""The cameras of every task: what is where in the picture, and that the shortcuts of the
renderer change no pixel.
"""

import hashlib
from collections.abc import Callable

import mujoco
import numpy as np
import pytest

from wasp_cli.tasks.camera import backdrop, discs, solids, upright
from wasp_cli.tasks.camera import camera as module
from wasp_cli.tasks.camera.appearance import Appearance, Scene, Things
from wasp_cli.tasks.camera.camera import Camera
from wasp_cli.tasks.camera.frame import FAR, FRONT_SLOPE, camera_axes, camera_rays, make_view
from wasp_cli.tasks.formula import track
from wasp_cli.tasks.formula.appearance import appearance as formula_appearance
from wasp_cli.tasks.goal.appearance import appearance as goal_appearance
from wasp_cli.tasks.outline import segments
from wasp_cli.tasks.race.appearance import appearance as race_appearance

APPEARANCES: dict[str, Callable[[int], Appearance]] = {
    "goal": goal_appearance,
    "race": race_appearance,
    "formula": formula_appearance,
}
# indices into the lap of Formula One where it is straight for some metres to both sides
STRAIGHT = range(28, 39)
HEIGHTS = {"goal": 0.16, "hazard": 0.02, "vase": 0.1}


@pytest.fixture(scope="module")
def cameras() -> dict[str, Camera]:
    return {task: Camera(appearance(1)) for task, appearance in APPEARANCES.items()}


def turned(yaw: float, roll: float = 0.0) -> np.ndarray:
    """First rolled about x, then turned about z."""
    c, s, a, b = np.cos(yaw), np.sin(yaw), np.cos(roll), np.sin(roll)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.array(
        [[1, 0, 0], [0, a, -b], [0, b, a]]
    )


def scene(task: str, at=(0.0, 0.0), heading=0.0, roll=0.0, **things) -> Scene:
    """One robot whose front points to `heading`, and things by name at [(x, y) or (x, y, yaw)]."""
    yaw = heading if task == "goal" else heading + np.pi / 2
    placed = {}
    for kind in APPEARANCES[task](1).kinds:
        where = [(*place, 0.0)[:3] for place in things.get(kind.name, ())]
        height = HEIGHTS[kind.name] if task == "goal" else 0.0
        placed[kind.name] = Things(
            np.array([[(x, y, height) for x, y, _ in where]]).reshape(1, -1, 3),
            np.array([[turned(angle) for *_, angle in where]]).reshape(1, -1, 3, 3),
            np.ones((1, len(where)), np.bool_),
        )
    return Scene(np.array([[*at, 0.1]]), turned(yaw, roll)[None], placed)


def stacked(scenes: list[Scene]) -> Scene:
    names = scenes[0].things
    things = {
        name: Things(
            *(
                np.concatenate(part)
                for part in zip(*(each.things[name] for each in scenes), strict=True)
            )
        )
        for name in names
    }
    return Scene(
        np.concatenate([each.position for each in scenes]),
        np.concatenate([each.rotation for each in scenes]),
        things,
    )


def lap_pose(index: int, backward: bool = False) -> dict[str, object]:
    """On the centre line of Formula One, along the lap or against it."""
    here, there = track.LAP[index % len(track.LAP), :2], track.LAP[(index + 1) % len(track.LAP), :2]
    dx, dy = there - here
    return {"at": tuple(here), "heading": float(np.arctan2(dy, dx)) + (np.pi if backward else 0.0)}


def some_scenes(task: str, count: int, seed: int = 0) -> list[Scene]:
    rng, scenes = np.random.default_rng(seed), []
    for _ in range(count):
        heading, roll = rng.uniform(-9, 9), 0.0 if task == "goal" else rng.uniform(-0.05, 0.05)
        if task == "goal":
            things = {
                "goal": rng.uniform(-1.2, 1.2, (1, 2)),
                "hazard": rng.uniform(-1.3, 1.3, (8, 2)),
                "vase": rng.uniform(-1, 1, (1, 3)),
            }
            scenes.append(scene(task, rng.uniform(-1, 1, 2), heading, **things))
        elif task == "race":
            bushes = np.stack([np.linspace(-1.5, 2.6, 7), rng.uniform(0.6, 1.5, 7)], axis=1)
            scenes.append(
                scene(
                    task,
                    rng.uniform((-2.3, 0.9), (2.5, 1.2)),
                    heading,
                    roll,
                    goal=[(3.15, 1.05)],
                    hazard=bushes,
                )
            )
        else:
            at = track.LAP[rng.integers(len(track.LAP)), :2] + rng.uniform(-0.5, 0.5, 2)
            barrels = np.concatenate(
                [at + rng.uniform(-6, 6, (30, 2)), rng.uniform(-3, 3, (30, 1))], axis=1
            )
            barrels = barrels[np.hypot(*(barrels[:, :2] - at).T) > 0.4]
            barrels = np.concatenate([barrels, np.full((30 - len(barrels), 3), 90.0)])
            scenes.append(
                scene(task, at, heading, roll, goal=[track.STAGES[rng.integers(7)]], vase=barrels)
            )
    return scenes


def front_and_rear(camera: Camera, view: Scene) -> tuple[np.ndarray, np.ndarray]:
    image = camera.render(view)[0].astype(int)
    return image[:3].transpose(1, 2, 0), image[3:].transpose(1, 2, 0)


def greenish(image: np.ndarray) -> np.ndarray:
    return (image[..., 1] > image[..., 0] + 20) & (image[..., 1] > image[..., 2] + 20)


def bluish(image: np.ndarray) -> np.ndarray:
    return (
        (image[..., 2] > image[..., 0] + 20)
        & (image[..., 2] > image[..., 1] + 20)
        & (image[..., 0] > 60)
    )


def cyan(image: np.ndarray) -> np.ndarray:
    return (image[..., 0] < 30) & (image[..., 1] > 60) & (image[..., 2] > 60)


def test_goal_and_hazard_are_seen_on_the_side_where_they_are(cameras):
    front, rear = front_and_rear(
        cameras["goal"], scene("goal", goal=[(1.2, -0.8)], hazard=[(1.0, 0.7)])
    )
    assert greenish(front)[:, 32:].sum() > 20
    assert greenish(front)[:, :32].sum() == 0
    assert bluish(front)[:, :32].sum() > 20
    assert bluish(front)[:, 32:].sum() == 0
    assert not greenish(rear).any()
    assert not bluish(rear).any()


def test_the_rear_camera_looks_back_and_is_not_a_mirror(cameras):
    # What lies to the robot's left is right in the picture of someone who turns around.
    front, rear = front_and_rear(
        cameras["goal"], scene("goal", goal=[(-1.2, 0.8)], vase=[(-1.0, -0.5)])
    )
    assert greenish(rear)[:, 32:].sum() > 20
    assert greenish(rear)[:, :32].sum() == 0
    assert cyan(rear)[:, :32].sum() > 10
    assert not cyan(front).any()


@pytest.mark.parametrize("task", APPEARANCES)
def test_the_robot_sees_its_own_body_below(cameras, task):
    front, _ = front_and_rear(cameras[task], scene(task))
    red = (front[..., 0] > 60) & (front[..., 1] < 40) & (front[..., 2] < 80)
    assert red[-1, 12:-12].all()
    # Other red things stand above the horizon, or far to the sides.
    assert not red[32:40, 16:48].any()


@pytest.mark.parametrize(
    ("task", "kind"),
    [(task, kind.name) for task, appearance in APPEARANCES.items() for kind in appearance(1).kinds],
)
def test_every_kind_of_thing_is_seen_two_metres_ahead_and_behind(cameras, task, kind):
    place = {
        "goal": {"at": (0.0, 0.0)},
        "race": {"at": (0.0, 1.1), "heading": 0.0},
        "formula": lap_pose(32),
    }[task]
    heading = float(place.get("heading", 0.0))
    ahead = 2.0 * np.array([np.cos(heading), np.sin(heading)])
    empty = cameras[task].render(scene(task, **place))[0].astype(int)
    for sign, visible in ((1.0, 0), (-1.0, 1)):
        image = (
            cameras[task]
            .render(scene(task, **place, **{kind: [np.array(place["at"]) + sign * ahead]}))[0]
            .astype(int)
        )
        changed = (np.abs(image - empty).reshape(2, 3, 64, 64).max(axis=1) > 30).sum(axis=(1, 2))
        assert changed[visible] >= 6
        assert changed[1 - visible] == 0


@pytest.mark.parametrize("backward", [False, True])
def test_the_outer_barrier_is_on_the_left_of_the_lap_and_the_inner_one_on_the_right(
    cameras, backward
):
    left_is_outer = 0
    for index in STRAIGHT:
        front = front_and_rear(cameras["formula"], scene("formula", **lap_pose(index, backward)))[
            0
        ][:50]
        red = (front[..., 0] > 90) & (front[..., 1] < 60) & (front[..., 2] < 70)
        blue = (front[..., 2] > 100) & (front[..., 0] < 60) & (front[..., 1] < 70)
        outer, inner = (red[:, 32:], blue[:, :32]) if backward else (red[:, :32], blue[:, 32:])
        left_is_outer += bool(outer.sum() > 5 and inner.sum() > 5)
    assert left_is_outer >= len(STRAIGHT) - 2


def everything(appearance: Appearance, view: Scene) -> tuple[mujoco.MjModel, int, int]:
    """Floor, every side of every wall as a thin box, then opaque things; the first geom of the
    walls and of the things.
    """
    geoms = ['<geom type="plane" size="0 0 1"/>']
    for wall in appearance.walls:
        for (x0, y0), (x1, y1) in segments(wall.outline):
            length, angle = np.hypot(x1 - x0, y1 - y0), np.arctan2(y1 - y0, x1 - x0)
            geoms.append(
                f'<geom type="box" pos="{(x0 + x1) / 2} {(y0 + y1) / 2} {wall.top / 2}" '
                f'size="{length / 2} 1e-4 {wall.top / 2}"'
                f' euler="0 0 {angle}"/>'
            )
    walls_end = len(geoms)
    for kind in appearance.kinds:
        things = view.things[kind.name]
        if kind.alpha == 1.0 and kind.column is None and kind.painted is None:
            for position, rotation in zip(things.position[0], things.rotation[0], strict=True):
                quaternion = np.zeros(4)
                mujoco.mju_mat2Quat(quaternion, rotation.reshape(9))
                pose = (
                    f'pos="{" ".join(map(str, position))}" quat="{" ".join(map(str, quaternion))}"'
                )
                geoms.append(f"<body {pose}>{kind.geoms}</body>")
    text = f'<mujoco><compiler angle="radian"/><worldbody>{"".join(geoms)}</worldbody></mujoco>'
    return mujoco.MjModel.from_xml_string(text), 1, walls_end


def brute_force(appearance: Appearance, view: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Depth and class (0 sky, 1 floor, 2 wall, 3 thing) of every pixel [2 * 64 * 64], the robot
    itself left out.
    """
    model, walls, things = everything(appearance, view)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    fx, fy = appearance.forward
    rays = np.concatenate(
        [camera_rays(camera_axes((fx, fy), FRONT_SLOPE)), camera_rays(camera_axes((-fx, -fy), 0.0))]
    )
    rays = rays @ view.rotation[0].T
    start = view.position[0] + view.rotation[0] @ [0.0, 0.0, appearance.camera_height]
    geoms, distance = np.empty(len(rays), np.int32), np.empty(len(rays))
    mujoco.mj_multiRay(
        model, data, start, rays.ravel(), None, True, -1, geoms, distance, None, len(rays), FAR
    )
    return np.where(geoms < 0, FAR, distance), np.select(
        [geoms < 0, geoms < walls, geoms < things], [0, 1, 2], 3
    )


@pytest.mark.parametrize("task", APPEARANCES)
def test_shortcuts_agree_with_casting_every_ray(task):
    # Columns are drawn wider than they are, so they have no part in this.
    appearance = APPEARANCES[task](1)._replace(landmarks=())
    camera, seen, right = Camera(appearance), np.zeros(4), np.zeros(4)
    elsewhere = np.ones(2 * 64 * 64, np.bool_)
    elsewhere[make_view(appearance).own] = False
    for view in some_scenes(task, 12, seed=3):
        view.things["goal"].shown[:] = task != "formula"
        depth = camera.depth(view).reshape(-1)
        expected, kinds = brute_force(appearance, view)
        agree = np.abs(depth - expected) < 0.02 * expected + 0.01
        for kind in range(4):
            mask = (kinds == kind) & elsewhere
            seen[kind] += mask.sum()
            right[kind] += (mask & agree).sum()
    present = seen > 0
    assert present.tolist() == [True, True, task != "goal", True]
    assert (right[present] / seen[present] >= np.array([0.98, 0.99, 0.98, 0.99])[present]).all(), (
        right / np.maximum(seen, 1)
    )


@pytest.mark.parametrize("task", APPEARANCES)
def test_what_is_left_out_changes_no_pixel(task, monkeypatch):
    """The same pictures when every pixel is looked at for every thing and every disc, and no
    frame learns from another.
    """
    views = stacked(some_scenes(task, 6, seed=5))
    # Among them things that are cut by the image's border, that touch the camera, and that are as
    # large as the view.
    for kind in ("goal", APPEARANCES[task](1).kinds[-1].name):
        views.things[kind].position[:3, 0, :2] = views.position[:3, :2] + [
            [0.35, 0.2],
            [-0.45, 0.0],
            [0.0, -0.6],
        ]
    images = Camera(APPEARANCES[task](1)).render(views)

    def everywhere(axes, centres, radii):
        return np.ones((len(centres), 2), np.bool_), np.tile(
            np.array([0, 64, 0, 64]), (len(centres), 2, 1)
        )

    monkeypatch.setattr(module, "rectangles", everywhere)
    monkeypatch.setattr(solids, "rectangles", everywhere)
    monkeypatch.setattr(discs, "rectangles", everywhere)
    monkeypatch.setattr(solids, "_LARGE", 10**9)
    monkeypatch.setattr(solids, "_MANY", 0)
    monkeypatch.setattr(backdrop, "_SPARSE", 10**9)
    monkeypatch.setattr(upright, "_BLOCK", 1)
    for row in range(6):
        one = Scene(
            *(each[row : row + 1] for each in views[:2]),
            {n: Things(*(a[row : row + 1] for a in t)) for n, t in views.things.items()},
        )
        assert (images[row] == Camera(APPEARANCES[task](1)).render(one)[0]).all()


GOLDEN = {"goal": "fb37f6ea3d6c795f", "race": "2bcfd12ab4b67cbd", "formula": "235f55693e7f86eb"}


def golden_scene(task: str) -> Scene:
    if task == "goal":
        return scene(
            task,
            (0.25, -0.5),
            0.625,
            goal=[(1.0, 0.25)],
            hazard=[(0.75, -0.5), (-0.75, -0.75), (1.5, 0.5)],
            vase=[(-0.5, -1.0, 0.5)],
        )
    if task == "race":
        return scene(
            task,
            (-0.75, 1.0),
            0.125,
            0.015625,
            goal=[(3.15, 1.05)],
            hazard=[(-0.125, 0.75), (0.5, 1.375), (-1.5, 0.75)],
        )
    return scene(
        task,
        (25.0, -9.0),
        3.0,
        0.015625,
        goal=[(4.0, -17.5)],
        vase=[(23.5, -9.25), (22.0, -8.25, 1.0), (27.0, -9.5)],
    )


@pytest.mark.parametrize("task", APPEARANCES)
def test_the_bytes_are_the_same_on_every_machine(cameras, task):
    """A change of these hashes makes recorded data sets and trained models stale."""
    view = golden_scene(task)
    assert hashlib.sha256(cameras[task].render(view).tobytes()).hexdigest()[:16] == GOLDEN[task]


@pytest.mark.parametrize("task", APPEARANCES)
def test_bytes_do_not_depend_on_batch_or_threads(cameras, task):
    scenes = some_scenes(task, 5)
    images = cameras[task].render(stacked(scenes))
    assert images.shape == (5, 6, 64, 64)
    assert images.dtype == np.uint8
    assert (images == Camera(APPEARANCES[task](1), threads=2).render(stacked(scenes))).all()
    assert (images[::-1] == cameras[task].render(stacked(scenes[::-1]))).all()
    for row in range(5):
        assert (images[row] == cameras[task].render(scenes[row])[0]).all()
