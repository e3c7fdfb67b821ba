"""Which commands are one and the same force: held against the physics, and the projection against every action of a grid."""

import numpy as np
import pytest
import torch

from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.motors import Motors
from wasp_cli.tasks.registry import TASKS


@pytest.mark.parametrize("task", ["race1", "formula1", "goal1"])
def test_actions_of_the_same_force_move_the_robot_alike_and_others_do_not(task):
    motors = TASKS[task].motors
    assert motors.saturation is not None
    random = np.random.default_rng(3)
    wanted, command = (torch.from_numpy(random.uniform(-1, 1, (16, 2)).astype(np.float32)) for _ in range(2))
    wanted[8:] *= 0.01
    least = motors.least(command, wanted)
    assert not torch.equal(least, wanted)
    world = make_task(task, 16, action_repeat=2, observe=("privileged",), threads=1)
    after = []
    for action in (wanted, least, command):
        world.reset(range(16))
        after.append([world.step(action.numpy()).observation.privileged for _ in range(3)][-1])
    assert np.array_equal(after[0], after[1])
    differs = (np.abs(motors.force(wanted.numpy()) - motors.force(command.numpy())) > 0.1).any(1)
    assert differs.sum() > 8
    assert (np.abs(after[0] - after[2])[differs].max(1) > 1e-4).all()


def test_the_least_correction_is_the_closest_action_of_the_same_force():
    motors = Motors((0.3, 1.0))
    line = np.linspace(-1, 1, 41).round(2)
    every = np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)
    random = np.random.default_rng(1)
    for command, wanted in random.choice(every, (200, 2)):
        least = motors.least(torch.tensor(command), torch.tensor(wanted)).numpy()
        assert np.allclose(motors.force(least), motors.force(wanted), atol=1e-5)
        alike = every[(np.abs(motors.force(every) - motors.force(wanted)) < 1e-6).all(1)]
        assert np.linalg.norm(least - command) <= np.linalg.norm(alike - command, axis=1).min() + 1e-5


def test_where_no_motor_is_known_an_action_is_its_own_force():
    action = np.array([[0.3, -1.0]])
    assert Motors().force(action) is action
    wanted = torch.tensor([[0.5, 0.5]])
    assert Motors().least(torch.zeros(1, 2), wanted) is wanted
    assert TASKS["somebody/Else-v0"].motors == Motors()
