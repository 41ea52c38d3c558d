"""Render a robot's camera: one frame, pure and unbatched; batch with `jax.vmap`.

A pixel is the mean of its area: `camera.samples`² rays decide what share of it each surface covers,
and a checker texture is averaged over the pixel's footprint on the plane in closed form. So a small
image looks like a large one that was made smaller.

What depends on the frame only (origins, rotations, the light on flat faces) is computed once per
frame and kept apart from what is computed per pixel, so that XLA does not repeat it in every pixel.
"""

import functools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float, Int, UInt8, UInt32

from jetbot_mjx.config import CameraConfig
from jetbot_mjx.envs import kinematics
from jetbot_mjx.envs.camera import geometry
from jetbot_mjx.envs.camera.geometry import Hit, Vector
from jetbot_mjx.envs.camera.lens import Footprint, Rays, footprint, sample_rays
from jetbot_mjx.envs.camera.scene import Checker, Rgb, Scene, SceneGeom, read_scene

_HITS = {
    "plane": geometry.hit_plane,
    "box": geometry.hit_box,
    "sphere": geometry.hit_sphere,
    "ellipsoid": geometry.hit_ellipsoid,
    "cylinder": geometry.hit_cylinder,
    "capsule": geometry.hit_capsule,
}
_NORMALS = {
    "sphere": geometry.normal_sphere,
    "ellipsoid": geometry.normal_ellipsoid,
    "cylinder": geometry.normal_cylinder,
    "capsule": geometry.normal_capsule,
}
_FUSED_GEOMS = 2
"""Number of geoms up to which an image is one fused computation; with more, XLA would compute the
intersections of each again for all others."""

_GREY = (0.299, 0.587, 0.114)  # weights of red, green and blue; source: ITU-R BT.601


class Pose(NamedTuple):
    """A `Pose` holds where a camera is and how it is turned, in the world frame."""

    position: Float[Array, "3"]
    """Position of the optical centre [m]."""
    rotation: Float[Array, "3 3"]
    """Axes of the image (right, down, forward) as columns."""


class _Frame(NamedTuple):
    """A `_Frame` holds what one geom looks like from one camera pose."""

    origin: Vector
    """The camera in the geom's frame [m]."""
    axes: tuple[Vector, Vector, Vector]
    """Right, down and forward of the image in the geom's frame."""
    lights: tuple[Vector, ...]
    """Directions to the lights in the geom's frame; the headlight is the last one."""
    faces: tuple[tuple[Any, Any, Any], ...]
    """Light on the flat faces, by which the colour is multiplied: one of a plane, three of a box,
    none of another geom."""


