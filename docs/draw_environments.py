"""Draw the standard tasks: `python docs/draw_environments.py docs/environments.png`."""

import sys

import imageio.v3 as iio
import mujoco
import numpy as np

from jetbot_mjx import load_config, make_env

WIDTH, HEIGHT = 256, 320  # [pixels] of one task
VIEWS = {
    "cartpole": ((0.0, 0.0, 0.3), 3.2, {"hinge": 0.35}),
    "reacher": ((0.0, 0.0, 0.0), 0.75, {"joint0": 0.5, "joint1": 0.9}),
    "hopper": ((0.1, 0.0, 0.8), 3.2, {"thigh_joint": -0.5, "leg_joint": -0.9}),
    "half_cheetah": ((0.0, 0.0, 0.6), 2.9, {"bthigh": 0.4, "fthigh": -0.5}),
    "walker": ((0.0, 0.0, 0.75), 3.2, {"thigh_joint": -0.6, "leg_left_joint": -0.7}),
}
"""Of each task where the camera looks and from how far [m], and the pose [rad]."""


def picture(
    name: str, at: tuple[float, ...], distance: float, pose: dict[str, float]
) -> np.ndarray:
    """Return the picture of a task's model."""
    model = make_env(load_config(name)).mj_model
    data = mujoco.MjData(model)
    for joint, angle in pose.items():
        data.joint(joint).qpos[0] = angle
    mujoco.mj_forward(model, data)
    camera = mujoco.MjvCamera()
    camera.lookat[:] = at
    camera.distance, camera.azimuth, camera.elevation = distance, 90.0, -8.0
    if name == "reacher":
        camera.elevation = -70.0
    with mujoco.Renderer(model, height=HEIGHT, width=WIDTH) as renderer:
        renderer.update_scene(data, camera)
        return renderer.render()


if __name__ == "__main__":
    pictures = [picture(name, *view) for name, view in VIEWS.items()]
    iio.imwrite(sys.argv[1], np.concatenate(pictures, axis=1))
