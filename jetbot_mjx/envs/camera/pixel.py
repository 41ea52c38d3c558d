"""Compute the colour of one pixel, as a function of scalars.

The function is lowered to one kernel for all pixels of all robots (`compiler.kernel`), or batched
by `jax.vmap` for XLA. Its order keeps pixels cheap that see the ground and the sky only, which most
do: a sphere around each geom decides whether any ray of the pixel can see it, and a branch that no
pixel of a vector or warp takes costs nothing.
"""

import functools
import operator
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jetbot_mjx.envs.camera import geometry
from jetbot_mjx.envs.camera.geometry import Hit, Mask, Scalar, Vector, triple
from jetbot_mjx.envs.camera.lens import Footprint, Rays
from jetbot_mjx.envs.camera.scene import Checker, Rgb, Scene, SceneGeom, ground_of
from jetbot_mjx.envs.camera.surroundings import Room, wall_colour, wall_slope

HITS = {
    "plane": geometry.hit_plane,
    "box": geometry.hit_box,
    "sphere": geometry.hit_sphere,
    "ellipsoid": geometry.hit_ellipsoid,
    "cylinder": geometry.hit_cylinder,
    "capsule": geometry.hit_capsule,
}
"""How rays meet each kind of geom."""

_NORMALS = {
    "sphere": geometry.normal_sphere,
    "ellipsoid": geometry.normal_ellipsoid,
    "cylinder": geometry.normal_cylinder,
    "capsule": geometry.normal_capsule,
}

_MARGIN = 1.1
"""Factor on the extent of a pixel, within which a lens is not quite linear."""


class Axes(NamedTuple):
    """An `Axes` holds directions of one frame of a camera in the axes of a geom."""

    image: tuple[Vector, Vector, Vector]
    """Right, down and forward of the image."""
    lights: tuple[Vector, ...]
    """Directions to the lights; the headlight is the last one."""


class Look(NamedTuple):
    """A `Look` holds what one geom looks like from one camera pose."""

    origin: Vector
    """The camera in the geom's frame [m]."""
    centre: Vector
    """The geom in the camera's axes: right, down and forward [m]."""
    faces: tuple[Vector, ...]
    """Light on the flat faces, by which the colour is multiplied: one of a plane, three of a box,
    none of another geom."""


class Frame(NamedTuple):
    """A `Frame` holds everything that the pixels of a frame share."""

    axes: dict[bytes, Axes]
    """By the geom's `axes_key`: geoms that are turned alike share them."""
    looks: list[Look]
    """In the order of the scene's geoms."""
    up: Vector
    """How far right, down and forward of the image point upwards."""
    params: dict[str, Scalar]
    """The look parameters that differ from the plain scene and enter the pixels."""
    clutter: list[Rgb]
    """Colours of the objects around."""
    room: Room | None
    """The walls; None: there are none."""
    floor_turn: tuple[Scalar, Scalar] | None
    """Cosine and sine of the turn of the ground's pattern; None: it is not turned."""


class _Sample(NamedTuple):
    """A `_Sample` holds what one ray of a pixel has met so far."""

    depth: Scalar
    """Depth of the nearest geom but the ground [m]; infinite: none."""
    rgb: Rgb


class _Sums(NamedTuple):
    """A `_Sums` holds the sum of the colours of a pixel's rays, and how many see the background."""

    rgb: Rgb
    ground: Scalar
    """Number of rays that see the ground."""
    sky: Scalar
    """Number of rays that see nothing."""
    wall: Scalar | None
    """Number of rays that see a wall; None: there are none."""


class _Slopes(NamedTuple):
    """A `_Slopes` holds 1/depth of what a ray meets behind all geoms, 0 or less: nothing."""

    ground: Scalar
    wall: Scalar | None
    """None: there are no walls."""

    @property
    def nearest(self) -> Scalar:
        """Return the larger one."""
        return self.ground if self.wall is None else jnp.maximum(self.ground, self.wall)

    @property
    def is_wall(self) -> Mask:
        """Return whether the nearest one is a wall."""
        assert self.wall is not None
        return self.wall > jnp.maximum(self.ground, 0.0)