class Camera:
    """A `Camera` renders what a robot's camera sees."""

    def __init__(self, config: CameraConfig, model: mujoco.MjModel, robot: str = "jetbot") -> None:
        """Read the scene and compute the rays.

        Args:
          config: the camera section.
          model: the compiled model with its visual elements.
          robot: the name of the body that carries the camera.

        Raises:
          UserError: the scene has something that cannot be rendered, or the lens is none.
        """
        self.config = config
        self.scene: Scene = read_scene(model, robot)
        self._samples = sample_rays(config, config.samples)
        self._footprint = footprint(config)
        self._standing = {
            model.body(b).name: np.asarray(model.body_pos[b], np.float32)
            for b in range(model.nbody)
            if model.body_mocapid[b] >= 0
        }
        pitch = np.radians(config.pitch)
        forward = np.array([np.cos(pitch), 0.0, -np.sin(pitch)])
        right = np.array([0.0, -1.0, 0.0])
        axes = np.stack([right, np.cross(forward, right), forward], axis=1)
        self._mount_rotation = axes.astype(np.float32)
        self._mount_position = np.asarray(config.position, np.float32)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Return the shape of an image: height, width, channels."""
        return self.config.height, self.config.width, 3 if self.config.colour == "rgb" else 1

    @property
    def obs_shape(self) -> tuple[int, int, int]:
        """Return the shape of the observation, with the stacked images in the last axis."""
        height, width, channels = self.shape
        return height, width, channels * self.config.frames

    def pose(self, position_w: Float[Array, "3"], quat: Float[Array, "4"]) -> Pose:
        """Return the camera's pose on a robot.

        Args:
          position_w: position of the axle midpoint [m], world frame.
          quat: attitude of the robot as a unit quaternion (w, x, y, z).
        """
        body = jnp.stack([kinematics.rotate(quat, axis) for axis in jnp.eye(3)], 1)
        highest = jax.lax.Precision.HIGHEST
        mount = jnp.dot(body, self._mount_position, precision=highest)
        return Pose(position_w + mount, jnp.dot(body, self._mount_rotation, precision=highest))

    def render(
        self, pose: Pose, mocap_positions: Mapping[str, Float[Array, "3"]]
    ) -> UInt8[Array, "h w c"]:
        """Return the image.

        Args:
          pose: the pose of the camera.
          mocap_positions: positions [m] of mocap bodies, world frame, by name; those of others are
            the model's.

        Returns:
          Colours from 0 to 255, red, green, blue, or one channel of grey; the first row is the
          upper one.
        """
        frames = self._frames(pose, mocap_positions)
        seen = [_shares(self.scene, frames, rays) for rays in self._samples]
        shares = jax.tree.map(lambda *parts: sum(parts[1:], parts[0]), *seen)
        sky = _sky(self.scene, pose, self._footprint)
        channels = _mix(self.scene, frames, shares, sky, self._footprint, len(self._samples))
        red, green, blue = (jnp.broadcast_to(x, self.shape[:2]) for x in channels)
        if self.config.colour == "grey":
            grey = _GREY[0] * red + (_GREY[1] * green + _GREY[2] * blue)
            return _to_words(grey).astype(jnp.uint8)[..., None]
        packed = _to_words(red) | (_to_words(green) << 8) | (_to_words(blue) << 16)
        # Pack first: three bytes would be three images, each with all rays of its own.
        packed = jax.lax.optimization_barrier(packed)
        return jax.lax.bitcast_convert_type(packed, jnp.uint8)[..., :3]

    def trace(
        self, pose: Pose, mocap_positions: Mapping[str, Float[Array, "3"]]
    ) -> tuple[Float[Array, "h w"], Int[Array, "h w"]]:
        """Return depth and segmentation, of the pixels' centres.

        Args:
          pose: the pose of the camera.
          mocap_positions: positions [m] of mocap bodies, as for `render`.

        Returns:
          The depth along the optical axis [m], infinite where there is nothing, and the geom's
          index in the model, -1 where there is none.
        """
        frames = self._frames(pose, mocap_positions)
        shape = self.shape[:2]
        nearest = jnp.full(shape, jnp.inf)
        found = jnp.full(shape, -1)
        hits = _hits(self.scene, frames, self._footprint.centre)
        for geom, hit in zip(self.scene.geoms, hits, strict=True):
            closer = hit.mask & (hit.depth < nearest)
            nearest = jnp.where(closer, hit.depth, nearest)
            found = jnp.where(closer, geom.geom_id, found)
        return nearest, found

    def _frames(self, pose: Pose, mocap_positions: Mapping[str, Float[Array, "3"]]) -> list[_Frame]:
        """Compute everything that all pixels of a frame share."""
        frames = []
        for geom in self.scene.geoms:
            position: Any = geom.position
            if geom.mocap is not None:
                start = mocap_positions.get(geom.mocap, self._standing[geom.mocap])
                position = position + start
            frames.append(_frame(self.scene, geom, pose, position))
        return jax.lax.optimization_barrier(frames)


def _frame(scene: Scene, geom: SceneGeom, pose: Pose, position: Any) -> _Frame:
    """Compute what one geom looks like from a camera pose."""
    difference = pose.position - position
    towards = [*(-light.direction for light in scene.lights), -pose.rotation[:, 2]]
    origin = _into(geom.rotation, difference)
    right, down, forward = (_into(geom.rotation, pose.rotation[:, k]) for k in range(3))
    lights = tuple(_into(geom.rotation, vector) for vector in towards)
    faces = []
    for axis in {"plane": (2,), "box": (0, 1, 2)}.get(geom.kind, ()):
        side = 1.0 if geom.kind == "plane" else jnp.sign(origin[axis])
        cosines = [jnp.maximum(side * light[axis], 0.0) for light in lights]
        ambient, *strengths = _strengths(scene, geom)
        red, green, blue = (
            ambient[k] + sum(c * s[k] for c, s in zip(cosines, strengths, strict=True))
            for k in range(3)
        )
        faces.append((red, green, blue))
    return _Frame(origin, (right, down, forward), lights, tuple(faces))


def _into(rotation: Float[np.ndarray, "3 3"], vector: Any) -> Vector:
    """Rotate a vector into a geom's frame; by nothing if the axes are the world's."""
    if np.array_equal(rotation, np.eye(3)):
        return vector[0], vector[1], vector[2]
    x, y, z = (
        rotation[0, k] * vector[0] + (rotation[1, k] * vector[1] + rotation[2, k] * vector[2])
        for k in range(3)
    )
    return x, y, z


def _strengths(scene: Scene, geom: SceneGeom) -> list[Rgb]:
    """Return the light on a geom from all sides, and that of each light, the headlight last."""
    red, green, blue = (value + geom.emission for value in scene.ambient)
    return [(red, green, blue), *(light.diffuse for light in scene.lights), scene.headlight]


def _hits(scene: Scene, frames: Sequence[_Frame], rays: Rays) -> list[Hit]:
    """Intersect the rays of an image with all geoms."""
    hits, directions = [], {}
    for geom, frame in zip(scene.geoms, frames, strict=True):
        key = geom.rotation.tobytes()
        if key not in directions:
            directions[key] = _directions(frame, rays)
        hits.append(_HITS[geom.kind](frame.origin, directions[key], geom.size))
    return hits


def _directions(frame: _Frame, rays: Rays) -> Vector:
    """Return the directions of rays in a geom's frame."""
    right, down, forward = frame.axes
    x, y, z = (right[k] * rays.x + (down[k] * rays.y + forward[k]) for k in range(3))
    return x, y, z


