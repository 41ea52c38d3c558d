"""Write a pose into MuJoCo's simulation data, for all viewers."""

from collections.abc import Mapping

import mujoco
import numpy as np
from jaxtyping import Float


def set_pose(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    qpos: Float[np.ndarray, " nq"],
    markers: Mapping[str, object],
) -> None:
    """Set the pose of the robot and of the task's mocap bodies, and update the body frames.

    Args:
      model: the model with all visual elements.
      data: its simulation data, modified in place.
      qpos: generalised position, as in `PhysicsState`.
      markers: positions [m] of the mocap bodies, world frame, by name, as `Task.markers` returns.
    """
    data.qpos[:] = qpos
    for name, position in markers.items():
        data.mocap_pos[model.body(name).mocapid[0]] = np.asarray(position)
    mujoco.mj_kinematics(model, data)