def pixel_colour(
    scene: Scene, frame: Frame, samples: Sequence[Rays], footprint: Footprint
) -> list[Scalar]:
    """Return red, green and blue of a pixel, 1 is white: the mean over its area.

    Args:
      scene: the scene.
      frame: what the pixels of a frame share.
      samples: the directions of the pixel's rays.
      footprint: the extent of the pixel.
    """
    ground = ground_of(scene)
    others = [i for i in range(len(scene.geoms)) if i != ground]
    slopes = [_slopes(scene, frame, ground, rays) for rays in samples]

    def background() -> _Sums:
        seen = sum(jnp.asarray(slope.nearest > 0, jnp.float32) for slope in slopes)
        if frame.room is None:
            return _Sums(_black(), seen, len(samples) - seen, None)
        wall = sum(jnp.asarray(slope.is_wall, jnp.float32) for slope in slopes)
        return _Sums(_black(), seen - wall, len(samples) - seen, wall)

    def with_geoms(near: Sequence[Scalar]) -> _Sums:
        found = [_Sample(jnp.float32(np.inf), _black()) for _ in samples]
        for index, is_near in zip(others, near, strict=True):
            found = jax.lax.cond(
                is_near,
                lambda before, index=index: _meet(scene, frame, index, samples, before, footprint),
                lambda before: before,
                found,
            )
        return _sum(found, slopes)

    near = [_is_near(scene.geoms[i], frame.looks[i], footprint) for i in others]
    if not others:
        sums = background()
    else:
        is_any = functools.reduce(operator.or_, near)
        sums = jax.lax.cond(is_any, lambda: with_geoms(near), background)
    # Add the background.
    channels = list(sums.rgb)
    if ground is not None:
        geom, look = scene.geoms[ground], frame.looks[ground]
        colour = _plane_colour(geom, look, frame, footprint, sums.ground > 0)
        channels = [channels[k] + sums.ground * (colour[k] * look.faces[0][k]) for k in range(3)]
    if frame.room is not None and sums.wall is not None:
        wall = wall_colour(frame.room, footprint.centre)
        channels = [channels[k] + sums.wall * wall[k] for k in range(3)]
    sky = _sky(scene, frame.up, footprint.centre)
    return [(channels[k] + sums.sky * sky[k]) / len(samples) for k in range(3)]


def _radius(geom: SceneGeom) -> float:
    """Return the radius of a sphere around a geom [m]; 0: the geom is infinite."""
    x, y, z = geom.size
    match geom.kind:
        case "plane" | "cylinder":
            return float(np.hypot(x, y)) if x > 0 and y > 0 else 0.0
        case "sphere" | "ellipsoid":
            return max(geom.size)
        case "capsule":
            return x + y
        case _:
            return float(np.sqrt(x * x + y * y + z * z))


def _is_near(geom: SceneGeom, look: Look, footprint: Footprint) -> Scalar:
    """Return whether any ray of a pixel can meet the sphere around a geom.

    The ray through the pixel's centre passes a sphere of radius R at the distance |c × d|/|d|; the
    others pass at most |c| e/|d| nearer, where e is half of the pixel's extent.
    """
    radius = _radius(geom)
    if not radius:
        return jnp.ones((), bool)
    (x, y), c = footprint.centre, look.centre
    squared = x * x + (y * y + 1.0)
    along = c[0] * x + (c[1] * y + c[2])
    distance = geometry.dot(c, c)
    half = (0.5 * _MARGIN) * sum(
        abs(part) for change in (footprint.right, footprint.down) for part in change
    )
    bound = radius * jnp.sqrt(squared) + jnp.sqrt(distance) * half
    return distance * squared - along * along <= bound * bound


def _slopes(scene: Scene, frame: Frame, ground: int | None, rays: Rays) -> _Slopes:
    """Return what a ray meets behind all geoms."""
    wall = None if frame.room is None else wall_slope(frame.room, frame.up, rays)
    return _Slopes(_ground_slope(scene, frame, ground, rays), wall)


def _ground_slope(scene: Scene, frame: Frame, ground: int | None, rays: Rays) -> Scalar:
    """Return how steeply a ray falls towards the ground: 1/depth, at most 0 if it does not."""
    if ground is None:
        return jnp.zeros(())
    look = frame.looks[ground]
    right, down, forward = frame.axes[scene.geoms[ground].axes_key].image
    falls = -(right[2] * rays.x + (down[2] * rays.y + forward[2]))
    # A camera below the ground does not see it.
    return falls * jnp.where(look.origin[2] > 0, 1.0 / look.origin[2], 0.0)


