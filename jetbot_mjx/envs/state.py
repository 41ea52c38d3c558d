"""The state of an episode: Brax's state, kept as small as physics allows."""

from typing import Any

from flax import struct
from jaxtyping import Array, Float, UInt32

from jetbot_mjx.envs import kinematics
from jetbot_mjx.envs.robot_model import QPOS_QUAT, QPOS_XYZ, QVEL_ANGULAR_B, QVEL_LINEAR_W
from jetbot_mjx.envs.task import Goal, RobotState


class PhysicsState(struct.PyTreeNode):
    """The quantities that physics integrates, and nothing that can be computed from them."""

    qpos: Float[Array, " nq"]
    """Position (x, y, z) [m], quaternion (w, x, y, z), wheel angles (left, right) [rad]."""
    qvel: Float[Array, " nv"]
    """Velocity, world frame [m/s]; angular velocity, body frame; wheel speeds [rad/s]."""
    qacc_warmstart: Float[Array, " nv"]
    """Last acceleration, where the solver starts from."""
    time: Float[Array, ""]
    """Since the episode began [s]."""


class State(struct.PyTreeNode):
    """An environment's state: Brax's fields, which its trainers use, and the task's own."""

    pipeline_state: PhysicsState
    """What physics integrates, under Brax's name for it."""
    obs: Float[Array, " obs"]
    """What the policy sees."""
    reward: Float[Array, ""]
    """Of the step that led here."""
    done: Float[Array, ""]
    """1 where that step ended the episode."""
    metrics: dict[str, Float[Array, ""]]
    """Metrics of that step; the same names at every step."""
    info: dict[str, Any]
    """What wrappers and trainers keep beside; the same names at every step."""
    goal: Goal
    """What the task drew for this episode."""
    key: UInt32[Array, "2"]
    """Random key from which the next episode is drawn."""
    episode_params: Any = None
    """How this episode's robot differs from its preset, and what its motors and sensors remember;
    None: it is its preset."""


def robot_state(physics: PhysicsState) -> RobotState:
    """Return the robot as a task sees it, from the generalised coordinates.

    MuJoCo's free joint holds the velocity of the body's origin in the world frame, but the
    angular velocity in the body frame: it is rotated here.
    """
    quat = physics.qpos[QPOS_QUAT]
    return RobotState(
        position_w=physics.qpos[QPOS_XYZ],
        quat=quat,
        linear_velocity_w=physics.qvel[QVEL_LINEAR_W],
        angular_velocity_w=kinematics.rotate(quat, physics.qvel[QVEL_ANGULAR_B]),
    )
