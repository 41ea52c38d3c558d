"""Define the state of an environment: Brax's state, as small as physics allows."""

from flax import struct
from jaxtyping import Array, Float, PyTree

from jetbot_mjx.envs import kinematics
from jetbot_mjx.envs.robot_model import QPOS_QUAT, QPOS_XYZ, QVEL_ANGULAR_B, QVEL_LINEAR_W
from jetbot_mjx.envs.task import Goal, RobotState


class PhysicsState(struct.PyTreeNode):
    """A `PhysicsState` holds what physics integrates, and nothing that follows from it.

    `mjx.Data` is rebuilt from it at every step, so that a batch of states stays small in memory.
    """

    qpos: Float[Array, " nq"]
    """Generalised position: axle midpoint (x, y, z) [m] in the world frame, attitude quaternion
    (w, x, y, z), wheel angles (left, right) [rad]."""
    qvel: Float[Array, " nv"]
    """Generalised velocity: linear velocity in the world frame [m/s], angular velocity in the body
    frame [rad/s], wheel speeds (left, right) [rad/s]."""
    qacc_warmstart: Float[Array, " nv"]
    """Acceleration of the last physics step, from which the constraint solver starts."""
    time: Float[Array, ""]
    """Simulated time since the episode began [s]."""


Obs = Float[Array, " obs"] | dict[str, Array]
"""Observation of the policy: a vector of numbers, or a dictionary with images, as of
`CameraWrapper`."""


class State(struct.PyTreeNode):
    """A `State` holds the state of an environment: Brax's fields and those of this package.

    The names are stored in checkpoints.
    """

    pipeline_state: PyTree
    """The `PhysicsState`; the name is Brax's. An environment of one's own has what it likes."""
    obs: Obs
    reward: Float[Array, ""]
    """Reward of the last step."""
    done: Float[Array, ""]
    """1 where the last step ended the episode, else 0."""
    metrics: dict[str, Float[Array, ""]] = struct.field(default_factory=dict)
    """Metrics of the last step; the names are the same at every step."""
    info: dict[str, PyTree] = struct.field(default_factory=dict)
    """Fields of wrappers and trainers; the names are the same at every step."""
    goal: Goal = ()
    """The goal that the task drew for this episode, as it stands now; an environment of one's own
    has none."""
    key: PyTree = None
    """Random key from which the next episode is drawn, shape (2,) and uint32; an environment of
    one's own need not set it."""
    episode_params: PyTree = None
    """`EpisodeParams` of a `DomainRandomizationWrapper`: the robot parameters of this episode and
    the states of actuators, sensors and camera. None: the robot is its preset."""


def robot_state(physics: PhysicsState) -> RobotState:
    """Return the robot state that a task sees, from the generalised coordinates.

    MuJoCo's free joint has the linear velocity in the world frame but the angular velocity in the
    body frame; the latter is rotated into the world frame here.

    Args:
      physics: the physics state.
    """
    quat = physics.qpos[QPOS_QUAT]
    return RobotState(
        position_w=physics.qpos[QPOS_XYZ],
        quat=quat,
        linear_velocity_w=physics.qvel[QVEL_LINEAR_W],
        angular_velocity_w=kinematics.rotate(quat, physics.qvel[QVEL_ANGULAR_B]),
    )
