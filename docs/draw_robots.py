"""Draw the example robots side by side: `python docs/draw_robots.py docs/robots.png`."""

import sys

import imageio.v3 as iio
import mujoco
import numpy as np

from jetbot_mjx import load_config, make_env
from jetbot_mjx.viewers import Renderer

SIZE = {"width": 480, "height": 400}  # [pixels] of one robot
DISTANCES = {"turtlebot": 0.55, "rover": 0.75, "car": 0.6}  # [m] from the camera


def picture(name: str, distance: float) -> np.ndarray:
    """Return the picture of an example robot; the wheels of a car are turned."""
    model = make_env(load_config(name)).mj_model
    camera = mujoco.MjvCamera()
    camera.lookat[:] = 0.03, 0.0, 0.04
    camera.distance, camera.azimuth, camera.elevation = distance, -140.0, -22.0
    qpos = model.qpos0.copy()
    for joint in (model.joint(i) for i in range(model.njnt)):
        if "kingpin" in joint.name:
            qpos[joint.qposadr[0]] = 0.45
    with Renderer(model, **SIZE) as renderer:
        return renderer.frame(qpos, {"goal": (0.6, -0.35, 0.05)}, camera)


if __name__ == "__main__":
    iio.imwrite(sys.argv[1], np.concatenate([picture(*one) for one in DISTANCES.items()], axis=1))
