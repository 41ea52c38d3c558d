"""Pictures of the simulation without a screen.

MuJoCo chooses its OpenGL back end once, when it is imported, from `MUJOCO_GL`; by then it is
too late to find out that there is no display. Here a back end is tried in a process of its
own, and only one that has worked there is used here.
"""

import copy
import functools
import importlib
import itertools
import math
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
from PIL import Image

from jetbot_mjx.errors import UserError

_BACKENDS = ("egl", "osmesa", "glfw")

_UNDECIDED = (
    "",
    "0",
    "1",
    "cgl",
    "disable",
    "disabled",
    "enable",
    "enabled",
    "false",
    "glx",
    "off",
)
_UNDECIDED += ("on", "true", "wgl")
"""What `MUJOCO_GL` may say besides, to MuJoCo; here it leaves the choice open."""

_OVERSAMPLING = 2
"""Pixels drawn for one of the picture, along each axis. As smooth as OpenGL's own four samples a
pixel, and where a CPU draws it takes two thirds of the time, of small pictures one third."""

_TRAIL_RGBA = (0.10, 0.35, 0.85, 1.0)
_TRAIL_WIDTH = 0.01  # of the picture's width

_NEAR = 0.005  # [m] what is nearer is not drawn: the onboard camera comes close to the goal
_ELEVATION = -50.0  # [degrees] of the overview's line of sight
_NEAREST = 1.2  # [m] from the overview's camera to the nearest point

_PROBE = """
import importlib, mujoco
context = importlib.import_module("mujoco.{backend}").GLContext(64, 64)
context.make_current()
mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), 150)
"""

_REMEDY = (
    "install one of libegl1 with a GPU driver or libegl-mesa0, or"
    " libosmesa6 (Debian and Ubuntu: apt-get install libegl1 libegl-mesa0)"
)


class Renderer:
    """Draws a model in given poses; a context manager that frees its OpenGL context."""

    def __init__(self, mj_model: mujoco.MjModel, *, width: int = 480, height: int = 480) -> None:
        """Open an OpenGL context.

        Args:
          mj_model: with all that shows.
          width: of a picture [pixels].
          height: of a picture [pixels].

        Raises:
          UserError: this machine has no OpenGL that works without a screen.
        """
        self._model = copy.copy(mj_model)
        self._data = mujoco.MjData(self._model)
        drawn_width, drawn_height = _OVERSAMPLING * width, _OVERSAMPLING * height
        self._model.vis.map.znear = _NEAR / self._model.stat.extent
        self._model.vis.quality.offsamples = 0
        self._model.vis.global_.offwidth = drawn_width
        self._model.vis.global_.offheight = drawn_height
        backend = importlib.import_module(f"mujoco.{find_backend()}")
        # The one way to hand MuJoCo's renderer a back end after import.
        with mock.patch.object(gl_context, "GLContext", backend.GLContext, create=True):
            self._renderer = mujoco.Renderer(self._model, height=drawn_height, width=drawn_width)

    def frame(
        self,
        qpos: Float[np.ndarray, " nq"],
        markers: Mapping[str, Any],
        camera: str | mujoco.MjvCamera,
        *,
        shadows: bool = True,
        trail_w: Float[np.ndarray, "n 3"] | None = None,
    ) -> UInt8[np.ndarray, "height width 3"]:
        """Draw one pose.

        Args:
          qpos: the robot's.
          markers: positions [m] of mocap bodies, by name, as `Task.markers` gives them.
          camera: `chase`, `top` or `onboard`, or one of your own.
          shadows: whether things cast them; without, drawing takes less than half the time.
          trail_w: points [m] to join by a line, such as the way so far.

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
        self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows
        if trail_w is not None:
            self._add_trail(np.asarray(trail_w, float))
        return np.asarray(Image.fromarray(self._renderer.render()).reduce(_OVERSAMPLING))

    def _add_trail(self, points_w: Float[np.ndarray, "n 3"]) -> None:
        scene, kind = self._renderer.scene, mujoco.mjtGeom.mjGEOM_LINE
        colour = np.array(_TRAIL_RGBA, np.float32)
        width = _TRAIL_WIDTH * self._renderer.width
        for start, end in itertools.pairwise(points_w):
            if scene.ngeom == scene.maxgeom:
                return
            geom = scene.geoms[scene.ngeom]
            mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.zeros(9), colour)
            mujoco.mjv_connector(geom, kind, width, start, end)
            scene.ngeom += 1

    def __enter__(self) -> Self:
        """Enter."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Free the context."""
        self._renderer.close()


def overview(
    points_w: Float[np.ndarray, "n 3"],
    fovy: float,
    *,
    sides: float = 0.9,
    above: float = 0.9,
    below: float = 0.9,
) -> mujoco.MjvCamera:
    """Return the nearest camera that looks down along x and has all points in its frame.

    A point at (x right, y up, z ahead) is below the upper border, of slope k, of a camera at height
    s and d behind the origin where y - s ≤ k (z + d), and above the lower one, of slope k', where
    s - y ≤ k' (z + d). One s does for all where (k + k') d ≥ max(y - k z) - min(y + k' z). The same
    holds for left and right.

    Args:
      points_w: what is to be seen [m].
      fovy: the camera's field of view, of height and of width [degrees].
      sides: how much of the picture they may fill, from its middle to the left and right.
      above: likewise upwards.
      below: likewise downwards.

    Returns:
      A free camera.
    """
    angle = math.radians(_ELEVATION)
    ahead = np.array([math.cos(angle), 0.0, math.sin(angle)])
    right, up = np.array([0.0, -1.0, 0.0]), np.array([-ahead[2], 0.0, ahead[0]])
    x, y, z = (points_w @ axis for axis in (right, up, ahead))
    slope = math.tan(math.radians(fovy) / 2)
    k, upper, lower = sides * slope, above * slope, below * slope
    distance = max(
        _NEAREST - z.min(),
        (np.max(x - k * z) - np.min(x + k * z)) / (2 * k),
        (np.max(y - upper * z) - np.min(y + lower * z)) / (upper + lower),
    )
    # Halfway between the least and the greatest that do.
    aside = (np.max(x - k * z) + np.min(x + k * z)) / 2
    height = np.max(y - upper * (z + distance)) + np.min(y + lower * (z + distance))
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    camera.azimuth, camera.elevation, camera.distance = 0.0, _ELEVATION, distance
    camera.lookat[:] = aside * right + height / 2 * up
    return camera


@functools.cache
def find_backend() -> str:
    """Return the first OpenGL back end that works; only `MUJOCO_GL`'s where it names one.

    Returns:
      `egl`, `osmesa` or `glfw`.

    Raises:
      UserError: none works, and the message names what to install; or there is none of that name.
    """
    wanted = os.environ.get("MUJOCO_GL", "").lower().strip()
    if wanted not in (*_BACKENDS, *_UNDECIDED):
        raise UserError(
            f"MUJOCO_GL = {wanted!r}: no such back end; unset it, or give egl or osmesa"
        )
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
    raise UserError(f"no OpenGL for pictures: {_REMEDY}")
