"""The cameras of Goal1: what is where in the picture, and that the shortcuts of the renderer change no pixel."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from wasp_cli.tasks import goal1_model as g1
from wasp_cli.tasks.camera import CAMERA_Z, Camera, Scene, _camera_rays

FAR = 60.0


@pytest.fixture(scope="module")
def camera() -> Camera:
    return Camera(g1.full_model())


def scene(agent=(0.0, 0.0, 0.0), goal=(-FAR, FAR), hazards=(), vase=(-FAR, -FAR, 0.1, 1.0, 0.0, 0.0, 0.0)) -> Scene:
    spread = [*hazards, *[(FAR, FAR)] * (8 - len(hazards))]
    return Scene(*(np.array([value], float) for value in (agent[:2], agent[2], goal, spread, vase)))


def front_and_rear(camera: Camera, view: Scene) -> tuple[np.ndarray, np.ndarray]:
    image = camera.render(view)[0].astype(int)
    return image[:3].transpose(1, 2, 0), image[3:].transpose(1, 2, 0)


def greenish(image: np.ndarray) -> np.ndarray:
    return (image[..., 1] > image[..., 0] + 20) & (image[..., 1] > image[..., 2] + 20)


def bluish(image: np.ndarray) -> np.ndarray:
    return (image[..., 2] > image[..., 0] + 20) & (image[..., 2] > image[..., 1] + 20) & (image[..., 0] > 60)


def cyan(image: np.ndarray) -> np.ndarray:
    return (image[..., 0] < 30) & (image[..., 1] > 60) & (image[..., 2] > 60)


def test_goal_and_hazard_are_seen_on_the_side_where_they_are(camera):
    front, rear = front_and_rear(camera, scene(goal=(1.2, -0.8), hazards=[(1.0, 0.7)]))

    assert greenish(front)[:, 32:].sum() > 20
    assert greenish(front)[:, :32].sum() == 0
    assert bluish(front)[:, :32].sum() > 20
    assert bluish(front)[:, 32:].sum() == 0
    assert not greenish(rear).any()
    assert not bluish(rear).any()


def test_the_rear_camera_looks_back_and_is_not_a_mirror(camera):
    # What lies to the robot's left is right in the picture of someone who turns around.
    front, rear = front_and_rear(camera, scene(goal=(-1.2, 0.8), vase=(-1.0, -0.5, 0.1, 1.0, 0.0, 0.0, 0.0)))

    assert greenish(rear)[:, 32:].sum() > 20
    assert greenish(rear)[:, :32].sum() == 0
    assert cyan(rear)[:, :32].sum() > 10
    assert not cyan(front).any()


def test_pictures_turn_with_the_robot(camera):
    straight = camera.render(scene(goal=(1.0, 0.3), hazards=[(0.8, -0.4)]))
    turned = camera.render(scene(agent=(0.0, 0.0, np.pi), goal=(-1.0, -0.3), hazards=[(-0.8, 0.4)]))
    # The checker has a period of two tiles, so half a turn about a tile's corner maps it onto itself.
    assert np.mean(np.abs(straight.astype(int) - turned) > 2) < 0.002


def test_nearer_things_look_larger_and_the_goal_lets_see_through(camera):
    sizes = [greenish(front_and_rear(camera, scene(goal=(d, 0.0)))[0]).sum() for d in (0.6, 1.0, 2.0, 4.0)]
    assert sizes == sorted(sizes, reverse=True)
    plain = front_and_rear(camera, scene(goal=(0.9, 0.0)))[0]
    behind = front_and_rear(camera, scene(goal=(0.9, 0.0), vase=(1.6, 0.0, 0.1, 1.0, 0.0, 0.0, 0.0)))[0]
    assert (plain != behind).any()


def test_the_robot_sees_its_own_body_below(camera):
    front, _ = front_and_rear(camera, scene())
    red = (front[..., 0] > 60) & (front[..., 1] < 40) & (front[..., 2] < 80)
    assert red[-1].all()
    assert not red[:32].any()


def test_a_hazard_underneath_adds_nothing_that_was_not_there(camera):
    """While the cost is paid, the picture shows the disc on the floor and no mark of the cost."""
    clean = camera.render(scene()).astype(int)[0].reshape(2, 3, -1)
    inside = camera.render(scene(hazards=[(0.1, 0.0)])).astype(int)[0].reshape(2, 3, -1)
    changed = (clean != inside).any(axis=1)
    for image, mask in zip(inside, changed, strict=True):
        red, green, blue = image[:, mask]
        assert ((blue > red + 20) & (blue > green + 20)).all()
    assert not changed.reshape(2, 64, 64)[:, :32].any()


def brute_force(model: mujoco.MjModel, view: Scene, row: int, geom: str) -> np.ndarray:
    """Which pixels a ray cast in the world frame at everything finds to hit `geom` first (floor and hazards left out): [2, 64, 64]."""
    data = mujoco.MjData(model)
    data.qpos[:2], data.qpos[2], data.qpos[3:] = view.agent_xy[row], view.agent_yaw[row], view.vase[row]
    data.mocap_pos[0, :2] = view.goal_xy[row] if geom == "goal" else FAR
    data.mocap_pos[1:, :2] = FAR
    mujoco.mj_forward(model, data)
    yaw = view.agent_yaw[row]
    rotation = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    rays = np.concatenate([_camera_rays(np.array([1.0, 0, -0.4])), _camera_rays(np.array([-1.0, 0, 0]))]) @ rotation.T
    geoms, distance = np.empty(len(rays), np.int32), np.empty(len(rays))
    start = np.array([*view.agent_xy[row], CAMERA_Z])
    mujoco.mj_multiRay(model, data, start, rays.ravel(), None, True, -1, geoms, distance, None, len(rays), 1e3)
    return (geoms == model.geom(geom).id).reshape(2, 64, 64)


@pytest.mark.parametrize("thing", ["goal", "vase"])
def test_shortcuts_agree_with_casting_every_ray(camera, thing):
    rng, model = np.random.default_rng(3), g1.full_model()
    total = 0
    for _ in range(25):
        quaternion = rng.normal(size=4)
        place = rng.uniform(-0.9, 0.9, 2)
        vase = (*place, 0.12, *(quaternion / np.linalg.norm(quaternion)))
        agent = (*rng.uniform(-1, 1, 2), rng.uniform(-9, 9))
        view = scene(agent=agent, goal=tuple(rng.uniform(-1.2, 1.2, 2)), vase=vase)
        no_goal = view._replace(goal_xy=np.full((1, 2), FAR))
        neither = no_goal._replace(vase=np.array([[FAR, FAR, 0.1, 1.0, 0, 0, 0]]))
        with_it, without = (view, no_goal) if thing == "goal" else (no_goal, neither)
        changed = (camera.render(with_it) != camera.render(without))[0].reshape(2, 3, 64, 64).any(axis=1)
        expected = brute_force(model, with_it, 0, thing)
        # Rounding may move an edge by a pixel; a shade may equal what was there.
        assert (changed & ~expected).sum() <= 2
        assert (expected & ~changed).sum() <= max(2, 0.01 * expected.sum())
        total += int(expected.sum())
    assert total > 1000


def test_bytes_do_not_depend_on_batch_or_threads(camera):
    rng = np.random.default_rng(0)
    vase = np.concatenate([rng.uniform(-1, 1, (7, 2)), np.tile([0.1, 1.0, 0, 0, 0], (7, 1))], axis=1)
    view = Scene(rng.uniform(-1, 1, (7, 2)), rng.uniform(-9, 9, 7), rng.uniform(-1, 1, (7, 2)), rng.uniform(-1, 1, (7, 8, 2)), vase)
    images = camera.render(view)

    assert images.shape == (7, 6, 64, 64)
    assert images.dtype == np.uint8
    assert (images == Camera(g1.full_model(), threads=2).render(view)).all()
    for row in range(7):
        assert (images[row] == camera.render(Scene(*(part[row : row + 1] for part in view)))[0]).all()