def _shares(scene: Scene, frames: Sequence[_Frame], rays: Rays) -> list[list[Array]]:
    """Return what one ray of every pixel sees, to be summed over the rays.

    Returns:
      For every geom: for a plane or a box, 1 where the ray sees the face, for each of its faces;
      for another one, 1 where the ray sees it, and there the cosine to each light.
    """
    hits = _hits(scene, frames, rays)
    if len(hits) > _FUSED_GEOMS:
        hits = jax.lax.optimization_barrier(hits)
    nearest: Any = functools.reduce(jnp.minimum, [hit.masked_depth for hit in hits], jnp.inf)
    shares, free = [], jnp.ones((), bool)
    for geom, frame, hit in zip(scene.geoms, frames, hits, strict=True):
        # Where two geoms have the same depth, the first one is seen.
        seen = hit.mask & free & (hit.depth <= nearest if len(hits) > 1 else True)
        free &= ~seen
        if geom.kind == "box":
            first, second = hit.faces
            parts = [seen & first, seen & ~first & second, seen & ~first & ~second]
            shares.append([part.astype(jnp.float32) for part in parts])
            continue
        share = [seen.astype(jnp.float32)]
        if geom.kind in _NORMALS:
            directions = _directions(frame, rays)
            point = geometry.along(frame.origin, directions, hit.depth)
            normal = _NORMALS[geom.kind](point, geom.size)
            for light in frame.lights:
                share.append(jnp.where(seen, jnp.maximum(geometry.dot(normal, light), 0.0), 0.0))
        shares.append(share)
    return shares


