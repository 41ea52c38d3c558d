"""Model the sensors: delay, noise and offsets of the robot state that the policy observes.

The model is a pure function of one robot. It runs between physics and the task's `observe`, so it
acts on every observation of every task. Reward, success and termination use the true state, and the
goal has no errors. The first observation of an episode has no delay and no noise, since a robot at
rest has time to average; offsets are in every observation.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt32

from jetbot_mjx.config import RobotParams
from jetbot_mjx.envs import kinematics
from jetbot_mjx.envs.task import RobotState

_NOISE = ("position_noise", "yaw_noise", "speed_noise", "yaw_rate_noise")
_OFFSETS = ("height_offset", "pitch_offset")


class SensorState(NamedTuple):
    """A `SensorState` holds what the sensor model carries from step to step."""

    seen: Float[Array, "delay robot"] | None
    """The last robot states, the newest first, each as the concatenated fields of a `RobotState`;
    None: the model has no delay."""
    key: UInt32[Array, "2"] | None
    """Random key of this episode's noise; None: the model has no noise."""


def initial_sensor_state(
    robot: RobotState, key: UInt32[Array, "2"], robot_params: RobotParams, longest_delay: int
) -> SensorState:
    """Return the sensor state at the start of an episode: the robot has been at rest there.

    Args:
      robot: the robot state at the start.
      key: the random key of the noise.
      robot_params: the parameters of the robot.
      longest_delay: the longest `observation_delay` that the compiled program supports
        [control steps].
    """
    return SensorState(
        jnp.repeat(jnp.concatenate(robot)[None], longest_delay, axis=0) if longest_delay else None,
        key if robot_params.differs(*_NOISE) else None,
    )


def step_sensors(
    sensors: SensorState, robot: RobotState, robot_params: RobotParams, step: Int[Array, ""]
) -> tuple[SensorState, RobotState]:
    """Return the robot state that the sensors measure in this step.

    Args:
      sensors: the sensor state before the step.
      robot: the true robot state.
      robot_params: the parameters of the robot.
      step: control steps since the episode began.

    Returns:
      The sensor state after the step, and the robot state of `observation_delay` steps ago with
      noise and offsets.
    """
    seen, key = sensors
    if seen is not None:
        history = jnp.concatenate([jnp.concatenate(robot)[None], seen])
        delayed = history[jnp.round(robot_params.observation_delay).astype(jnp.int32)]
        ends = [3, 7, 10]  # position, quaternion, velocity, angular velocity
        robot = RobotState(*jnp.split(delayed, ends))
        seen = history[:-1]
    if key is not None:
        # A key per step without a draw: any two integers are a valid Threefry key.
        step_key = key ^ jnp.stack([jnp.uint32(0), step.astype(jnp.uint32)])
        robot = _add_noise(robot, step_key, robot_params)
    return SensorState(seen, key), add_offsets(robot, robot_params)


def add_offsets(robot: RobotState, robot_params: RobotParams) -> RobotState:
    """Return a robot state with the offsets in height and pitch, constant over an episode.

    Only the attitude is rotated: velocities in the world frame do not depend on it.

    Args:
      robot: the robot state.
      robot_params: the parameters of the robot.
    """
    if not robot_params.differs(*_OFFSETS):
        return robot
    up = jnp.stack([jnp.zeros(()), jnp.zeros(()), jnp.asarray(robot_params.height_offset)])
    return robot._replace(
        position_w=robot.position_w + up,
        quat=kinematics.pitched(robot.quat, jnp.asarray(robot_params.pitch_offset)),
    )


def _add_noise(robot: RobotState, key: UInt32[Array, "2"], robot_params: RobotParams) -> RobotState:
    """Add Gaussian noise to the planar quantities: x, y, yaw and their rates."""
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
