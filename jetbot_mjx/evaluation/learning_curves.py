"""Plot the learning curves of trainings and the results that several of them reach."""

from collections.abc import Sequence

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, PercentFormatter

from jetbot_mjx.evaluation.comparison import Aggregate, Comparison
from jetbot_mjx.evaluation.curves import CurvePoint, ReturnPoint
from jetbot_mjx.evaluation.plots import plot_band
from jetbot_mjx.evaluation.report import Report
from jetbot_mjx.evaluation.return_report import ReturnComparison

SUCCESS, RETURN = "success rate", "mean return"
_QUANTITIES = {
    "episode_return": ("episode_return", RETURN),
    "success_rate": ("success_rate", SUCCESS),
    "time_to_goal": ("time_to_goal_median", "median time to goal [s]"),
}
"""Quantities of a run, each with its name in the results of a seed, and its label."""


def plot_learning_curve(report: Report) -> Figure:
    """Plot the success rate over the training and the reported policy.

    Args:
      report: the report of one policy, whose run has a learning curve.

    Returns:
      The figure.
    """
    figure = Figure(figsize=(10.4, 3.6), layout="constrained")
    axes = figure.add_subplot()
    plot_curve(axes, report.learning_curve, "C0", "during the training, its own goals")
    policy, x = report.policy, report.env_steps
    interval, label = [policy.success_low, policy.success_high], "this report, the report's goals"
    axes.axvline(x, color=matplotlib.rcParams["grid.color"], lw=1, zorder=0)
    axes.plot(x, policy.success_rate, "D", color="C1", markersize=5, label=label, zorder=3)
    axes.plot([x, x], interval, color="C1", marker="_", markersize=8, zorder=3)
    label_curves(axes, SUCCESS)
    return figure


def plot_losses(report: Report) -> Figure:
    """Plot the losses over the training.

    Args:
      report: the report of one policy, whose run has losses.

    Returns:
      The figure, a panel for each of them.
    """
    figure = Figure(figsize=(10.4, 2.6), layout="constrained")
    steps = [point.env_steps for point in report.losses]
    titles = ("Policy loss", "Value loss", "KL divergence per update")
    values = zip(*(point[1:] for point in report.losses), strict=True)
    for axes, title, line in zip(figure.subplots(1, 3), titles, values, strict=True):
        axes.plot(steps, line, color="C0", lw=1.5)
        axes.set(title=title, xlabel="environment steps")
        axes.xaxis.set_major_formatter(EngFormatter())
        axes.grid()
        axes.set_axisbelow(True)
    return figure


def plot_learning_curves(comparison: Comparison | ReturnComparison) -> Figure:
    """Plot the success rate or the mean return over the training of every run, with a band.

    Args:
      comparison: a comparison of runs, some of which have a learning curve.

    Returns:
      The figure.
    """
    figure = Figure(figsize=(10.4, 4.0), layout="constrained")
    axes = figure.add_subplot()
    # Draw the curve once for two checkpoints of the same run.
    named: dict[tuple[CurvePoint | ReturnPoint, ...], list[str]] = {}
    for run in comparison.runs:
        seeds = f", {len(run.seeds)} seeds" if len(run.seeds) > 1 else ""
        named.setdefault(run.learning_curve, []).append(run.name + seeds)
    curves = [run.learning_curve for run in comparison.runs]
    for points, names in named.items():
        if points:
            last = max(index for index, curve in enumerate(curves) if curve == points)
            plot_curve(axes, points, f"C{last}", "; ".join(names))
    label_curves(axes, SUCCESS if isinstance(comparison, Comparison) else RETURN)
    return figure


def plot_curve(
    axes: Axes, points: Sequence[CurvePoint | ReturnPoint], color: str, label: str
) -> None:
    """Draw a learning curve with its intervals as a band.

    Args:
      axes: the axes to draw on.
      points: the curve.
      color: the colour of line and band.
      label: what the legend says.
    """
    steps, values = [point.env_steps for point in points], [point[1:4] for point in points]
    plot_band(axes, steps, values, color=color, label=label)


def label_curves(axes: Axes, quantity: str) -> None:
    """Label the axes of learning curves of a quantity, `SUCCESS` or `RETURN`."""
    axes.set(xlabel="environment steps", ylabel=quantity)
    if quantity == SUCCESS:
        axes.set(ylim=(-0.02, 1.04))
        axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    axes.xaxis.set_major_formatter(EngFormatter())
    axes.grid()
    axes.set_axisbelow(True)
    axes.legend(loc="best", fontsize="small")


def plot_runs(comparison: Comparison | ReturnComparison) -> Figure:
    """Plot the results of every run, with intervals and every seed.

    Args:
      comparison: a comparison of runs.

    Returns:
      The figure, with a panel for each quantity that a run has.
    """
    runs = comparison.runs
    names = [name for name in _QUANTITIES if any(getattr(run, name, None) for run in runs)]
    figure = Figure(figsize=(10.4, 1.0 + 0.45 * len(runs)), layout="constrained")
    grid = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
    for axes, name in zip(grid, names, strict=True):
        of_seed, label = _QUANTITIES[name]
        for row, run in enumerate(runs):
            if aggregate := getattr(run, name):
                values = [getattr(report.policy, of_seed) for report in run.seeds.values()]
                _plot_aggregate(axes, row, aggregate, values)
        axes.set(xlabel=label)
        if label == SUCCESS:
            axes.xaxis.set_major_formatter(PercentFormatter(1.0))
        axes.grid(axis="x")
        axes.set_axisbelow(True)
        axes.tick_params(axis="y", length=0)
    grid[0].set_yticks(range(len(runs)), [run.name for run in runs])
    grid[0].set_ylim(len(runs) - 0.5, -0.6)
    return figure


def _plot_aggregate(
    axes: Axes, row: int, aggregate: Aggregate, values: Sequence[float | None]
) -> None:
    """Draw a run's seeds, its mean with interval, and below it the interquartile mean."""
    colour = f"C{row}"
    kinds = [(aggregate.mean, 0.0, "o"), (aggregate.iqm, 0.22, "s")]
    if aggregate.over == "seeds":
        found = [value for value in values if value is not None]
        axes.scatter(found, [row - 0.2] * len(found), s=12, color=colour, alpha=0.5, lw=0)
    for (value, low, high), below, marker in kinds:
        if low is not None and high is not None:
            axes.plot([low, high], [row + below] * 2, color=colour, lw=2.5)
        if value is not None:
            axes.plot(value, row + below, marker=marker, color=colour, markersize=6)
