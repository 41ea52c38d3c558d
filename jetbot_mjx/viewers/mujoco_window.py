"""Show a player in MuJoCo's own window, on machines with a display."""

import contextlib
import queue
import sys
import time
import types
import warnings
from collections.abc import Callable, Mapping

import mujoco
import numpy as np
from jaxtyping import Float

from jetbot_mjx.errors import UserError
from jetbot_mjx.viewers.player import Player
from jetbot_mjx.viewers.pose import set_pose

_REMEDY = "use --viewer browser, which needs none"
_ARROWS = {265: (1, 0), 264: (-1, 0), 263: (0, 1), 262: (0, -1)}  # by the key codes of GLFW


def require_window(remedy: str = _REMEDY) -> types.ModuleType:
    """Check that a window can be opened; call this before slow work.

    Args:
      remedy: the advice in the error message.

    Returns:
      The module `mujoco.viewer`.

    Raises:
      UserError: GLFW is missing, or there is no display (on Linux, opening a window would hang).
    """
    try:
        import glfw
        import mujoco.viewer
    except (ImportError, RuntimeError) as error:
        raise UserError(f"no window can be opened here ({error}): {remedy}") from None
    with warnings.catch_warnings():
        # GLFW returns False and warns as well.
        warnings.simplefilter("ignore")
        if sys.platform == "linux" and not glfw.init():
            raise UserError(f"no window can be opened here, there is no display: {remedy}")
    return mujoco.viewer


class Window(contextlib.AbstractContextManager["Window"]):
    """A window that shows a model; a context manager that closes it."""

    def __init__(
        self,
        mj_model: mujoco.MjModel,
        *,
        key_callback: Callable[[int], None] | None = None,
        remedy: str = _REMEDY,
    ) -> None:
        """Open the window.

        Args:
          mj_model: the model with all visual elements.
          key_callback: a function that the window's thread calls with the GLFW key code of every
            key press.
          remedy: the advice in the error message.

        Raises:
          UserError: there is no display, or Python is not `mjpython` (macOS).
        """
        self._model, self._data = mj_model, mujoco.MjData(mj_model)
        try:
            self._viewer = require_window(remedy).launch_passive(
                self._model,
                self._data,
                key_callback=key_callback,
                show_left_ui=False,
                show_right_ui=False,
            )
        except RuntimeError as error:
            raise UserError(f"no window can be opened here ({error}): {remedy}") from None

    def is_running(self) -> bool:
        """Return whether the window is open."""
        return self._viewer.is_running()

    def show(
        self,
        qpos: Float[np.ndarray, " nq"],
        markers: Mapping[str, object],
        texts: tuple[str, str] | None = None,
    ) -> None:
        """Show one pose.

        Args:
          qpos: generalised position of the robot.
          markers: positions [m] of the mocap bodies, by name, as `Task.markers` returns them.
          texts: labels and values, line by line, for the corner of the window.
        """
        with self._viewer.lock():
            set_pose(self._model, self._data, qpos, markers)
            mujoco.mj_forward(self._model, self._data)
        if texts is not None:
            self._viewer.set_texts((None, None, *texts))
        self._viewer.sync()

    def __exit__(self, *exception: object) -> None:
        """Close the window."""
        self._viewer.close()


def run(player: Player) -> None:
    """Drive and show a player until the window is closed; the arrow keys change the command.

    Args:
      player: the player.

    Raises:
      UserError: there is no display, or Python is not `mjpython` (macOS).
    """
    # The window calls back from its own thread, but a player is not thread-safe.
    pressed: queue.SimpleQueue[int] = queue.SimpleQueue()
    with Window(player.env.mj_model, key_callback=pressed.put) as window:
        while window.is_running():
            while not pressed.empty():
                player.nudge(*_ARROWS.get(pressed.get(), (0, 0)))
            player.advance()
            texts = {**player.describe(), "Agent": player.agent}
            columns = "\n".join(texts), "\n".join(texts.values())
            window.show(np.asarray(player.snapshot.qpos), player.snapshot.markers, columns)
            player.frames.count(time.monotonic())
            time.sleep(player.wait())
