"""Estimate the cost of a search: `python benchmarks/learning/search_floor.py`.

A camera does not see a goal behind it, and nothing tells on which side the goal lies. A policy must
turn one way first. For half of the goals out of view that is the wrong way: the robot turns by
2π - 2 |bearing| more than one that knows the goal, at most as fast as `task.max_yaw_rate` commands.
The estimate is what these turns add to the mean of the best-known times, if nothing else is lost.

It is not a bound: this robot turns a little faster than commanded while it drives.
"""

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.learning.best_known import read
from jetbot_mjx import cli
from jetbot_mjx.config import CameraConfig, load_config
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation.best_known import FILE, settings_of


class Floor(NamedTuple):
    """A `Floor` holds what a search costs."""

    out_of_view: float
    """Share of the goals that the camera does not see at the start."""
    turn: float
    """[s] mean duration of the additional turn, where it is needed."""
    above_best_known: float
    """What the turns add to the mean of the best-known times, as a share of it."""


def half_view(camera: CameraConfig) -> float:
    """Return the angle up to which the camera sees to the left and to the right [rad].

    Raises:
      UserError: the camera has a lens.
    """
    if camera.lens != "pinhole" or camera.matrix is not None:
        raise UserError(f"camera.lens = {camera.lens}: the estimate is for a pinhole with a fovy")
    return math.atan(math.tan(math.radians(camera.fovy) / 2) * camera.width / camera.height)


def search_floor(
    goals: Float[np.ndarray, "n 2"], seconds: Float[np.ndarray, " n"], view: float, yaw_rate: float
) -> Floor:
    """Compute what a search costs, for a robot at the origin that looks along x.

    Args:
      goals: positions on the floor [m].
      seconds: the best-known time to each.
      view: the angle up to which the camera sees to each side [rad].
      yaw_rate: how fast the robot turns [rad/s].
    """
    bearing = np.abs(np.arctan2(goals[:, 1], goals[:, 0]))
    hidden = bearing > view
    if not hidden.any():
        return Floor(0.0, 0.0, 0.0)
    turns = 2.0 * (math.pi - bearing[hidden]) / yaw_rate
    # Half of the goals out of view lie on the side to which the policy turns.
    added = 0.5 * turns.sum() / seconds.sum()
    return Floor(float(hidden.mean()), float(turns.mean()), float(added))


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the estimate for a configuration with a camera."""
    parser = cli.Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", default="best_camera", metavar="NAME|FILE")
    config = load_config(parser.parse_args(arguments).config)
    settings = settings_of(config)
    found: list[dict[str, Any]] = [one for one in read(FILE) if one["settings"] == settings]
    if not found:
        raise UserError("there are no best-known times for these settings: run best_known.py")
    goals = np.asarray(found[0]["goals"], float) / 1e3
    seconds = np.asarray(found[0]["steps"], float) * config.physics.ctrl_dt
    floor = search_floor(goals, seconds, half_view(config.camera), config.task.max_yaw_rate)
    print(
        f"out of view at the start: {floor.out_of_view:.1%} of {len(goals):,} goals\n"
        f"a turn the wrong way: {floor.turn:.2f} s, for half of these\n"
        f"above best known: {floor.above_best_known:+.1%}"
    )
    return 0


if __name__ == "__main__":
    cli.run_command(main)
