"""A player in MuJoCo's own window, where there is a display."""

import queue
import sys
import time
import types
import warnings

import mujoco
import numpy as np

from jetbot_mjx.errors import UserError
from jetbot_mjx.player import Player

_REMEDY = "use --viewer browser, which needs none"
_ARROWS = {265: (1, 0), 264: (-1, 0), 263: (0, 1), 262: (0, -1)}  # GLFW's numbers of the keys


def require_window() -> types.ModuleType:
    """Looks whether a window could be opened, before anything that takes time.

    Returns:
      MuJoCo's viewer.

    Raises:
      UserError: on Linux there is no display; opening a window there would wait for ever.
    """
    try:
        import glfw
        import mujoco.viewer
    except (ImportError, RuntimeError) as error:
        raise UserError(f"no window can be opened here ({error}): {_REMEDY}") from None
    with warnings.catch_warnings():
        # GLFW says it as a warning beside its answer.
        warnings.simplefilter("ignore")
        if sys.platform == "linux" and not glfw.init():
            raise UserError(f"no window can be opened here, there is no display: {_REMEDY}")
    return mujoco.viewer


def run(player: Player) -> None:
    """Drives and shows, until the window is closed; the arrow keys ask for speed and turn.

    Args:
      player: what drives.

    Raises:
      UserError: there is no display, or it takes another Python to open a window (macOS).
    """
    model, data = player.env.mj_model, mujoco.MjData(player.env.mj_model)
    # The window has a thread of its own, and the player wants to be called from one.
    pressed: queue.SimpleQueue[int] = queue.SimpleQueue()
    try:
        window = require_window().launch_passive(
            model, data, key_callback=pressed.put, show_left_ui=False, show_right_ui=False
        )
    except RuntimeError as error:
        raise UserError(f"no window can be opened here ({error}): {_REMEDY}") from None
    with window:
        while window.is_running():
            while not pressed.empty():
                player.nudge(*_ARROWS.get(pressed.get(), (0, 0)))
            player.advance()
            with window.lock():
                _pose(player, model, data)
            window.set_texts((None, None, *_texts(player)))
            window.sync()
            player.frames.count(time.monotonic())
            time.sleep(player.wait())


def _pose(player: Player, model: mujoco.MjModel, data: mujoco.MjData) -> None:
    data.qpos[:] = player.shown.qpos
    for name, position in player.shown.markers.items():
        data.mocap_pos[model.body(name).mocapid[0]] = np.asarray(position)
    mujoco.mj_forward(model, data)


def _texts(player: Player) -> tuple[str, str]:
    figures = {
        "goals": f"{player.successes} of {player.episodes} reached",
        "episode": f"{player.time:.1f} of {player.time_limit:.1f} s",
        "distance": f"{player.distance:.2f} m",
        "agent": player.agent,
    }
    return "\n".join(figures), "\n".join(figures.values())
