"""Render a robot's camera: one frame, pure and unbatched; batch with `jax.vmap`.

A pixel is the mean of its area: `camera.samples`² rays decide what share of it each surface covers,
and a checker texture is averaged over the pixel's footprint on the plane in closed form. So a small
image looks like a large one that was made smaller.

What depends on the frame only (origins, rotations, the light on flat faces) is computed once per
frame and kept apart from what is computed per pixel, so that XLA does not repeat it in every pixel.
"""

import functools
from collections.abc import Hashable, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from jetbot_mjx.config import CameraConfig, LookParams
from jetbot_mjx.envs import kinematics
from jetbot_mjx.envs.camera import looks, pixel
from jetbot_mjx.envs.camera.geometry import Vector, triple
from jetbot_mjx.envs.camera.lens import pixel_grid
from jetbot_mjx.envs.camera.scene import Scene, SceneGeom, read_scene
from jetbot_mjx.envs.camera.surroundings import clutter_positions, make_room, with_clutter
from jetbot_mjx.envs.kernel_impl import KernelImpl
from jetbot_mjx.envs.robot_model import mocap_ids
from onekernel import Kernel
from onekernel.build import scalarize

GREY = (0.299, 0.587, 0.114)  # weights of red, green and blue; source: ITU-R BT.601


class Pose(NamedTuple):
    """A `Pose` holds where a camera is and how it is turned, in the world frame."""

    position: Float[Array, "3"]
    """Position of the optical centre [m]."""
    rotation: Float[Array, "3 3"]
    """Axes of the image (right, down, forward) as columns."""


