"""What costs in environments whose `info` does not say it, and what an expert reads of one."""

import numpy as np

AHEAD = np.array([0, 2, 4, 7, 10, 15, 20])  # tiles, each 3.5 m long


def crash(env, action, info):
    """LunarLander-v3: the hull touches the ground, or the lander flies away."""
    return bool(env.unwrapped.game_over)


def off_track(env, action, info):
    """CarRacing-v3: no wheel touches a tile of the track."""
    return not any(wheel.tiles for wheel in env.unwrapped.car.wheels)


def car(env):
    """CarRacing-v3: velocity, yaw rate and front wheels, and the track ahead seen from the car."""
    env = env.unwrapped
    hull, track = env.car.hull, np.array(env.track)[:, 2:4]
    across = np.array([np.cos(hull.angle), np.sin(hull.angle)])
    axes = np.stack([across, [-across[1], across[0]]], 1)  # to the right, ahead
    nearest = np.linalg.norm(track - hull.position, axis=1).argmin()
    ahead = (track[(nearest + AHEAD) % len(track)] - hull.position) @ axes / 20
    moving = np.array(hull.linearVelocity) @ axes / 50
    wheel = env.car.wheels[0].joint.angle
    return np.concatenate([moving, [hull.angularVelocity / 5, wheel], ahead.ravel()])


def off_road(env, action, info):
    """highway-env: the vehicle is on no lane."""
    return not env.unwrapped.vehicle.on_road


def wall(env, action, info):
    """PointMaze: the ball touches more than the floor."""
    return env.unwrapped.point_env.data.ncon > 1
