"""Pictures of the simulation without a screen.

MuJoCo chooses its OpenGL back end once, when it is imported, from `MUJOCO_GL`; by then it is
too late to find out that there is no display. Here a back end is tried in a process of its
own, and only one that has worked there is used here.
"""

import functools
import importlib
import os
import subprocess
import sys
from collections.abc import Mapping
from types import TracebackType
from typing import Any, Self
from unittest import mock

import mujoco
import numpy as np
from jaxtyping import Float, UInt8
from mujoco.rendering.classic import gl_context

from jetbot_mjx.errors import UserError

_BACKENDS = ("egl", "osmesa", "glfw")

_PROBE = """
import importlib, mujoco
context = importlib.import_module("mujoco.{backend}").GLContext(64, 64)
context.make_current()
mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), 150)
"""

_REMEDY = (
    "no OpenGL for pictures: install one of libegl1 with a GPU driver or libegl-mesa0, or"
    " libosmesa6 (Debian and Ubuntu: apt-get install libegl1 libegl-mesa0)"
)


class Renderer:
    """Draws a model in given poses; a context manager that frees its OpenGL context."""

    def __init__(self, mj_model: mujoco.MjModel, *, width: int = 480, height: int = 480) -> None:
        """Opens an OpenGL context.

        Args:
          mj_model: with all that shows.
          width: of a picture [pixels].
          height: of a picture [pixels].

        Raises:
          UserError: this machine has no OpenGL that works without a screen.
        """
        self._model = mj_model
        self._data = mujoco.MjData(mj_model)
        backend = importlib.import_module(f"mujoco.{find_backend()}")
        # The one way to hand MuJoCo's renderer a back end after import.
        with mock.patch.object(gl_context, "GLContext", backend.GLContext, create=True):
            self._renderer = mujoco.Renderer(mj_model, height=height, width=width)

    def frame(
        self,
        qpos: Float[np.ndarray, " nq"],
        markers: Mapping[str, Any],
        camera: str,
    ) -> UInt8[np.ndarray, "height width 3"]:
        """Draws one pose.

        Args:
          qpos: the robot's.
          markers: positions [m] of mocap bodies, by name, as `Task.markers` gives them.
          camera: `chase`, `top` or `onboard`.

        Returns:
          The picture, RGB.
        """
        self._data.qpos[:] = qpos
        for name, position in markers.items():
            mocap = self._model.body(name).mocapid[0]
            self._data.mocap_pos[mocap] = np.asarray(position)
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        self._renderer.update_scene(self._data, camera=camera)
        return self._renderer.render()

    def __enter__(self) -> Self:
        """Enters."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Frees the context."""
        self._renderer.close()


@functools.cache
def find_backend() -> str:
    """The first OpenGL back end that works here; `MUJOCO_GL`, where set, is the only choice.

    Returns:
      `egl`, `osmesa` or `glfw`.

    Raises:
      UserError: none works; the message names what to install.
    """
    wanted = os.environ.get("MUJOCO_GL", "").lower()
    candidates = (wanted,) if wanted in _BACKENDS else _BACKENDS
    for backend in candidates:
        # A display is what glfw needs; without one it fails slowly and loudly.
        if backend == "glfw" and sys.platform == "linux" and "DISPLAY" not in os.environ:
            continue
        environment = {**os.environ, "MUJOCO_GL": backend}
        probe = [sys.executable, "-c", _PROBE.format(backend=backend)]
        if subprocess.run(probe, env=environment, capture_output=True).returncode == 0:
            return backend
    if wanted in _BACKENDS:
        raise UserError(f"MUJOCO_GL = {wanted!r} does not work here: unset it, or {_REMEDY}")
    raise UserError(_REMEDY)
