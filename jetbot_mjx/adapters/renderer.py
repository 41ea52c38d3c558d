"""Render an adapted environment: as images, or in MuJoCo's window."""

import atexit
import os
import sys
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PyTree, UInt8

from jetbot_mjx.envs.jetbot_env import JetBotEnv
from jetbot_mjx.envs.robot_model import QPOS_XYZ
from jetbot_mjx.viewers import mujoco_window
from jetbot_mjx.viewers.offscreen import Renderer, overview

RENDER_MODES = ("human", "rgb_array")

_DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")
_REMEDY = "take render_mode='rgb_array', which needs none"
_AROUND = np.array([0.15, 0.15, 0.0])  # [m] of a thing's middle, which belongs to it


def shown_here(mode: str) -> bool:
    """Return whether this machine is one to show a render mode, without opening anything.

    Args:
      mode: `human` needs a display, which on Linux an environment variable names.
    """
    return mode != "human" or sys.platform != "linux" or any(map(os.environ.get, _DISPLAYS))


class FrameRenderer:
    """Shows one robot and its goal; opens nothing before the first picture."""

    def __init__(self, env: JetBotEnv, mode: str, rendering_dt: float) -> None:
        """Look whether there is a display, where one is needed.

        Args:
          env: whose robot and task are shown.
          mode: `human` or `rgb_array`.
          rendering_dt: [s] of simulated time between two pictures in the window.

        Raises:
          UserError: there is no display.
        """
        self._env, self._mode, self._rendering_dt = env, mode, rendering_dt
        self._renderer: Renderer | None = None
        self._window: mujoco_window.Window | None = None
        self._next = (0.0, 0.0)
        """When the next picture is due, in simulated and in real time [s]."""
        if mode == "human":
            mujoco_window.require_window(_REMEDY)

    def frame(
        self, qpos: Float[np.ndarray, " nq"], goal: PyTree
    ) -> UInt8[np.ndarray, "height width 3"]:
        """Return a picture from the nearest camera that has robot, goal and origin in its frame.

        Args:
          qpos: the robot's pose.
          goal: of the episode.

        Returns:
          The picture, RGB.

        Raises:
          UserError: this machine has no OpenGL that works without a screen.
        """
        if self._renderer is None:
            self._renderer = Renderer(self._env.mj_model)
            # For who forgets to: after Python's end OpenGL is gone before the renderer is.
            atexit.register(self.close)
        markers = self._markers(goal)
        middles = np.stack([np.zeros(3), qpos[QPOS_XYZ], *markers.values()])
        points = np.concatenate([middles - _AROUND, middles + _AROUND])
        camera = overview(points, float(self._env.mj_model.vis.global_.fovy))
        return self._renderer.frame(qpos, markers, camera)

    def show(self, qpos: Float[np.ndarray, " nq"], goal: PyTree, now: float) -> None:
        """Put a pose into the window, as fast as the robot would move.

        Args:
          qpos: the robot's pose.
          goal: of the episode.
          now: simulated time since the episode began [s].

        Raises:
          UserError: the window cannot be opened.
        """
        if self._window is None:
            self._window = mujoco_window.Window(self._env.mj_model, remedy=_REMEDY)
        due, at = self._next
        if now == 0.0:
            due, at = 0.0, time.monotonic()
        if now < due - 1e-9 or not self._window.is_running():
            return
        time.sleep(max(0.0, at - time.monotonic()))
        self._window.show(qpos, self._markers(goal))
        self._next = now + self._rendering_dt, time.monotonic() + self._rendering_dt

    def close(self) -> None:
        """Close what was opened."""
        atexit.unregister(self.close)
        for shown in (self._renderer, self._window):
            if shown is not None:
                shown.__exit__(None, None, None)
        self._renderer = self._window = None

    def _markers(self, goal: PyTree) -> dict[str, Any]:
        markers = self._env.task.markers(jax.tree.map(jnp.asarray, goal))
        return jax.device_get(dict(markers))
