"""Find an OpenGL that works without a display, and render with it.

MuJoCo chooses its OpenGL back end from `MUJOCO_GL` when it is imported, before anybody knows
whether it works. This module tries each back end in a subprocess, and uses the first that works.
"""

import atexit
import functools
import importlib
import os
import subprocess
import sys
import types
import weakref
from collections.abc import Iterable

import mujoco
import numpy as np
from jaxtyping import UInt8

from jetbot_mjx.errors import UserError

_BACKENDS = ("egl", "osmesa", "glfw")

_UNDECIDED = ("", "0", "1", "disable", "disabled", "enable", "enabled", "false", "off", "on")
_UNDECIDED += ("true", "cgl", "glx", "wgl")
"""Other values of `MUJOCO_GL` that MuJoCo accepts; with these, this module chooses."""

_PROBE = """
import importlib, mujoco
context = importlib.import_module("mujoco.{backend}").GLContext(64, 64)
context.make_current()
mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), 150)
"""

_PLATFORM = "PYOPENGL_PLATFORM"

_WITHOUT_GPU = ("llvmpipe", "softpipe", "swrast", "swr")
"""Names of the programs that draw in place of a GPU, as OpenGL tells them."""

_REMEDY_LINUX = (
    "install one of libegl1 with a GPU driver or libegl-mesa0, or"
    " libosmesa6 (Debian and Ubuntu: apt-get install libegl1 libegl-mesa0)"
)
_REMEDY_ELSEWHERE = "run it in a session with a display, where GLFW can open a window"


class SceneRenderer:
    """A `SceneRenderer` renders the scenes of a model into images.

    It is `mujoco.Renderer` with the OpenGL back end that works on this machine, which that one
    cannot be given: it uses the one that `MUJOCO_GL` named when MuJoCo was imported. An OpenGL
    context belongs to the thread in which it was made.
    """

    def __init__(self, mj_model: mujoco.MjModel, max_geoms: int) -> None:
        """Open an OpenGL context.

        Args:
          mj_model: the model, whose `vis.global_` holds the image's size.
          max_geoms: the largest number of geoms in a scene.

        Raises:
          UserError: as `find_backend`.
        """
        self._model = mj_model
        self.width = int(mj_model.vis.global_.offwidth)
        """Width of an image [pixels]."""
        self.height = int(mj_model.vis.global_.offheight)
        """Height of an image [pixels]."""
        self.scene = mujoco.MjvScene(mj_model, max_geoms)
        """What `render` renders."""
        self._rect = mujoco.MjrRect(0, 0, self.width, self.height)
        self._gl = _import_back_end().GLContext(self.width, self.height)
        _open.add(self)
        _end_at_exit()
        self._gl.make_current()
        self._context = mujoco.MjrContext(mj_model, mujoco.mjtFontScale.mjFONTSCALE_50)
        self.without_gpu = _device().startswith(_WITHOUT_GPU)
        """Whether the processor draws, which takes a quarter of a second for a frame of a video."""
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)

    def update_scene(
        self,
        data: mujoco.MjData,
        camera: str | int | mujoco.MjvCamera,
        option: mujoco.MjvOption | None = None,
    ) -> None:
        """Put all geoms into the scene, as one camera sees them.

        Args:
          data: the poses.
          camera: the name or the index of a camera of the model, or a camera object.
          option: which geoms to put into it; None: MuJoCo's own choice.
        """
        if not isinstance(camera, mujoco.MjvCamera):
            fixed = mujoco.MjvCamera()
            fixed.type = mujoco.mjtCamera.mjCAMERA_FIXED
            fixed.fixedcamid = self._model.camera(camera).id
            camera = fixed
        option = option or mujoco.MjvOption()
        geoms = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(self._model, data, option, None, camera, geoms, self.scene)

    def upload(self, textures: Iterable[int]) -> None:
        """Show textures of the model that have changed.

        Args:
          textures: their indices.
        """
        self._gl.make_current()
        for texture in textures:
            mujoco.mjr_uploadTexture(self._model, self._context, texture)

    def render(self) -> UInt8[np.ndarray, "height width 3"]:
        """Return an image of the scene, RGB."""
        # A thread may have made several contexts.
        self._gl.make_current()
        image = np.empty((self.height, self.width, 3), np.uint8)
        mujoco.mjr_render(self._rect, self.scene, self._context)
        mujoco.mjr_readPixels(image, None, self._rect, self._context)
        # OpenGL's first row is the lowest.
        return image[::-1]

    def close(self) -> None:
        """Free what OpenGL holds; another context may be current, and would lose its textures."""
        self._gl.make_current()
        self._context.free()
        self.end()

    def end(self) -> None:
        """End the context, from any thread, before Python's exit removes what this calls."""
        _open.discard(self)
        self._gl.free()
        del self._gl


def _import_back_end() -> types.ModuleType:
    """Import MuJoCo's module of the back end, and leave the environment of the process as it is."""
    was_set = _PLATFORM in os.environ
    module = importlib.import_module(f"mujoco.{find_backend()}")
    if not was_set:
        # The module sets it for PyOpenGL, which has read it by now.
        os.environ.pop(_PLATFORM, None)
    return module


_open: "weakref.WeakSet[SceneRenderer]" = weakref.WeakSet()
"""Renderers whose contexts have not ended."""


@functools.cache
def _end_at_exit() -> None:
    """End all contexts before EGL ends, whose own handler the first context has registered."""
    atexit.register(lambda: [renderer.end() for renderer in list(_open)])


def some_without_gpu() -> bool:
    """Return whether the processor draws the images of a renderer that is open."""
    return any(renderer.without_gpu for renderer in _open)


def _device() -> str:
    """Return what draws in the current context."""
    # Only now, because the module of the back end tells PyOpenGL which library to load.
    from OpenGL import GL

    return (GL.glGetString(GL.GL_RENDERER) or b"").decode().lower()


@functools.cache
def find_backend() -> str:
    """Return the first OpenGL back end that works: `egl`, `osmesa` or `glfw`.

    If `MUJOCO_GL` names one of them, only that one is tried.

    Raises:
      UserError: `MUJOCO_GL` has an unknown value, or no back end works; the message names what to
        install.
    """
    wanted = os.environ.get("MUJOCO_GL", "").lower().strip()
    if wanted not in (*_BACKENDS, *_UNDECIDED):
        raise UserError(
            f"MUJOCO_GL = {wanted!r}: there is no such back end: unset it, or set egl or osmesa"
        )
    candidates = (wanted,) if wanted in _BACKENDS else _BACKENDS
    for backend in candidates:
        # Without a display, glfw fails slowly and with much output.
        if backend == "glfw" and sys.platform == "linux" and "DISPLAY" not in os.environ:
            continue
        environment = {**os.environ, "MUJOCO_GL": backend}
        probe = [sys.executable, "-c", _PROBE.format(backend=backend)]
        if subprocess.run(probe, env=environment, capture_output=True).returncode == 0:
            return backend
    remedy = _REMEDY_LINUX if sys.platform == "linux" else _REMEDY_ELSEWHERE
    if wanted in _BACKENDS:
        raise UserError(f"MUJOCO_GL = {wanted!r} does not work here: unset it, or {remedy}")
    raise UserError(f"no OpenGL to render with: {remedy}")