def _mix(
    scene: Scene,
    frames: Sequence[_Frame],
    shares: Sequence[Sequence[Array]],
    sky: Sequence[Any],
    print_of_pixel: Footprint,
    samples: int,
) -> list[Array]:
    """Return the channels of an image from what its rays see, 1 is white."""
    rest: Any = float(samples)
    channels: list[Any] = [0.0, 0.0, 0.0]
    for geom, frame, share in zip(scene.geoms, frames, shares, strict=True):
        if geom.kind in _NORMALS:
            count, *cosines = share
            ambient, *strengths = _strengths(scene, geom)
            lit = [
                count * ambient[k]
                + sum(c * strength[k] for c, strength in zip(cosines, strengths, strict=True))
                for k in range(3)
            ]
            rest = rest - count
        else:
            lit = [
                sum(part * face[k] for part, face in zip(share, frame.faces, strict=True))
                for k in range(3)
            ]
            rest = rest - sum(share)
        colour = geom.rgb
        if geom.checker is not None:
            colour = _checker_colours(geom.checker, frame, print_of_pixel)
        channels = [channels[k] + colour[k] * lit[k] for k in range(3)]
    return [(total + rest * sky[k]) / samples for k, total in enumerate(channels)]


def _checker_colours(checker: Checker, frame: _Frame, pixel: Footprint) -> list[Array]:
    """Return the mean colour of a checker texture over every pixel's area on its plane.

    The point p = o - d o_z/d_z that a pixel sees moves by t (e - d e_z/d_z) where d changes by e.
    A checker is the product of two square waves; the mean of each over the pixel's extent is exact,
    of the product it is for a pixel whose sides are parallel to the squares'.
    """
    origin = frame.origin
    direction = _directions(frame, pixel.centre)
    # A pixel at or above the horizon sees the plane far away, if any of its rays does.
    down = jnp.minimum(direction[2], -1e-4)
    slope = 1.0 / down
    depth = -origin[2] * slope
    changes = [
        [frame.axes[0][k] * change.x + frame.axes[1][k] * change.y for k in range(3)]
        for change in (pixel.right, pixel.down)
    ]
    waves: Any = 1.0
    for axis in (0, 1):
        scale = 1.0 / checker.size[axis]
        at = (origin[axis] - checker.start[axis]) + depth * direction[axis]
        extent: Any = 0.0
        for change in changes:
            moved = change[axis] - direction[axis] * (change[2] * slope)
            extent = extent + jnp.abs(depth * moved)
        waves = waves * _square_wave(at * scale, jnp.maximum(extent * scale, 1e-3))
    even = 0.5 + 0.5 * waves
    return [
        odd + (of_even - odd) * even for of_even, odd in zip(checker.even, checker.odd, strict=True)
    ]


def _square_wave(at: Array, width: Array) -> Array:
    """Return the mean of a wave that is 1 on [0, 1), -1 on [1, 2) and so on, around a place."""

    def integral(x: Array) -> Array:
        phase = 0.5 * x
        return 1.0 - jnp.abs(2.0 * (phase - jnp.floor(phase)) - 1.0)

    return (integral(at + 0.5 * width) - integral(at - 0.5 * width)) / width


def _sky(scene: Scene, pose: Pose, pixel: Footprint) -> Sequence[Any]:
    """Return the colours of the sky, which change from the horizon to the zenith.

    MuJoCo's gradients are mixed by m = √2 e / √(1 + e²), where e is the elevation, 1 at the zenith.
    Of the sine s of that angle, m = 1 - √(1 - s) (1 - 0.3754 s - 0.1205 s²), to within 0.003.
    """
    if scene.horizon == scene.zenith:
        return scene.horizon
    x, y = pixel.centre
    right, down, forward = (pose.rotation[2, k] for k in range(3))
    length = np.sqrt(x * x + y * y + 1.0)
    sine = jnp.maximum(right * (x / length) + (down * (y / length) + forward / length), 0.0)
    part = 1.0 - jnp.sqrt(jnp.maximum(1.0 - sine, 0.0)) * (1.0 - sine * (0.3754 + 0.1205 * sine))
    ends = zip(scene.horizon, scene.zenith, strict=True)
    return [low + (high - low) * part for low, high in ends]


def _to_words(channel: Array) -> UInt32[Array, "h w"]:
    return (jnp.clip(channel, 0.0, 1.0) * 255.0 + 0.5).astype(jnp.uint32)
