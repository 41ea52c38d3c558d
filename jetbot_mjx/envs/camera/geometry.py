"""Intersect rays with MuJoCo's primitives, in the frame of each geom.

Motivation: thousands of small images a millisecond are a matter of few operations and of a layout
without vectors. Every vector is therefore a tuple of three arrays, of the shape of an image or of
scalars per frame, so that XLA makes one elementwise kernel of a whole image.

A ray is o + t d with o the camera's position and d = M (x, y, 1) the direction of the pixel, both
in the frame of the geom. Since d has the length 1 along the optical axis, t is the depth [m].
An intersection is where the ray enters: a camera inside a geom does not see it, as in OpenGL with
back faces culled.

Source of the quadratic in its stable form: t = c / (-b + √(b² - ac)), the smaller root, since the
product of both is c/a.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

Scalar = Array | np.ndarray | float
"""A number, a traced scalar, or an image of numbers."""

Mask = Array | np.ndarray | bool
"""A truth value, a traced one, or an image of them."""

Vector = tuple[Scalar, Scalar, Scalar]
"""x, y and z of a vector."""

Size = tuple[float, float, float]
"""Sizes of a geom [m], as in MuJoCo; a sphere has its radius three times."""

_TINY = 1e-12


class Hit(NamedTuple):
    """A `Hit` holds where rays enter a geom."""

    mask: Mask
    """Whether the ray enters the geom."""
    depth: Scalar
    """Depth along the optical axis [m], where `mask`."""
    faces: tuple[Mask, ...] = ()
    """For a box, which axis the entered face is perpendicular to: the first two of three."""


def triple(values: Iterable[Scalar]) -> Vector:
    """Return three values as a vector, or as a colour."""
    x, y, z = values
    return x, y, z


def dot(a: Vector, b: Vector) -> Scalar:
    """Return the scalar product."""
    return a[0] * b[0] + (a[1] * b[1] + a[2] * b[2])


def along(origin: Vector, direction: Vector, depth: Scalar) -> Vector:
    """Return the points of rays at a depth [m]."""
    return triple(o + depth * d for o, d in zip(origin, direction, strict=True))


def hit_plane(origin: Vector, direction: Vector, size: Size) -> Hit:
    """Intersect rays with a plane z = 0, seen from above.

    Args:
      origin: the camera in the plane's frame [m].
      direction: the directions of the rays.
      size: half lengths [m]; 0: infinite.
    """
    down = jnp.maximum(-direction[2], _TINY)
    depth = origin[2] / down
    mask = (direction[2] < -_TINY) & (origin[2] > 0)
    for axis in (0, 1):
        if size[axis] > 0:
            mask &= jnp.abs(origin[axis] + depth * direction[axis]) <= size[axis]
    return Hit(mask, depth)


def hit_box(origin: Vector, direction: Vector, size: Size) -> Hit:
    """Intersect rays with a box, the common part of three slabs.

    The ray is in the slab of axis a while |o_a + t d_a| ≤ h_a, from t = -o_a/d_a - h_a/|d_a| to
    t = -o_a/d_a + h_a/|d_a|.

    Args:
      origin: the camera in the box's frame [m].
      direction: the directions of the rays.
      size: half lengths [m].
    """
    enters, leaves = [], []
    for o, d, half in zip(origin, direction, size, strict=True):
        # A ray within the plane of a face has d = 0, and the sum changes no other number.
        inverse = 1.0 / (d + 1e-20)
        middle, reach = o * inverse, half * jnp.abs(inverse)
        enters.append(-middle - reach)
        leaves.append(reach - middle)
    depth = jnp.maximum(jnp.maximum(enters[0], enters[1]), enters[2])
    end = jnp.minimum(jnp.minimum(leaves[0], leaves[1]), leaves[2])
    faces = depth == enters[0], depth == enters[1]
    return Hit((depth < end) & (depth > 0), depth, faces)


def hit_ellipsoid(origin: Vector, direction: Vector, size: Size) -> Hit:
    """Intersect rays with an ellipsoid: a unit sphere in scaled coordinates.

    Args:
      origin: the camera in the ellipsoid's frame [m].
      direction: the directions of the rays.
      size: radii [m].
    """
    o, d = (_scaled(vector, size) for vector in (origin, direction))
    return _enter(dot(d, d), dot(o, d), dot(o, o) - 1.0)


def hit_sphere(origin: Vector, direction: Vector, size: Size) -> Hit:
    """Intersect rays with a sphere.

    Args:
      origin: the camera in the sphere's frame [m].
      direction: the directions of the rays.
      size: the radius [m], three times.
    """
    squared = dot(direction, direction)
    return _enter(squared, dot(origin, direction), dot(origin, origin) - size[0] * size[0])


def hit_cylinder(origin: Vector, direction: Vector, size: Size) -> Hit:
    """Intersect rays with a cylinder along z: its side, and the cap that faces the camera.

    Args:
      origin: the camera in the cylinder's frame [m].
      direction: the directions of the rays.
      size: radius, half length [m], and a number that is not used.
    """
    side = _enter_side(origin, direction, size)
    distance = jnp.abs(origin[2]) - size[1]
    speed = -jnp.sign(origin[2]) * direction[2]
    depth = distance / jnp.maximum(speed, _TINY)
    x, y, _ = along(origin, direction, depth)
    cap = (distance > 0) & (speed > _TINY) & (x * x + y * y <= size[0] * size[0])
    return Hit(side.mask | cap, jnp.where(cap, depth, side.depth))


def hit_capsule(origin: Vector, direction: Vector, size: Size) -> Hit:
    """Intersect rays with a capsule along z: a cylinder's side and two spheres.

    Args:
      origin: the camera in the capsule's frame [m].
      direction: the directions of the rays.
      size: radius, half length of the cylinder [m], and a number that is not used.
    """
    hits = [_enter_side(origin, direction, size)]
    for end in (-size[1], size[1]):
        centre = (origin[0], origin[1], origin[2] - end)
        hits.append(hit_sphere(centre, direction, size))
    depths = [jnp.where(hit.mask, hit.depth, jnp.inf) for hit in hits]
    depth = jnp.minimum(jnp.minimum(depths[0], depths[1]), depths[2])
    # Inside of one of the three parts is inside of the capsule.
    z = jnp.clip(origin[2], -size[1], size[1])
    outside = origin[0] ** 2 + origin[1] ** 2 + (origin[2] - z) ** 2 > size[0] * size[0]
    return Hit(outside & jnp.isfinite(depth), depth)


def _enter_side(origin: Vector, direction: Vector, size: Size) -> Hit:
    """Intersect rays with the side of a cylinder along z."""
    (ox, oy, oz), (dx, dy, dz) = origin, direction
    hit = _enter(dx * dx + dy * dy, ox * dx + oy * dy, ox * ox + oy * oy - size[0] * size[0])
    return hit._replace(mask=hit.mask & (jnp.abs(oz + hit.depth * dz) <= size[1]))


def _enter(a: Scalar, b: Scalar, c: Scalar) -> Hit:
    """Return the smaller root of a t² + 2 b t + c, where it is positive and c too: from outside."""
    inside_root = b * b - a * c
    mask = (inside_root > 0) & (b < 0) & (c > 0)
    root = jnp.sqrt(jnp.maximum(inside_root, 0.0))
    return Hit(mask, c / jnp.maximum(root - b, _TINY))


def _scaled(vector: Vector, size: Sequence[float]) -> Vector:
    return triple(v / s for v, s in zip(vector, size, strict=True))


def normal_ellipsoid(point: Vector, size: Size) -> Vector:
    """Return the outward unit normals at points of an ellipsoid, in its frame."""
    return _unit(_scaled(_scaled(point, size), size))


def normal_sphere(point: Vector, size: Size) -> Vector:
    """Return the outward unit normals at points of a sphere, in its frame."""
    return _scaled(point, (size[0], size[0], size[0]))


def normal_cylinder(point: Vector, size: Size) -> Vector:
    """Return the outward unit normals at points of a cylinder, in its frame."""
    x, y, z = point
    cap = jnp.abs(z) >= size[1] * (1 - 1e-5)
    # A point of the cap may lie on its edge as well.
    cap &= x * x + y * y < (size[0] * (1 - 1e-5)) ** 2
    side = jnp.where(cap, 0.0, 1.0 / size[0])
    return x * side, y * side, jnp.where(cap, jnp.sign(z), 0.0)


def normal_capsule(point: Vector, size: Size) -> Vector:
    """Return the outward unit normals at points of a capsule, in its frame."""
    x, y, z = point
    return _scaled((x, y, z - jnp.clip(z, -size[1], size[1])), (size[0], size[0], size[0]))


def _unit(vector: Vector) -> Vector:
    scale = jax.lax.rsqrt(jnp.maximum(dot(vector, vector), _TINY))
    return triple(v * scale for v in vector)
