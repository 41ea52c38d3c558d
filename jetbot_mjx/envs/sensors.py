"""A sensor model: the robot's own state, late and inexact. A pure pipeline of one robot.

It stands between physics and the task's `observe`, so any observation of any task has its share.
The first one of an episode has no delay and no noise: a robot that stands can take its time to
look. Offsets are in every one.
Reward, success and the end of an episode follow the true state; the goal is known as it is.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt32

from jetbot_mjx.envs import kinematics
from jetbot_mjx.envs.robot_params import RobotParams
from jetbot_mjx.envs.task import RobotState

_NOISE = ("position_noise", "yaw_noise", "speed_noise", "yaw_rate_noise")
_OFFSETS = ("height_offset", "pitch_offset")


class SensorState(NamedTuple):
    """The memory of the sensor model."""

    seen: Float[Array, "delay robot"] | None
    """The last states of the robot, the newest first; None: there is no delay."""
    key: UInt32[Array, "2"] | None
    """Random key of this episode's noise; None: there is no noise."""


def sensors_at_start(
    robot: RobotState, key: UInt32[Array, "2"], robot_params: RobotParams, longest_delay: int
) -> SensorState:
    """Return the state of sensors that have seen the robot stand where it starts.

    Args:
      robot: there.
      key: of the noise.
      robot_params: the robot's.
      longest_delay: of any robot that the program serves [control steps].

    Returns:
      What they remember.
    """
    return SensorState(
        jnp.repeat(jnp.concatenate(robot)[None], longest_delay, axis=0) if longest_delay else None,
        key if robot_params.differs(*_NOISE) else None,
    )


def sense(
    sensors: SensorState, robot: RobotState, robot_params: RobotParams, step: Int[Array, ""]
) -> tuple[SensorState, RobotState]:
    """Return the state that the robot measures.

    Args:
      sensors: before.
      robot: as it is.
      robot_params: the robot's.
      step: control steps since the episode began.

    Returns:
      The sensors after it, and the state of `observation_delay` steps ago, with noise and offsets.
    """
    seen, key = sensors
    if seen is not None:
        line = jnp.concatenate([jnp.concatenate(robot)[None], seen])
        late = line[jnp.round(robot_params.observation_delay).astype(jnp.int32)]
        ends = [3, 7, 10]  # position, quaternion, velocity, angular velocity
        robot = RobotState(*jnp.split(late, ends))
        seen = line[:-1]
    if key is not None:
        # Another key for every step, without drawing it: Threefry takes any.
        own = key ^ jnp.stack([jnp.uint32(0), step.astype(jnp.uint32)])
        robot = _noisy(robot, own, robot_params)
    return SensorState(seen, key), with_offsets(robot, robot_params)


def with_offsets(robot: RobotState, robot_params: RobotParams) -> RobotState:
    """Return a robot's state with the errors that last a whole episode.

    The attitude alone is turned: velocities in the world frame do not depend on it.

    Args:
      robot: its state.
      robot_params: its offsets.
    """
    if not robot_params.differs(*_OFFSETS):
        return robot
    up = jnp.stack([jnp.zeros(()), jnp.zeros(()), jnp.asarray(robot_params.height_offset)])
    return robot._replace(
        position_w=robot.position_w + up,
        quat=kinematics.pitched(robot.quat, jnp.asarray(robot_params.pitch_offset)),
    )


def _noisy(robot: RobotState, key: UInt32[Array, "2"], robot_params: RobotParams) -> RobotState:
    x, y, turn, vx, vy, spin = jax.random.normal(key, (6,))
    zero = jnp.zeros(())
    return RobotState(
        position_w=robot.position_w + robot_params.position_noise * jnp.stack([x, y, zero]),
        quat=kinematics.turned(robot.quat, robot_params.yaw_noise * turn),
        linear_velocity_w=robot.linear_velocity_w
        + robot_params.speed_noise * jnp.stack([vx, vy, zero]),
        angular_velocity_w=robot.angular_velocity_w
        + robot_params.yaw_rate_noise * jnp.stack([zero, zero, spin]),
    )
