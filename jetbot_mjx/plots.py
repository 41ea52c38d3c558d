"""Figures of episodes and of judgements: each function returns one, and writes nothing."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import PercentFormatter

from jetbot_mjx.evaluation import Summary
from jetbot_mjx.robustness import CARRIES_AT, SweepResult
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


def plot_robustness(results: Sequence[SweepResult]) -> Figure:
    """How far a policy carries: success, and time to goal below it, over each quantity.

    Args:
      results: of one policy, one for each quantity.

    Returns:
      The figure: bands are 95 % Wilson intervals, a dashed line stands at the preset's value.
    """
    medians = [
        summary.time_to_goal_median or 0.0
        for result in results
        for summary in (*result.policy, *result.scripted)
    ]
    columns = min(3, len(results))
    lines = -(-len(results) // columns)
    figure = Figure(figsize=(3.6 * columns, 3.6 * lines), layout="constrained")
    grid = figure.add_gridspec(2 * lines, columns, height_ratios=[3, 2] * lines)
    for index, result in enumerate(results):
        line, column = divmod(index, columns)
        success = figure.add_subplot(grid[2 * line, column])
        time = figure.add_subplot(grid[2 * line + 1, column], sharex=success)
        for name, summaries, colour in (
            ("scripted", result.scripted, "tab:gray"),
            ("policy", result.policy, "tab:green"),
        ):
            _plot_over(success, time, result.sweep.values, summaries, label=name, color=colour)
        for axes in (success, time):
            axes.axvline(result.sweep.nominal, color="black", linestyle="--", linewidth=0.8)
            axes.grid(alpha=0.3)
        success.axhline(CARRIES_AT, color="black", linestyle=":", linewidth=0.8)
        success.set(ylim=(-0.03, 1.03), title=result.sweep.label)
        success.yaxis.set_major_formatter(PercentFormatter(1.0))
        success.tick_params(labelbottom=False)
        time.set(xlabel=f"[{result.sweep.unit}]", ylim=(0.0, 1.1 * max(medians) or 1.0))
        if column == 0:
            success.set(ylabel="success")
            time.set(ylabel="median time\nto goal [s]")
        if index == 0:
            success.legend(loc="lower right", fontsize="small")
    return figure


def _plot_over(
    success: Axes,
    time: Axes,
    values: Sequence[float],
    summaries: Sequence[Summary],
    *,
    label: str,
    color: str,
) -> None:
    rates = [summary.success_rate for summary in summaries]
    low = [summary.success_low for summary in summaries]
    high = [summary.success_high for summary in summaries]
    medians = [
        np.nan if summary.time_to_goal_median is None else summary.time_to_goal_median
        for summary in summaries
    ]
    success.fill_between(values, low, high, color=color, alpha=0.25, linewidth=0)
    success.plot(values, rates, marker="o", markersize=4, color=color, label=label)
    time.plot(values, medians, marker="o", markersize=4, color=color)
