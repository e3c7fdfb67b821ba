"""Lunar Lander with a goal that only the pilot sees, as Yoneda et al. 2023 have it: land on a pad,
or reach a target in the air.

Physics, terrain and shaping are gymnasium's continuous Lunar Lander. The goal, what ends an episode
and what the ends are worth are theirs (github.com/ripl/diffusion-for-shared-autonomy,
`lunar_lander.py`: tasks v5 "land" and v1 "reach").
"""

import math
from typing import Any, Literal

import gymnasium
import numpy as np
from Box2D.b2 import edgeShape
from gymnasium import spaces
from gymnasium.envs.box2d.lunar_lander import LEG_DOWN, SCALE, VIEWPORT_H, VIEWPORT_W, LunarLander
from numpy.typing import NDArray

Kind = Literal["lander", "reacher"]
Floats = NDArray[np.float32]

WIDTH, HEIGHT = VIEWPORT_W / SCALE, VIEWPORT_H / SCALE  # of the world in metres
CHUNKS = 11  # points of the terrain; a pad lies around any of them but the outermost
RADIUS = 25 / SCALE  # of the target in metres
STEPS = 1000  # time limit; 50 steps are a second
# size of what everybody sees: place and velocity, angle and its velocity, contacts of the legs. The
# goal follows it.
SEEN = 8
REACHED, CRASHED = 1000.0, -100.0  # what the ends are worth
GOAL_SIZE: dict[Kind, int] = {"lander": 1, "reacher": 2}


class GoalLander(gymnasium.Env[Floats, Floats]):
    """One episode. Observations are what everybody sees [8] and the goal: the pad's x [1], or
    the target's x and y [2], -1 to 1.
    """

    def __init__(self, kind: Kind) -> None:
        self.kind = kind
        self.physics = LunarLander(continuous=True)
        self.observation_space = spaces.Box(-np.inf, np.inf, (SEEN + GOAL_SIZE[kind],), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.target = (0.0, 0.0)  # of the lander, in metres
        self.steps = 0
        self._shaping = 0.0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        super().reset(seed=seed)
        physics = self.physics
        seen, _ = physics.reset(seed=seed)
        if self.kind == "lander":
            self._move_pad(int(physics.np_random.integers(1, CHUNKS - 1)))
            self.target = (
                (physics.helipad_x1 + physics.helipad_x2) / 2,
                physics.helipad_y + LEG_DOWN / SCALE,
            )
        else:  # in the upper half of the screen, left or right of its inner half
            x, y = physics.np_random.uniform(
                (RADIUS, HEIGHT / 2 + RADIUS), (WIDTH / 2 - RADIUS, HEIGHT - RADIUS)
            )
            self.target = (x + WIDTH / 2 * (x >= WIDTH / 4), y)
        self.steps, self._shaping = 0, self._value(seen)
        return self._told(seen), {}

    def step(self, action: Any) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        seen, *_ = self.physics.step(np.asarray(action))
        self.steps += 1
        main, side = np.clip(action, -1, 1)
        value = self._value(seen)
        fuel = (0.15 * (main + 1) if main > 0 else 0.0) + (
            0.03 * abs(side) if abs(side) > 0.5 else 0.0
        )
        reward, self._shaping = value - self._shaping - fuel, value
        x, y = self.physics.lander.position
        if self.kind == "lander":
            over = not self.physics.lander.awake
            reached = over and self.physics.helipad_x1 <= x <= self.physics.helipad_x2
        else:
            over = reached = math.dist((x, y), self.target) < RADIUS
        crashed = bool(self.physics.game_over or abs(seen[0]) >= 1)
        if crashed:
            reward = CRASHED
        elif reached:
            reward = REACHED
        info = {"reached": bool(reached and not crashed), "crashed": crashed}
        return self._told(seen), float(reward), bool(over or crashed), self.steps >= STEPS, info

    def _told(self, seen: Floats) -> Floats:
        return np.array([*seen, *_scaled(*self.target)[: GOAL_SIZE[self.kind]]], np.float32)

    def _value(self, seen: Floats) -> float:
        """Return the shaping: gymnasium's, with the distance to the goal, which counts twice
        where the target is in the air.
        """
        x, y = _scaled(*self.target)
        distance = math.hypot(seen[0] - x, seen[1] - y) * (2 if self.kind == "reacher" else 1)
        return float(
            -100 * (distance + math.hypot(seen[2], seen[3]) + abs(seen[4]))
            + 10 * (seen[6] + seen[7])
        )

    def _move_pad(self, chunk: int) -> None:
        """Build the terrain again, flat around a point of it."""
        physics = self.physics
        xs = np.linspace(0, WIDTH, CHUNKS)
        heights = physics.np_random.uniform(0, HEIGHT / 2, CHUNKS + 1)
        heights[[chunk - 2, chunk - 1, chunk, chunk + 1, chunk + 2]] = physics.helipad_y
        smooth = [0.33 * float(heights[i - 1] + heights[i] + heights[i + 1]) for i in range(CHUNKS)]
        physics.helipad_x1, physics.helipad_x2 = float(xs[chunk - 1]), float(xs[chunk + 1])
        physics.world.DestroyBody(physics.moon)
        physics.moon = physics.world.CreateStaticBody(
            shapes=edgeShape(vertices=[(0, 0), (WIDTH, 0)])
        )
        for i in range(CHUNKS - 1):
            ends = [(float(xs[i]), smooth[i]), (float(xs[i + 1]), smooth[i + 1])]
            physics.moon.CreateEdgeFixture(vertices=ends, density=0, friction=0.1)


def _scaled(x: float, y: float) -> tuple[float, float]:
    """Scale a place in metres as observations have it; the height is that of legs on the pad's
    ground.
    """
    return 2 * x / WIDTH - 1, (y - HEIGHT / 4 - LEG_DOWN / SCALE) / (HEIGHT / 2)
