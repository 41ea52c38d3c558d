"""Draw and place what stands around in one episode: four walls, and objects other than the goal."""

import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt32

from jetbot_mjx.config import LookParams
from jetbot_mjx.envs.camera.geometry import Scalar, Vector
from jetbot_mjx.envs.camera.lens import Rays
from jetbot_mjx.envs.camera.scene import GOAL, Rgb, Scene, SceneGeom

_SHAPES = (
    ("box", (0.04, 0.06, 0.05)),
    ("cylinder", (0.04, 0.07, 0.0)),
    ("box", (0.09, 0.03, 0.03)),
    ("sphere", (0.05, 0.05, 0.05)),
)
"""Kinds and sizes [m] of the objects around; the fifth object is like the first, and so on."""

_NEAREST, _FARTHEST = 0.5, 2.5
"""Distances of the objects around from the origin, where episodes begin [m]."""

_FREE = 0.25
"""Smallest distance of an object around from the goal [m]."""

_AWAY = -1e3  # [m]: the height of an object that is not there

_WALL_HEIGHT = 0.2, 2.5  # [m]
_WALL_GAP = 0.1  # [m]: a wall that the camera has passed stays ahead of it


class Surroundings(NamedTuple):
    """A `Surroundings` holds what stands around in one episode."""

    walls: Float[Array, "14"] | None = None
    """Turn [rad] and height [m] of the walls, and the colours of the four; None: no walls."""
    clutter: Float[Array, "objects 5"] | None = None
    """x and y [m], red, green and blue of each object; None: no objects."""


class Room(NamedTuple):
    """A `Room` holds four walls, seen from one camera pose."""

    sides: list[Vector]
    """Numbers by which right, down and forward of a ray give 1/depth of each wall."""
    top: Scalar
    """Height of the walls above the camera [m]."""
    colours: Sequence[Rgb]


def draw_surroundings(
    key: UInt32[Array, "2"],
    params: LookParams,
    objects: int,
    scene: Scene,
    goal_w: Float[Array, "3"] | None,
) -> Surroundings:
    """Draw walls and objects for an episode.

    An object stands 0.5 to 2.5 m from the origin and at least 0.25 m from the goal, and its hue is
    a quarter of the circle or more away from the goal's. A wall is light or dark, nearly grey.

    Args:
      key: a random key.
      params: the look parameters; whether walls and objects differ is used.
      objects: the largest number of objects.
      scene: the plain scene.
      goal_w: position of the goal [m], world frame; None: the scene has no goal.
    """
    walls = clutter = None
    if params.differs("walls"):
        u = jax.random.uniform(key, (14,))
        low, high = _WALL_HEIGHT
        grey, red, blue = 0.2 + 0.8 * u[2:6], 0.85 + 0.3 * u[6:10], 0.85 + 0.3 * u[10:14]
        colours = jnp.stack([grey * red, grey, grey * blue], axis=1)
        place = jnp.stack([0.5 * jnp.pi * u[0], low + (high - low) * u[1]])
        walls = jnp.concatenate([place, colours.reshape(-1)])
    if objects:
        u = jax.random.uniform(jax.random.fold_in(key, 1), (5, objects))
        angle, distance = 2 * jnp.pi * u[0], _NEAREST + (_FARTHEST - _NEAREST) * u[1]
        place = distance * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        if goal_w is not None:
            gap = jnp.linalg.norm(place - goal_w[:2, None], axis=0)
            # On the other side of the origin there is room.
            place = jnp.where(gap < _FREE, -place, place)
        goal_rgb = next((x.rgb for x in scene.geoms if x.mocap == GOAL), (1.0, 0.0, 0.0))
        colours = _other_hues(goal_rgb, u[2], 0.15 + 0.65 * u[3], 0.4 * u[4])
        clutter = jnp.concatenate([place, colours]).T
    return Surroundings(walls, clutter)


