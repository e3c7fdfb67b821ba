"""Two environments of other packages with a cost, to be measured: CarRacing-v3 (gymnasium[box2d])
and racetrack-v1 of highway-env.
"""

from typing import Any

import gymnasium
import numpy as np

SEEN = gymnasium.spaces.Box(0, 255, (96, 96, 3), np.uint8)


class Grass(gymnasium.Wrapper[Any, Any, Any, Any]):
    """CarRacing, in which a step with all wheels beside the track costs."""

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        seen, reward, terminated, truncated, info = self.env.step(action)
        wheels = self.unwrapped.car.wheels  # type: ignore[attr-defined]
        return (
            seen,
            reward,
            terminated,
            truncated,
            {
                **info,
                "cost": float(all(not wheel.tiles for wheel in wheels)),
                "success": bool(info.get("lap_finished")),
            },
        )


class Racetrack(gymnasium.Wrapper[Any, Any, Any, Any]):
    """racetrack-v1, whose image is rendered in every step; off the road and a crash cost."""

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        vector = gymnasium.spaces.flatten_space(env.observation_space)
        shape = env.reset(seed=0)[0].shape
        self.observation_space = gymnasium.spaces.Dict(
            {
                "image": gymnasium.spaces.Box(0, 255, self._image().shape, np.uint8),
                "privileged": gymnasium.spaces.Box(-np.inf, np.inf, vector.shape, np.float32),
            }
        )
        assert int(np.prod(shape)) == int(np.prod(vector.shape))

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        seen, info = self.env.reset(**options)
        return self._seen(seen), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        seen, reward, terminated, truncated, info = self.env.step(action)
        on_road = self.unwrapped.vehicle.on_road  # type: ignore[attr-defined]
        cost = float(info.get("crashed", False) or not on_road)
        return self._seen(seen), reward, terminated, truncated, {**info, "cost": cost}

    def _image(self) -> Any:
        return np.asarray(self.env.render())

    def _seen(self, seen: Any) -> dict[str, Any]:
        return {"image": self._image(), "privileged": np.ravel(seen).astype(np.float32)}


def car_racing() -> gymnasium.Env[Any, Any]:
    """CarRacing with a cost."""
    return Grass(gymnasium.make("CarRacing-v3", disable_env_checker=True).unwrapped)


def racetrack() -> gymnasium.Env[Any, Any]:
    """racetrack-v1 with a cost and an image."""
    import highway_env  # noqa: F401  (it registers the environment)

    made = gymnasium.make("racetrack-v1", render_mode="rgb_array", disable_env_checker=True)
    return Racetrack(made.unwrapped)


gymnasium.register("CarRacingCosts-v0", entry_point=car_racing, max_episode_steps=1000)
gymnasium.register("RacetrackCosts-v0", entry_point=racetrack, max_episode_steps=300)
