"""Render the robot of an adapter: as images, or in MuJoCo's window."""

import os
import sys
import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PyTree, UInt8

from jetbot_mjx.envs import QPOS_XYZ, JetBotEnv
from jetbot_mjx.viewers import Renderer, Window, overview, require_window

RENDER_MODES = ("human", "rgb_array")

_DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")
_REMEDY = "take render_mode='rgb_array', which needs none"
_MARGIN = np.array([0.15, 0.15, 0.0])  # [m] around the middle of a body, to show all of it


class Pose(NamedTuple):
    """The part of a robot's state that is rendered."""

    qpos: Float[np.ndarray, " nq"]
    goal: PyTree
    """The goal of the episode, as the task draws it."""
    time: float
    """Simulated time since the episode began [s]."""


def is_available(mode: str) -> bool:
    """Return whether this machine can render in a mode, without opening anything.

    Args:
      mode: `human` needs a display, which on Linux an environment variable names.
    """
    return mode != "human" or sys.platform != "linux" or any(map(os.environ.get, _DISPLAYS))


class FrameRenderer:
    """A renderer of one robot and its goal; it opens nothing before the first frame."""

    def __init__(self, env: JetBotEnv, mode: str, rendering_dt: float) -> None:
        """Check that there is a display, where one is needed.

        Args:
          env: The environment whose robot and task are rendered.
          mode: `human` or `rgb_array`.
          rendering_dt: Simulated time between two frames in the window [s].

        Raises:
          UserError: There is no display.
        """
        self._env, self._rendering_dt = env, rendering_dt
        self._renderer: Renderer | None = None
        self._window: Window | None = None
        self._next = (0.0, 0.0)
        """When the next frame is due, in simulated and in real time [s]."""
        if mode == "human":
            require_window(_REMEDY)

    def frame(self, pose: Pose) -> UInt8[np.ndarray, "height width 3"]:
        """Return an RGB image from the nearest camera that sees robot, goal and origin.

        Raises:
          UserError: This machine has no OpenGL that works without a screen.
        """
        if self._renderer is None:
            self._renderer = Renderer(self._env.mj_model)
        markers = self._markers(pose.goal)
        middles = np.stack([np.zeros(3), pose.qpos[QPOS_XYZ], *markers.values()])
        points = np.concatenate([middles - _MARGIN, middles + _MARGIN])
        camera = overview(points, float(self._env.mj_model.vis.global_.fovy))
        return self._renderer.frame(pose.qpos, markers, camera)

    def show(self, pose: Pose) -> None:
        """Show a pose in the window, and wait so that simulated time passes as real time.

        Raises:
          UserError: The window cannot be opened.
        """
        if self._window is None:
            self._window = Window(self._env.mj_model, remedy=_REMEDY)
        due, at = (0.0, time.monotonic()) if pose.time == 0.0 else self._next
        if pose.time < due - 1e-9 or not self._window.is_running():
            return
        time.sleep(max(0.0, at - time.monotonic()))
        self._window.show(pose.qpos, self._markers(pose.goal))
        self._next = pose.time + self._rendering_dt, time.monotonic() + self._rendering_dt

    def close(self) -> None:
        """Close the offscreen renderer and the window."""
        for opened in (self._renderer, self._window):
            if opened is not None:
                opened.__exit__(None, None, None)
        self._renderer = self._window = None

    def _markers(self, goal: PyTree) -> dict[str, np.ndarray]:
        markers = self._env.task.markers(jax.tree.map(jnp.asarray, goal))
        return jax.device_get(dict(markers))