def _other_hues(rgb: Rgb, u: Array, value: Array, chroma: Array) -> Float[Array, "3 n"]:
    """Return colours whose hue differs from a given one by 90 to 270 degrees.

    Args:
      rgb: the colour to keep away from.
      u: uniform in [0, 1), of shape (n,).
      value: the mean of red, green and blue, of shape (n,).
      chroma: the distance from grey, of shape (n,).
    """
    given = np.asarray(rgb, float) - np.asarray(rgb, float).mean()
    along = given / max(float(np.linalg.norm(given)), 1e-6)
    across = np.cross(np.full(3, 1 / math.sqrt(3)), along)
    hue = jnp.pi * (0.5 + u)
    shift = jnp.outer(along, jnp.cos(hue)) + jnp.outer(across, jnp.sin(hue))
    return jnp.clip(value + chroma * shift, 0.0, 1.0)


def clutter_positions(
    clutter: Float[Array, "objects 5"], number: Scalar
) -> dict[str, Float[Array, "3"]]:
    """Return where the objects around stand [m], world frame, by the name of their body.

    Args:
      clutter: the objects, as in `Surroundings`.
      number: how many of them are there, rounded.
    """
    is_there = jnp.arange(len(clutter)) < jnp.round(jnp.asarray(number))
    height = jnp.where(is_there, 0.0, _AWAY)
    return {
        _clutter_name(i): jnp.stack([one[0], one[1], height[i]]) for i, one in enumerate(clutter)
    }


def _clutter_name(index: int) -> str:
    return f"clutter {index}"


def with_clutter(scene: Scene, colours: Sequence[Rgb]) -> Scene:
    """Return a scene with objects around, which stand on the floor z = 0.

    Args:
      scene: the scene.
      colours: red, green and blue of each object.
    """
    geoms = []
    for index, rgb in enumerate(colours):
        kind, size = _SHAPES[index % len(_SHAPES)]
        height = size[1] if kind == "cylinder" else size[2]
        geoms.append(
            SceneGeom(
                geom_id=-1,
                kind=kind,
                size=size,
                rgb=(rgb[0], rgb[1], rgb[2]),
                mocap=_clutter_name(index),
                position=np.array([0.0, 0.0, height], np.float32),
                rotation=np.eye(3, dtype=np.float32),
            )
        )
    return scene._replace(geoms=(*scene.geoms, *geoms))


def make_room(
    walls: Float[Array, "14"],
    near: Scalar,
    position: Float[Array, "3"],
    rotation: Float[Array, "3 3"],
) -> Room:
    """Return the walls as a camera sees them.

    Args:
      walls: turn, height and colours, as in `Surroundings`.
      near: nearness of the walls [1/m].
      position: the optical centre [m], world frame.
      rotation: right, down and forward of the image, as columns, world frame.
    """
    angle = walls[0] + 0.5 * math.pi * np.arange(4)
    normals = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)
    # 1/depth = n·d / (D - n·p) = w n·d / (1 - w n·p), where w = 1/D.
    dot = functools.partial(jnp.dot, precision=jax.lax.Precision.HIGHEST)
    gaps = jnp.maximum(1.0 - near * dot(normals, position[:2]), _WALL_GAP * near)
    sides = (near / gaps)[:, None] * dot(normals, rotation[:2])
    colours = [(walls[i], walls[i + 1], walls[i + 2]) for i in range(2, 14, 3)]
    return Room([(x, y, z) for x, y, z in sides], walls[1] - position[2], colours)


def wall_slope(room: Room, up: Vector, rays: Rays) -> Scalar:
    """Return 1/depth of the wall that a ray meets; 0: it passes above, or there is none.

    Args:
      room: the walls.
      up: how far right, down and forward of the image point upwards.
      rays: the direction of the ray.
    """
    slopes = _wall_slopes(room, rays)
    nearest = jnp.maximum(jnp.maximum(slopes[0], slopes[1]), jnp.maximum(slopes[2], slopes[3]))
    rise = up[0] * rays.x + (up[1] * rays.y + up[2])
    return jnp.where(rise < room.top * nearest, nearest, 0.0)


def wall_colour(room: Room, rays: Rays) -> list[Scalar]:
    """Return the colour of the wall that a ray meets."""
    first, *others = zip(_wall_slopes(room, rays), room.colours, strict=True)
    nearest, rgb = first
    for slope, colour in others:
        rgb = [jnp.where(slope > nearest, a, b) for a, b in zip(colour, rgb, strict=True)]
        nearest = jnp.maximum(nearest, slope)
    return list(rgb)


def _wall_slopes(room: Room, rays: Rays) -> list[Scalar]:
    return [x * rays.x + (y * rays.y + z) for x, y, z in room.sides]