class Camera:
    """A `Camera` renders what a robot's camera sees."""

    def __init__(self, config: CameraConfig, model: mujoco.MjModel, robot: str = "jetbot") -> None:
        """Read the scene and compute the rays.

        Args:
          config: the camera section.
          model: the compiled model with its visual elements.
          robot: the name of the body that carries the camera.

        Raises:
          UserError: the scene has something that cannot be rendered, the lens is invalid, or the
            requested kernel back end is not available.
        """
        self.kernel_impl = KernelImpl("camera.impl", config.impl)
        self.kernel_impl.require()
        self.config = config
        self.scene: Scene = read_scene(model, robot)
        self._grid = pixel_grid(config)
        self._standing = {
            name: np.asarray(model.body(name).pos, np.float32) for name in mocap_ids(model)
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

    def pose(
        self,
        position_w: Float[Array, "3"],
        quat: Float[Array, "4"],
        params: LookParams = looks.PLAIN.params,
    ) -> Pose:
        """Return the camera's pose on a robot.

        Args:
          position_w: position of the axle midpoint [m], world frame.
          quat: attitude of the robot as a unit quaternion (w, x, y, z).
          params: look parameters, of which those of the mount are used.
        """
        body = jnp.stack([kinematics.rotate(quat, axis) for axis in jnp.eye(3)], 1)
        highest = jax.lax.Precision.HIGHEST
        offset, rotation = _mounted(self._mount_position, self._mount_rotation, params)
        mount = jnp.dot(body, offset, precision=highest)
        return Pose(position_w + mount, jnp.dot(body, rotation, precision=highest))

    def render(
        self,
        pose: Pose,
        mocap_positions: Mapping[str, Float[Array, "3"]],
        appearance: looks.Appearance = looks.PLAIN,
    ) -> UInt8[Array, "h w c"]:
        """Return the image, without noise.

        Args:
          pose: the pose of the camera.
          mocap_positions: positions [m] of mocap bodies, world frame, by name; those of others are
            the model's.
          appearance: how the world looks; parameters of the mount, the noise and the time do not
            count here.

        Returns:
          Colours from 0 to 255, red, green, blue, or one channel of grey; the first row is the
          upper one.
        """
        shared, structure = self.shared(pose, mocap_positions, appearance)
        # The structure says what differs between episodes.
        lower = functools.partial(self.make_kernel, structure, shared.size)
        kernel = self.kernel_impl.find_kernel(structure, lower)
        values = self._fallback(structure, shared)[0] if kernel is None else kernel.as_map()(shared)
        return values.reshape(self.shape)

    def shared(
        self,
        pose: Pose,
        mocap_positions: Mapping[str, Float[Array, "3"]],
        appearance: looks.Appearance = looks.PLAIN,
    ) -> tuple[Float[Array, " shared"], Hashable]:
        """Return what all pixels of an image share, and the structure of these numbers.

        Args:
          pose: the pose of the camera.
          mocap_positions: positions [m] of mocap bodies, as for `render`.
          appearance: how the world looks.
        """
        leaves, structure = jax.tree.flatten(self._frame(pose, mocap_positions, appearance))
        return jnp.stack(leaves), structure

    def make_kernel(self, structure: Hashable, leaves: int) -> Kernel:
        """Lower an image to a kernel, which takes as many numbers of a structure from `shared`.

        Raises:
          UnsupportedError: an operation cannot be lowered.
        """
        sizes = leaves, len(self._table)
        arguments = [jax.ShapeDtypeStruct((n,), jnp.float32) for n in sizes]
        program = scalarize(functools.partial(self._pixel, structure), *arguments)
        return self.kernel_impl.kernel_class(
            program,
            carried=0,
            steps=1,
            fallback=functools.partial(self._fallback, structure),
            table=self._table,
        )

    def _fallback(
        self, structure: Hashable, shared: Float[Array, " shared"]
    ) -> list[UInt8[Array, " bytes"]]:
        """Compute all pixels by XLA."""
        # Keep the stages apart: XLA would compute what the pixels share in every pixel, and all
        # rays of a pixel for each of its channels.
        shared = jax.lax.optimization_barrier(shared)
        one = functools.partial(self._pixel, structure)
        channels = jax.vmap(one, in_axes=(None, 1))(shared, jnp.asarray(self._table))
        channels = jax.lax.optimization_barrier(channels)
        return [jnp.stack(channels, axis=-1).astype(jnp.uint8).reshape(-1)]

    @functools.cached_property
    def _table(self) -> Float[np.ndarray, "columns pixels"]:
        columns = [np.broadcast_to(column, self.shape[:2]) for column in self._grid.columns]
        return np.stack(columns).reshape(len(columns), -1).astype(np.float32)

    @functools.cached_property
    def _farthest(self) -> float:
        """The largest x² + y² of the directions of all pixels."""
        x, y = self._grid.expand(self._grid.columns)[1].centre
        return float(np.max(np.asarray(x) ** 2 + np.asarray(y) ** 2))

    def _pixel(
        self,
        structure: Hashable,
        shared: Float[Array, " shared"],
        columns: Float[Array, " columns"],
    ) -> list[Float[Array, ""]]:
        """Return the channels of a pixel, whole numbers from 0 to 255 as floats."""
        frame: pixel.Frame = jax.tree.unflatten(structure, list(shared))
        scene = with_clutter(self.scene, frame.clutter)
        scene = looks.styled(scene, LookParams()._replace(**frame.params))
        samples, footprint = self._grid.expand(list(columns))
        rays = looks.bend_rays(frame.params, samples, footprint, self._farthest)
        channels = looks.developed(frame.params, pixel.pixel_colour(scene, frame, *rays))
        if self.config.colour == "grey":
            channels = [sum(weight * x for weight, x in zip(GREY, channels, strict=True))]
        return [jnp.floor(jnp.clip(x, 0.0, 1.0) * 255.0 + 0.5) for x in channels]

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
        frame = self._frame(pose, mocap_positions, looks.PLAIN)
        nearest = jnp.full(self.shape[:2], jnp.inf)
        found = jnp.full(self.shape[:2], -1)
        _, footprint = self._grid.expand(self._grid.columns)
        for geom, look in zip(self.scene.geoms, frame.looks, strict=True):
            axes = frame.axes[geom.axes_key]
            rays = pixel.directions(axes, footprint.centre)
            hit = pixel.HITS[geom.kind](look.origin, rays, geom.size)
            closer = hit.mask & (hit.depth < nearest)
            nearest = jnp.where(closer, hit.depth, nearest)
            found = jnp.where(closer, geom.geom_id, found)
        return nearest, found

    def _frame(
        self,
        pose: Pose,
        mocap_positions: Mapping[str, Float[Array, "3"]],
        appearance: looks.Appearance,
    ) -> pixel.Frame:
        """Compute everything that all pixels of a frame share."""
        params, (walls, clutter) = appearance
        places, colours = {**self._standing, **mocap_positions}, []
        if clutter is not None:
            places |= clutter_positions(clutter, params.clutter)
            colours = [(one[2], one[3], one[4]) for one in clutter]
        scene = looks.styled(with_clutter(self.scene, colours), params)
        towards = [*(-light.direction for light in scene.lights), -pose.rotation[:, 2]]
        axes, drawn = {}, []
        for geom in scene.geoms:
            rotation, position = geom.rotation, geom.position
            if geom.yaw is not None:
                rotation = looks.turned(rotation, geom.yaw)
                position = looks.turned(position[:, None], geom.yaw)[:, 0]
            if geom.axes_key not in axes:
                right, down, forward = (_into(rotation, pose.rotation[:, k]) for k in range(3))
                lights = tuple(_into(rotation, vector) for vector in towards)
                axes[geom.axes_key] = pixel.Axes((right, down, forward), lights)
            if geom.mocap is not None:
                position = position + places[geom.mocap]
            origin = _into(rotation, pose.position - position)
            centre = _into(pose.rotation, position - pose.position)
            faces = _faces(scene, geom, origin, axes[geom.axes_key].lights)
            drawn.append(pixel.Look(origin, centre, faces))
        yaw = params.floor_yaw
        frame = pixel.Frame(
            axes,
            drawn,
            up=triple(pose.rotation[2, k] for k in range(3)),
            params=looks.pixel_values(params),
            clutter=colours,
            room=None if walls is None else make_room(walls, params.walls, *pose),
            floor_turn=(jnp.cos(yaw), jnp.sin(yaw)) if params.differs("floor_yaw") else None,
        )
        return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), frame)


