"""The MuJoCo model that shows what a `Look` tells of. It is only looked at: no physics, no contacts. Made for `view3d`."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wasp_cli.tasks.base import Floats, Pixels
from wasp_cli.tasks.camera.look import Colour, Look, Wall
from wasp_cli.tasks.outline import segments

OBSTACLES = 1
"""The geom group of walls, which no camera can look through."""
_FIELD_OF_VIEW = 55.0
"""From bottom to top in degrees."""
_FLOOR_PIXELS, _LEAST_FLOOR = 2048, 8.0
"""Side of the floor's texture in pixels; half the side of the floor in m, at least. What is beyond has the floor's mean colour."""
_DEPTH = 0.16
"""Of a side of a wall that is no convex solid, in m."""


def visual_model(look: Look, counts: tuple[int, ...], size: tuple[int, int]) -> Any:
    """The MuJoCo model of a look with `counts` things of each kind, for pictures of `size` (width, height) pixels."""
    import mujoco

    half = max(1.2 * look.map_half_side, _LEAST_FLOOR)
    centre = look.map_centre or (0.0, 0.0)
    texture = _floor_texture(look, centre, half)
    far_off = _mean(texture.reshape(-1, 3) / 255.0)
    parts = "".join(f'<frame childclass="part{index}">{part.geom}</frame>' for index, part in enumerate(look.robot))
    # The sun goes along with the robot, so that the shadows around it are sharp.
    sun = '<light type="directional" mode="track" pos="-2 0.4 4" dir="0.45 -0.1 -0.9" diffuse=".45 .45 .45" specular="0 0 0"/>'
    bodies = [f'<body mocap="true">{sun}{parts}</body>']
    classes = [f'<default class="part{index}"><geom rgba="{_rgba(part.colour)}"/></default>' for index, part in enumerate(look.robot)]
    for kind, count in zip(look.kinds, counts, strict=True):
        classes.append(f'<default class="kind-{kind.name}"><geom rgba="{_rgba(kind.colour, kind.alpha)}"/></default>')
        bodies += [f'<body mocap="true" childclass="kind-{kind.name}">{kind.geoms}</body>'] * count
    still = [
        f'<geom type="cylinder" pos="{mark.xy[0]} {mark.xy[1]} {mark.top / 2}" size="{mark.radius} {mark.top / 2}" '
        f'rgba="{_rgba(mark.colour)}"/>'
        for mark in look.landmarks
    ]
    meshes: dict[str, Floats] = {}
    for index, wall in enumerate(look.walls):
        colours = (*wall.colours, _mean(np.array(wall.colours)))
        for turn, (faces, colour) in enumerate(zip(_wall_faces(wall), colours, strict=True)):
            if len(faces):
                name = f"wall{index}-{turn}"
                meshes[name] = faces
                still.append(f'<geom type="mesh" mesh="{name}" group="{OBSTACLES}" rgba="{_rgba(colour)}"/>')
    spec = mujoco.MjSpec.from_string(
        f"""
<mujoco>
  <statistic extent="1" center="0 0 0"/>
  <visual>
    <global fovy="{_FIELD_OF_VIEW}" offwidth="{size[0]}" offheight="{size[1]}"/>
    <headlight ambient=".5 .5 .5" diffuse=".25 .25 .25" specular="0 0 0"/>
    <map znear="0.02" zfar="200" fogstart="{0.5 * look.haze}" fogend="{5.0 * look.haze}" shadowclip="12"/>
    <quality shadowsize="4096" numslices="24" numstacks="12"/>
    <rgba fog="{_rgba(look.horizon)}" haze="{_rgba(look.horizon)}"/>
  </visual>
  <default>
    <geom contype="0" conaffinity="0" material="matt"/>
    {"".join(classes)}
  </default>
  <asset>
    <texture name="sky" type="skybox" builtin="gradient" rgb1="{_rgb(look.zenith)}" rgb2="{_rgb(look.horizon)}" width="64" height="384"/>
    <material name="matt" specular="0" shininess="0"/>
    <material name="floor" texture="floor" specular="0" shininess="0"/>
  </asset>
  <worldbody>
    <geom type="plane" pos="{centre[0]} {centre[1]} 0" size="{half} {half} 1" material="floor"/>
    <geom type="plane" pos="0 0 -0.05" size="0 0 5" rgba="{_rgba(far_off)}"/>
    {"".join(still)}
    {"".join(bodies)}
  </worldbody>
