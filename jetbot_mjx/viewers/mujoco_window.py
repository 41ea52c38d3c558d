"""MuJoCo's own window, where there is a display, and a player in it."""

import queue
import sys
import time
import types
import warnings
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Any, Self

import mujoco
import numpy as np
from jaxtyping import Float

from jetbot_mjx.errors import UserError
from jetbot_mjx.viewers.player import Player

_REMEDY = "use --viewer browser, which needs none"
_ARROWS = {265: (1, 0), 264: (-1, 0), 263: (0, 1), 262: (0, -1)}  # GLFW's numbers of the keys


def require_window(remedy: str = _REMEDY) -> types.ModuleType:
    """Look whether a window could be opened, before anything that takes time.

    Args:
      remedy: what to do where none can.

    Returns:
      MuJoCo's viewer.

    Raises:
      UserError: on Linux there is no display; opening a window there would wait for ever.
    """
    try:
        import glfw
        import mujoco.viewer
    except (ImportError, RuntimeError) as error:
        raise UserError(f"no window can be opened here ({error}): {remedy}") from None
    with warnings.catch_warnings():
        # GLFW says it as a warning beside its answer.
        warnings.simplefilter("ignore")
        if sys.platform == "linux" and not glfw.init():
            raise UserError(f"no window can be opened here, there is no display: {remedy}")
    return mujoco.viewer


class Window:
    """A window on a model; a context manager that closes it."""

    def __init__(
        self,
        mj_model: mujoco.MjModel,
        *,
        key_callback: Callable[[int], None] | None = None,
        remedy: str = _REMEDY,
    ) -> None:
        """Open the window.

        Args:
          mj_model: with all that shows.
          key_callback: called with GLFW's number of every key that is pressed, in the window's
            own thread.
          remedy: what to do where no window can be opened.

        Raises:
          UserError: there is no display, or it takes another Python to open a window (macOS).
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
        markers: Mapping[str, Any],
        texts: tuple[str, str] | None = None,
    ) -> None:
        """Show one pose.

        Args:
          qpos: the robot's.
          markers: positions [m] of mocap bodies, by name, as `Task.markers` gives them.
          texts: names and figures, line by line, for the window's corner.
        """
        with self._viewer.lock():
            self._data.qpos[:] = qpos
            for name, position in markers.items():
                mocap = self._model.body(name).mocapid[0]
                self._data.mocap_pos[mocap] = np.asarray(position)
            mujoco.mj_forward(self._model, self._data)
        if texts is not None:
            self._viewer.set_texts((None, None, *texts))
        self._viewer.sync()

    def close(self) -> None:
        """Close it."""
        self._viewer.close()

    def __enter__(self) -> Self:
        """Enter."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close the window."""
        self.close()


def run(player: Player) -> None:
    """Drive and shows, until the window is closed; the arrow keys ask for speed and turn.

    Args:
      player: what drives.

    Raises:
      UserError: there is no display, or it takes another Python to open a window (macOS).
    """
    # The window has a thread of its own, and the player wants to be called from one.
    pressed: queue.SimpleQueue[int] = queue.SimpleQueue()
    with Window(player.env.mj_model, key_callback=pressed.put) as window:
        while window.is_running():
            while not pressed.empty():
                player.nudge(*_ARROWS.get(pressed.get(), (0, 0)))
            player.advance()
            window.show(np.asarray(player.shown.qpos), player.shown.markers, _texts(player))
            player.frames.count(time.monotonic())
            time.sleep(player.wait())


def _texts(player: Player) -> tuple[str, str]:
    figures = {
        "goals": f"{player.successes} of {player.episodes} reached",
        "episode": f"{player.time:.1f} of {player.time_limit:.1f} s",
        "distance": f"{player.distance:.2f} m",
        "agent": player.agent,
    }
    return "\n".join(figures), "\n".join(figures.values())