def _meet(
    scene: Scene,
    frame: Frame,
    index: int,
    samples: Sequence[Rays],
    before: Sequence[_Sample],
    footprint: Footprint,
) -> list[_Sample]:
    """Return what the rays of a pixel have met after one more geom."""
    geom, look = scene.geoms[index], frame.looks[index]
    axes = frame.axes[geom.axes_key]
    after = []
    for rays, sample in zip(samples, before, strict=True):
        direction = directions(axes, rays)
        hit = HITS[geom.kind](look.origin, direction, geom.size)
        closer = hit.mask & (hit.depth < sample.depth)
        light = _light(scene, geom, look, axes, direction, hit)
        colour = geom.rgb
        if geom.checker is not None:
            colour = _checker_colours(geom.checker, look.origin, axes, None, footprint)
        new = _Sample(hit.depth, triple(colour[k] * light[k] for k in range(3)))
        after.append(jax.tree.map(functools.partial(jnp.where, closer), new, sample))
    return after


def _light(
    scene: Scene, geom: SceneGeom, look: Look, axes: Axes, direction: Vector, hit: Hit
) -> Sequence[Scalar]:
    """Return the light on a geom where a ray enters it, by which its colour is multiplied."""
    if geom.kind == "plane":
        return look.faces[0]
    if geom.kind == "box":
        first, second = hit.faces
        return [
            jnp.where(first, a, jnp.where(second, b, c))
            for a, b, c in zip(*look.faces, strict=True)
        ]
    point = geometry.along(look.origin, direction, hit.depth)
    normal = _NORMALS[geom.kind](point, geom.size)
    cosines = [jnp.maximum(geometry.dot(normal, light), 0.0) for light in axes.lights]
    ambient, *lights = strengths(scene, geom)
    return [
        ambient[k] + sum(c * light[k] for c, light in zip(cosines, lights, strict=True))
        for k in range(3)
    ]


def _sum(found: Sequence[_Sample], slopes: Sequence[_Slopes]) -> _Sums:
    """Add up the rays of a pixel; those that meet ground or wall before a geom see that."""
    rays = []
    for sample, slope in zip(found, slopes, strict=True):
        is_free = sample.depth == np.inf
        is_behind = (slope.nearest > 0) & (sample.depth * slope.nearest > 1.0)
        wall = None if slope.wall is None else is_behind & slope.is_wall
        ground = is_behind if wall is None else is_behind & ~wall
        rgb = triple(jnp.where(is_behind, 0.0, x) for x in sample.rgb)
        rays.append(_Sums(rgb, ground, is_free & ~is_behind, wall))
    return jax.tree.map(lambda *x: sum((y.astype(jnp.float32) for y in x), jnp.zeros(())), *rays)


def _black() -> Rgb:
    return triple([jnp.zeros(())] * 3)


def _plane_colour(
    geom: SceneGeom, look: Look, frame: Frame, footprint: Footprint, is_seen: Scalar
) -> Sequence[Scalar]:
    """Return the mean colour of the ground over a pixel, if it is seen there."""
    checker = geom.checker
    if checker is None:
        return geom.rgb
    axes = frame.axes[geom.axes_key]
    return jax.lax.cond(
        is_seen,
        lambda: _checker_colours(checker, look.origin, axes, frame.floor_turn, footprint),
        lambda: list(_black()),
    )


def strengths(scene: Scene, geom: SceneGeom) -> list[Rgb]:
    """Return the light on a geom from all sides, and that of each light, the headlight last."""
    ambient = triple(value + geom.emission for value in scene.ambient)
    return [ambient, *(light.diffuse for light in scene.lights), scene.headlight]


def directions(axes: Axes, rays: Rays) -> Vector:
    """Return the directions of rays in the axes of a geom."""
    right, down, forward = axes.image
    return triple(right[k] * rays.x + (down[k] * rays.y + forward[k]) for k in range(3))


