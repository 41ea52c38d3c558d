"""Carry what a camera with drawn looks needs from step to step, and delay and lose its images.

A late image is the image of an earlier pose. The state therefore holds no second image, but the
poses of the last control steps, of robot and markers, and the one that is seen now. Everything is a
pure function of one robot, and is data of its episode.
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt32

from jetbot_mjx.config import LookParams
from jetbot_mjx.envs.camera.surroundings import Surroundings


class SeenPose(NamedTuple):
    """A `SeenPose` holds what an image depends on and what changes from step to step."""

    position_w: Float[Array, "3"]
    """Position of the axle midpoint [m], world frame."""
    quat: Float[Array, "4"]
    """Attitude of the robot as a unit quaternion (w, x, y, z)."""
    markers: Mapping[str, Float[Array, "3"]]
    """Positions of the task's bodies [m], world frame."""
    time: Float[Array, ""]
    """Time since the episode began [s]."""


class CameraState(NamedTuple):
    """A `CameraState` holds the looks of one episode, and the poses of its last steps."""

    values: dict[str, Array]
    """The look parameters that differ from the plain scene, by name."""
    surroundings: Surroundings
    key: UInt32[Array, "2"] | None
    """Random key of the noise and the lost images; None: there are none."""
    seen: SeenPose | None
    """The pose of the image that is seen now; None: it is always the present one."""
    waiting: SeenPose | None
    """The poses of the last steps, the newest first; None: there is no delay."""

    @property
    def params(self) -> LookParams:
        """Return the look parameters."""
        return LookParams()._replace(**self.values)


_LATE = ("camera_delay", "camera_interval", "frame_drop")


def initial_camera_state(
    start: SeenPose,
    key: UInt32[Array, "2"],
    params: LookParams,
    surroundings: Surroundings,
    longest_delay: int,
) -> CameraState:
    """Return the state at the start of an episode: the robot has been at rest there.

    Args:
      start: the pose at the start.
      key: the random key of the episode's images.
      params: the look parameters.
      surroundings: what stands around.
      longest_delay: the longest `camera_delay` that the compiled program supports [control steps].
    """
    repeated = jax.tree.map(lambda x: jnp.repeat(x[None], longest_delay, axis=0), start)
    return CameraState(
        values={
            name: jnp.asarray(value, jnp.float32)
            for name, value in params._asdict().items()
            if params.differs(name)
        },
        surroundings=surroundings,
        key=key if params.differs("pixel_noise", "frame_drop") else None,
        seen=start if params.differs(*_LATE) else None,
        waiting=repeated if longest_delay else None,
    )


def step_camera(camera: CameraState, now: SeenPose, step: Int[Array, ""]) -> CameraState:
    """Return the state after one control step.

    Args:
      camera: the state before the step.
      now: the pose after the step.
      step: control steps since the episode began.
    """
    params, seen, waiting = camera.params, camera.seen, camera.waiting
    if seen is None:
        return camera
    due = now
    if waiting is not None:
        history = jax.tree.map(lambda x, y: jnp.concatenate([x[None], y]), now, waiting)
        delay = jnp.round(jnp.asarray(params.camera_delay)).astype(jnp.int32)
        due = jax.tree.map(lambda x: x[delay], history)
        waiting = jax.tree.map(lambda x: x[:-1], history)
    arrives = jnp.ones((), bool)
    if params.differs("camera_interval"):
        arrives = step % jnp.round(jnp.asarray(params.camera_interval)).astype(jnp.int32) == 0
    if camera.key is not None and params.differs("frame_drop"):
        # A key per step without a draw: any two integers are a valid Threefry key.
        key = camera.key ^ jnp.stack([jnp.uint32(0), step.astype(jnp.uint32)])
        arrives &= jax.random.uniform(key) >= params.frame_drop
    seen = jax.tree.map(lambda new, old: jnp.where(arrives, new, old), due, seen)
    return camera._replace(seen=seen, waiting=waiting)


def noise_seed(key: UInt32[Array, "2"], time: Float[Array, ""]) -> UInt32[Array, ""]:
    """Return a seed that differs between episodes and between the images of one.

    Args:
      key: the random key of the episode's images.
      time: time of the image since the episode began [s].
    """
    bits = jax.lax.bitcast_convert_type(time, jnp.uint32)
    # A product with an odd number is another one for every time.
    return key[0] + (bits ^ key[1]) * jnp.uint32(0x85EBCA6B)