</mujoco>"""
    )
    paint = spec.add_texture(name="floor", type=mujoco.mjtTexture.mjTEXTURE_2D, width=_FLOOR_PIXELS, height=_FLOOR_PIXELS, nchannel=3)
    paint.data = texture.tobytes()
    for name, faces in meshes.items():
        # Every triangle has corners of its own: edges stay sharp.
        mesh = spec.add_mesh(name=name, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
        mesh.uservert, mesh.userface = faces.ravel(), np.arange(3 * len(faces))
    return spec.compile()


def _floor_texture(look: Look, centre: tuple[float, float], half: float) -> Pixels:
    """uint8 [_FLOOR_PIXELS, _FLOOR_PIXELS, 3] of the square of half side `half` m, rows from +y to -y."""
    at = (((np.arange(_FLOOR_PIXELS) + 0.5) / _FLOOR_PIXELS * 2.0 - 1.0) * half).astype(np.float32)
    x, y = (each.ravel() for each in np.meshgrid(at + np.float32(centre[0]), np.float32(centre[1]) - at))
    colours = look.floor.paint(x, y, np.full(x.shape, 2.0 * half / _FLOOR_PIXELS, np.float32))
    texture: Pixels = (np.clip(colours, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8).T.reshape(_FLOOR_PIXELS, _FLOOR_PIXELS, 3)
    return texture


def _wall_faces(wall: Wall) -> tuple[Floats, Floats, Floats]:
    """The triangles [faces, 3, 3] that a wall is drawn with, counter-clockwise from outside.

    In the wall's first colour, in its second (stripes along every side, by turns), and in their mean (the top of a convex solid).
    """
    ring = wall.outline
    side = np.roll(ring, -1, axis=0) - ring
    after = np.roll(side, -1, axis=0)
    turns = np.arctan2(side[:, 0] * after[:, 1] - side[:, 1] * after[:, 0], (side * after).sum(axis=1))
    # To the left of a side is the inside of a ring that goes around counter-clockwise; the solid is there unless the wall is hollow.
    order = 1 if (turns.sum() > 0.0) != wall.hollow else -1
    convex = not wall.hollow and bool(np.abs(turns).sum() < 2.0 * math.pi + 0.5)
    faces: tuple[list[Floats], ...] = ([], [], [])

    def add(paint: int, *corners: Floats) -> None:
        """A convex polygon of places [2] or [3], by default at the top."""
        points = np.stack([np.append(corner, wall.top)[:3] for corner in corners])[::order]
        faces[paint].extend(points[[0, i, i + 1]] for i in range(1, len(points) - 1))

    before = 0.0
    for start, end in segments(ring):
        length = float(np.hypot(*(end - start)))
        along = (end - start) / max(length, 1e-9)
        across = order * _DEPTH * np.array([-along[1], along[0]])
        for stripe in range(math.floor(before / wall.stripe), math.ceil((before + length) / wall.stripe)):
            low, high = max(stripe * wall.stripe - before, 0.0), min((stripe + 1) * wall.stripe - before, length)
            if high - low > 1e-6:
                near, far = start + low * along, start + high * along
                add(stripe % 2, np.append(near, 0.0), np.append(far, 0.0), far, near)
                if not convex:
                    add(stripe % 2, near, far, far + across, near + across)
                    add(stripe % 2, np.append(far + across, 0.0), np.append(near + across, 0.0), near + across, far + across)
        if convex:
            add(2, ring.mean(axis=0), start, end)
        before += length
    first, second, mean = (np.array(each).reshape(-1, 3, 3) for each in faces)
    return first, second, mean


def _mean(colours: NDArray[Any]) -> Colour:
    red, green, blue = np.mean(colours, axis=0).tolist()
    return red, green, blue


def _rgb(colour: Colour) -> str:
    return "{} {} {}".format(*colour)


def _rgba(colour: Colour, alpha: float = 1.0) -> str:
    return f"{_rgb(colour)} {alpha}"
