"""Place recorded episodes of many robots on a grid, so that one scene can show them all.

Each episode was recorded with a robot alone at the origin. A `RobotGrid` moves it to its own cell.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from jetbot_mjx.envs import QPOS_XYZ, JetBotEnv
from jetbot_mjx.evaluation import Episodes

WIDEST_CELL = 2.5
"""Largest distance between neighbouring cells [m]."""

_WAVE_SECONDS = 5.0  # from the start of the first robot to that of the farthest
_FRONT = 0.5  # [m] first radius around the first robot within which others start
_SPACING = (1.5, WIDEST_CELL)  # [m] smallest and largest distance between neighbouring cells
_ASPECT = 1.4  # columns per row of the grid: the view from above then fills the video
_FIRST_GOAL = (0.6, 0.1)  # [m] where the goal of the robot in the first frame should be


class RobotGrid(NamedTuple):
    """A `RobotGrid` holds recorded episodes of n robots, each in its own cell, on the host."""

    qpos: Float[np.ndarray, "n time nq"]
    """Generalised positions in the common scene."""
    steps: Int[np.ndarray, " n"]
    """Environment steps of each episode."""
    markers: Mapping[str, Float[np.ndarray, "n 3"]]
    """Positions of the mocap bodies [m], world frame, by name."""
    reached: np.ndarray
    """Whether each episode ended with success."""
    start_seconds: Float[np.ndarray, " n"]
    """Time of the video at which each episode starts [s]."""
    corners_w: Float[np.ndarray, "4 3"]
    """Corners of the grid [m]."""
    dt: float
    """Duration of one environment step [s]."""

    @property
    def seconds(self) -> float:
        """Time of the video at which the last episode ends [s]."""
        return float((self.start_seconds + self.steps * self.dt).max())

    def steps_at(self, seconds: float) -> Int[np.ndarray, " n"]:
        """Return the index of each robot's state at a time of the video [s]."""
        step = np.round((seconds - self.start_seconds) / self.dt).astype(int)
        return np.clip(step, 0, self.steps)

    def reached_at(self, steps: Int[np.ndarray, " n"]) -> np.ndarray:
        """Return which robots have reached their goals at the states `steps`."""
        return self.reached & (steps == self.steps)

    @property
    def first(self) -> int:
        """Index of the robot that starts first, in the middle of the grid."""
        return int(self.start_seconds.argmin())


def place_on_grid(
    env: JetBotEnv,
    episodes: Episodes,
    *,
    aspect: float = _ASPECT,
    spacing: tuple[float, float] = _SPACING,
) -> RobotGrid:
    """Move each recorded episode to its own cell of a grid.

    The middle between the outermost points of a robot's path and its markers lies in the middle of
    its cell. A cell is as wide as the widest episode, within the limits `spacing`.

    Args:
      env: The environment of the episodes.
      episodes: The episodes of n robots, recorded with `qpos`.
      aspect: The columns, along y, per row of the grid, along x.
      spacing: The smallest and the largest distance between cells [m].

    Returns:
      The episodes in their cells.
    """
    host, markers = jax.device_get((episodes, jax.vmap(env.task.markers)(episodes.goal)))
    qpos, places = np.array(host.qpos, float), {k: np.array(v) for k, v in markers.items()}
    path = qpos[:, :, QPOS_XYZ][:, :, :2]
    # Find the extent of each episode; the states after its end equal its last one.
    points = np.concatenate([path, *(place[:, None, :2] for place in places.values())], axis=1)
    low, high = points.min(axis=1), points.max(axis=1)
    width = float(np.clip((high - low).max() + 0.2, *spacing))
    # Fill the cells row by row, around the origin.
    count = len(qpos)
    columns = min(count, math.ceil(math.sqrt(count * aspect)))
    rows = math.ceil(count / columns)
    row, column = np.divmod(np.arange(count), columns)
    cell = width * np.stack([(rows - 1) / 2 - row, (columns - 1) / 2 - column], axis=-1)
    shift = cell - (low + high) / 2
    path += shift[:, None]
    qpos[:, :, QPOS_XYZ][:, :, :2] = path
    for place in places.values():
        place[:, :2] += shift
    # Start in the near half of the grid, at a robot whose goal lies ahead, then go outwards.
    goal = np.asarray(host.goal_w)[:, :2] - np.asarray(host.start_w)
    off_middle = np.linalg.norm(cell / width - [-0.15 * rows, 0.0], axis=-1)
    first = (np.linalg.norm(goal - _FIRST_GOAL, axis=-1) + 0.05 * off_middle).argmin()
    away = np.linalg.norm(cell - cell[first], axis=-1)
    # The front of starting robots grows like the camera's view.
    share = np.log(np.maximum(away, _FRONT) / _FRONT) / math.log(max(away.max(), width) / _FRONT)
    half = np.array([[x, y, 0.0] for x in (-0.5, 0.5) for y in (-0.5, 0.5)])
    return RobotGrid(
        qpos=qpos,
        steps=np.asarray(host.steps, int),
        markers=places,
        reached=np.asarray(host.success) > 0,
        start_seconds=_WAVE_SECONDS * _smoothstep_inverse(share),
        corners_w=half * [rows * width, columns * width, 0.0],
        dt=env.dt,
    )


def _smoothstep_inverse(y: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return x in [0, 1] with 3 x² - 2 x³ = y."""
    return np.clip(0.5 - np.sin(np.arcsin(1 - 2 * y) / 3), 0.0, 1.0)
