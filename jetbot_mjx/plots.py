"""Figures of episodes: each function returns one, and writes nothing."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from jetbot_mjx.rollout import Episodes


def plot_trajectories(
    episodes: Episodes, title: str = "", others_w: Sequence[Float[np.ndarray, "n 3"]] = ()
) -> Figure:
    """Plan view of recorded episodes: where the robot went and where it should have gone.

    Args:
      episodes: recorded.
      title: of the figure.
      others_w: what else stood in each episode's world [m], drawn as grey dots.

    Returns:
      The figure.
    """
    if episodes.qpos is None:
        raise ValueError("these episodes were not recorded: make_rollout(..., record=True)")
    figure = Figure(figsize=(6.4, 6.4), layout="constrained")
    axes = figure.add_subplot()
    for qpos, goal_w, success, steps in zip(
        np.asarray(episodes.qpos),
        np.asarray(episodes.goal_w),
        np.asarray(episodes.success) > 0,
        np.asarray(episodes.steps, int),
        strict=True,
    ):
        colour = "tab:green" if success else "tab:red"
        way = qpos[: steps + 1, :2]
        axes.plot(way[:, 0], way[:, 1], color=colour, linewidth=1.2, alpha=0.8)
        axes.add_patch(
            Rectangle(
                (goal_w[0] - 0.05, goal_w[1] - 0.05), 0.1, 0.1, color=colour, alpha=0.35, lw=0
            )
        )
        axes.plot(*way[-1], marker="o", color=colour, markersize=4)
    for places in others_w:
        axes.scatter(places[:, 0], places[:, 1], color="grey", alpha=0.5, zorder=0)
    axes.plot(0, 0, marker=(3, 0, -90), color="black", markersize=11, label="start, heading +x")
    axes.plot([], [], color="tab:green", label="reached")
    axes.plot([], [], color="tab:red", label="not reached")
    axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title=title)
    reach = 1.1 * max(1.25, float(np.abs(np.asarray(episodes.goal_w)[:, :2]).max()))
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach))
    axes.grid(alpha=0.3)
    axes.legend(loc="upper left", fontsize="small")
    return figure