def _mounted(
    position: Float[np.ndarray, "3"], rotation: Float[np.ndarray, "3 3"], params: LookParams
) -> tuple[Float[Array | np.ndarray, "3"], Float[Array | np.ndarray, "3 3"]]:
    """Return place and axes of the camera, body frame, for another mount."""
    names = ("camera_x", "camera_y", "camera_z")
    place: Float[Array | np.ndarray, 3] = position
    if params.differs(*names):
        place = position + jnp.stack([jnp.asarray(getattr(params, name)) for name in names])
    axes: Float[Array | np.ndarray, "3 3"] = rotation
    if params.differs("camera_pitch", "camera_roll", "camera_yaw"):
        right, down, forward = jnp.asarray(rotation).T
        cosine, sine = jnp.cos(params.camera_roll), jnp.sin(params.camera_roll)
        right, down = cosine * right + sine * down, cosine * down - sine * right
        x, y, z = jnp.stack([right, down, forward], axis=1)
        cosine, sine = jnp.cos(params.camera_pitch), jnp.sin(params.camera_pitch)
        lowered = jnp.stack([cosine * x + sine * z, y, cosine * z - sine * x])
        axes = looks.turned(lowered, params.camera_yaw)
    return place, axes


def _faces(
    scene: Scene, geom: SceneGeom, origin: Vector, lights: Sequence[Vector]
) -> tuple[Vector, ...]:
    """Return the light on the flat faces of a geom that the camera can see."""
    faces = []
    ambient, *diffuse = pixel.strengths(scene, geom)
    for axis in {"plane": (2,), "box": (0, 1, 2)}.get(geom.kind, ()):
        side = 1.0 if geom.kind == "plane" else jnp.sign(origin[axis])
        cosines = [jnp.maximum(side * light[axis], 0.0) for light in lights]
        light = (
            ambient[k] + sum(c * s[k] for c, s in zip(cosines, diffuse, strict=True))
            for k in range(3)
        )
        faces.append(triple(light))
    return tuple(faces)


def _into(
    rotation: Float[Array | np.ndarray, "3 3"], vector: Float[Array | np.ndarray, "3"]
) -> Vector:
    """Rotate a vector into a frame with the given axes; by nothing if they are the world's."""
    if isinstance(rotation, np.ndarray) and np.array_equal(rotation, np.eye(3)):
        return triple(vector[k] for k in range(3))
    return triple(
        rotation[0, k] * vector[0] + (rotation[1, k] * vector[1] + rotation[2, k] * vector[2])
        for k in range(3)
    )
