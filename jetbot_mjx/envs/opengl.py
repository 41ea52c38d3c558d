"""Find an OpenGL that works without a display.

MuJoCo chooses its OpenGL back end from `MUJOCO_GL` when it is imported, before anybody knows
whether it works. This module tries each back end in a subprocess, and uses the first that works.
"""

import functools
import importlib
import os
import subprocess
import sys
from typing import Any

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

_REMEDY_LINUX = (
    "install one of libegl1 with a GPU driver or libegl-mesa0, or"
    " libosmesa6 (Debian and Ubuntu: apt-get install libegl1 libegl-mesa0)"
)
_REMEDY_ELSEWHERE = "run it in a session with a display, where GLFW can open a window"


def context_class() -> Any:
    """Return the class of OpenGL contexts of the back end that works.

    Raises:
      UserError: as `find_backend`.
    """
    return importlib.import_module(f"mujoco.{find_backend()}").GLContext


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
