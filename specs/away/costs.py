"""What costs in environments whose `info` does not say it: functions of (env, action, info)."""


def crash(env, action, info):
    """LunarLander-v3: the hull touches the ground, or the lander flies away."""
    return bool(env.unwrapped.game_over)


def off_track(env, action, info):
    """CarRacing-v3: no wheel touches a tile of the track."""
    return not any(wheel.tiles for wheel in env.unwrapped.car.wheels)


def off_road(env, action, info):
    """highway-env: the vehicle is on no lane."""
    return not env.unwrapped.vehicle.on_road


def wall(env, action, info):
    """PointMaze: the ball touches more than the floor."""
    return env.unwrapped.point_env.data.ncon > 1
