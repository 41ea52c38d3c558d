"""Draw the bound of the time to a goal: `python docs/draw_lower_bound.py docs/lower-bound.png`."""

import json
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.learning.reachable import Grid, Limits, farthest
from jetbot_mjx.evaluation.best_known import BOUND_FILE, FILE

TIMES = (0.5, 1.0, 1.5)  # [s]
GRID = Grid(4, 72)


def of_isaac(searches: list[dict]) -> dict:
    """Return what is stored for the tutorial's robot."""
    return next(one for one in searches if one["settings"]["robot.preset"] == "isaac")


def outline(table: np.ndarray) -> np.ndarray:
    """Return the corners of the set of points that are within a distance in each direction."""
    angles = np.arange(len(table)) * 2 * np.pi / len(table)
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    corners = []
    for one, other in zip(range(len(table)), np.roll(range(len(table)), -1), strict=True):
        corner = np.linalg.solve(normals[[one, other]], table[[one, other]])
        if (normals @ corner <= table + 1e-6).all():
            corners.append(corner)
    return np.array([*corners, corners[0]])


if __name__ == "__main__":
    bound, known = (of_isaac(json.loads(one.read_text())["searches"]) for one in (BOUND_FILE, FILE))
    limits = Limits(**bound["limits"])
    table = farthest(limits, round(max(TIMES) / limits.ctrl_dt), GRID)
    goals = np.array(bound["goals"]) / 1e3
    gaps = np.array(known["steps"]) / np.array(bound["steps"]) - 1
    figure, axes = plt.subplots(figsize=(7.0, 5.4), layout="constrained")
    dots = axes.scatter(-goals[:, 1], goals[:, 0], c=100 * gaps, s=9, cmap="viridis", vmax=30)
    figure.colorbar(dots, label="best known above the bound [%]")
    for time in TIMES:
        corners = outline(table[round(time / limits.ctrl_dt)] + bound["reach"])
        axes.plot(-corners[:, 1], corners[:, 0], label=f"reachable in {time:g} s")
    axes.plot(0, 0, marker="^", color="black", markersize=9)
    axes.set(aspect="equal", xlabel="to the right [m]", ylabel="ahead [m]")
    axes.legend(loc="upper right")
    figure.savefig(sys.argv[1], dpi=110)