def _checker_colours(
    checker: Checker,
    origin: Vector,
    axes: Axes,
    turn: tuple[Scalar, Scalar] | None,
    pixel: Footprint,
) -> list[Scalar]:
    """Return the mean colour of a checker texture over every pixel's area on its plane.

    The point p = o - d o_z/d_z that a pixel sees moves by t (e - d e_z/d_z) where d changes by e.
    A checker is the product of two square waves; the mean of each over the pixel's extent is exact,
    of the product it is for a pixel whose sides are parallel to the squares'.
    """
    if turn is not None:
        origin = _unturned(origin, turn)
        axes = axes._replace(image=tuple(_unturned(vector, turn) for vector in axes.image))
    direction = directions(axes, pixel.centre)
    # A pixel at or above the horizon sees the plane far away, if any of its rays does.
    down = jnp.minimum(direction[2], -1e-4)
    slope = 1.0 / down
    depth = -origin[2] * slope
    changes = [
        [axes.image[0][k] * change.x + axes.image[1][k] * change.y for k in range(3)]
        for change in (pixel.right, pixel.down)
    ]
    waves, places = [], []
    for axis in (0, 1):
        scale = 1.0 / checker.size[axis]
        at = (origin[axis] - checker.start[axis]) + depth * direction[axis]
        squared: Scalar = 0.0
        for change in changes:
            moved = depth * (change[axis] - direction[axis] * (change[2] * slope))
            squared = squared + moved * moved
        # A pixel's shadow on the axis has the variance of an interval of this length.
        extent = jnp.sqrt(squared) * scale
        places.append((at * scale, jnp.maximum(extent, 1e-3)))
        waves.append(_square_wave(*places[-1]))
    even = 0.5 + 0.5 * _pattern(checker.texture, waves, places)
    return [
        odd + (of_even - odd) * even for of_even, odd in zip(checker.even, checker.odd, strict=True)
    ]


def _unturned(vector: Vector, turn: tuple[Scalar, Scalar]) -> Vector:
    """Return a vector in axes that are turned about z by an angle of given cosine and sine."""
    (x, y, z), (cosine, sine) = vector, turn
    return cosine * x + sine * y, cosine * y - sine * x, z


_JOINT = 0.06
"""Width of the joints between tiles, of a tile's side."""


def _pattern(
    texture: Scalar | None, waves: Sequence[Scalar], places: Sequence[tuple[Array, Array]]
) -> Scalar:
    """Return the mean of a pattern over a pixel, from -1 to 1.

    Args:
      texture: the kind, as of `LookParams.floor_texture`; None: a checker.
      waves: along x and y, the mean of a wave that is 1 and -1 in turn.
      places: along x and y, where the pixel is and how long, in squares.
    """
    columns, rows = waves
    if texture is None:
        return columns * rows
    (x, wide), (y, long) = places
    tiles = 2.0 * _tile(x, wide) * _tile(y, long) - 1.0
    spots = _soft_wave(x, wide) * _soft_wave(y, long)
    soft = jnp.where(texture > 2.5, spots, tiles)
    hard = jnp.where(texture > 0.5, columns, columns * rows)
    return jnp.where(texture > 1.5, soft, hard)


def _tile(at: Array, width: Array) -> Array:
    """Return the share of a pixel's extent that lies within tiles, and not in joints."""

    def joints(x: Array) -> Array:
        """Return the length of all joints from 0 to x."""
        whole = jnp.floor(x)
        return whole * _JOINT + jnp.minimum(x - whole, _JOINT)

    return 1.0 - (joints(at + 0.5 * width) - joints(at - 0.5 * width)) / width


def _soft_wave(at: Array, width: Array) -> Array:
    """Return a wave of parabolas with the period of `_square_wave`, fainter in wide pixels."""
    phase = at - 2.0 * jnp.floor(0.5 * at + 0.5)
    # As fast as a sine falls that is averaged over the width.
    return 4.0 * phase * (1.0 - jnp.abs(phase)) / (1.0 + 2.0 * width * width)


def _square_wave(at: Array, width: Array) -> Array:
    """Return the mean of a wave that is 1 on [0, 1), -1 on [1, 2) and so on, around a place."""

    def integral(x: Array) -> Array:
        phase = 0.5 * x
        return 1.0 - jnp.abs(2.0 * (phase - jnp.floor(phase)) - 1.0)

    return (integral(at + 0.5 * width) - integral(at - 0.5 * width)) / width


def _sky(scene: Scene, up: Vector, rays: Rays) -> Sequence[Scalar]:
    """Return the colours of the sky, which change from the horizon to the zenith.

    MuJoCo's gradients are mixed by m = √2 e / √(1 + e²), where e is the elevation, 1 at the zenith.
    Of the sine s of that angle, m = 1 - √(1 - s) (1 - 0.3754 s - 0.1205 s²), to within 0.003.
    """
    if scene.zenith is None:
        return scene.horizon
    length = jnp.sqrt(rays.x * rays.x + (rays.y * rays.y + 1.0))
    sine = jnp.maximum((up[0] * rays.x + (up[1] * rays.y + up[2])) / length, 0.0)
    part = 1.0 - jnp.sqrt(jnp.maximum(1.0 - sine, 0.0)) * (1.0 - sine * (0.3754 + 0.1205 * sine))
    ends = zip(scene.horizon, scene.zenith, strict=True)
    return [low + (high - low) * part for low, high in ends]
