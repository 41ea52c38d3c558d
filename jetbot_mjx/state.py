"""What an episode carries from step to step: Brax's state, kept as small as physics allows."""

import brax.envs
from flax import struct
from jaxtyping import Array, Float, UInt32

from jetbot_mjx import kinematics
from jetbot_mjx.model import QPOS_QUAT, QPOS_XYZ, QVEL_ANGULAR_B, QVEL_LINEAR_W
from jetbot_mjx.task import Goal, RobotState


@struct.dataclass
class PhysicsState:
    """What physics integrates, and nothing that can be computed from it."""

    qpos: Float[Array, " nq"]
    """Position (x, y, z) [m], quaternion (w, x, y, z), wheel angles (left, right) [rad]."""
    qvel: Float[Array, " nv"]
    """Velocity, world frame [m/s]; angular velocity, body frame; wheel speeds [rad/s]."""
    qacc_warmstart: Float[Array, " nv"]
    """Last acceleration, where the solver starts from."""
    time: Float[Array, ""]
    """Since the episode began [s]."""


@struct.dataclass
class State(brax.envs.State):
    """Brax's environment state, with the task's own parts beside it."""

    goal: Goal = None
    """What the task drew for this episode."""
    key: UInt32[Array, "2"] | None = None
    """Random key from which the next episode is drawn."""


def robot_state(physics: PhysicsState) -> RobotState:
    """The robot as a task sees it, from the generalised coordinates.

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
