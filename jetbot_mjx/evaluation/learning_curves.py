"""Plot the learning curves of trainings and the results that several of them reach."""

from collections.abc import Sequence

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, PercentFormatter

from jetbot_mjx.evaluation.comparison import Aggregate, Comparison
from jetbot_mjx.evaluation.plots import plot_rates
from jetbot_mjx.evaluation.report import CurvePoint, Report


def plot_learning_curve(report: Report) -> Figure:
    """Plot the success rate over the training and the reported policy.

    Args:
      report: the report of one policy, whose run has a learning curve.

    Returns:
      The figure.
    """
    figure = Figure(figsize=(10.4, 3.6), layout="constrained")
    axes = figure.add_subplot()
    steps = [point.env_steps for point in report.learning_curve]
    label = "during the training, its own goals"
    plot_rates(axes, steps, report.learning_curve, color="C0", label=label)
    policy, x = report.policy, report.env_steps
    interval, label = [policy.success_low, policy.success_high], "this report, the report's goals"
    axes.axvline(x, color=matplotlib.rcParams["grid.color"], lw=1, zorder=0)
    axes.plot(x, policy.success_rate, "D", color="C1", markersize=5, label=label, zorder=3)
    axes.plot([x, x], interval, color="C1", marker="_", markersize=8, zorder=3)
    _label_curves(axes)
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


def plot_learning_curves(comparison: Comparison) -> Figure:
    """Plot the success rate over the training of every run, with a band.

    Args:
      comparison: a comparison of runs, some of which have a learning curve.

    Returns:
      The figure.
    """
    figure = Figure(figsize=(10.4, 4.0), layout="constrained")
    axes = figure.add_subplot()
    # Draw the curve once for two checkpoints of the same run.
    named: dict[tuple[CurvePoint, ...], list[str]] = {}
    for run in comparison.runs:
        seeds = f", {len(run.seeds)} seeds" if len(run.seeds) > 1 else ""
        named.setdefault(run.learning_curve, []).append(run.name + seeds)
    colours = {run.learning_curve: f"C{index}" for index, run in enumerate(comparison.runs)}
    for points, names in named.items():
        if points:
            steps = [point.env_steps for point in points]
            plot_rates(axes, steps, points, color=colours[points], label="; ".join(names))
    _label_curves(axes)
    return figure


def _label_curves(axes: Axes) -> None:
    axes.set(xlabel="environment steps", ylabel="success rate", ylim=(-0.02, 1.04))
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    axes.xaxis.set_major_formatter(EngFormatter())
    axes.grid()
    axes.set_axisbelow(True)
    axes.legend(loc="best", fontsize="small")


def plot_runs(comparison: Comparison) -> Figure:
    """Plot the success rate and time to the goal of every run, with intervals and every seed.

    Args:
      comparison: a comparison of runs.

    Returns:
      The figure.
    """
    height = 1.0 + 0.45 * len(comparison.runs)
    figure = Figure(figsize=(10.4, height), layout="constrained")
    success, seconds = figure.subplots(1, 2, sharey=True)
    for row, run in enumerate(comparison.runs):
        policies = [report.policy for report in run.seeds.values()]
        plot_aggregate(success, row, run.success_rate, [one.success_rate for one in policies])
        plot_aggregate(
            seconds, row, run.time_to_goal, [one.time_to_goal_median for one in policies]
        )
    success.set_yticks(range(len(comparison.runs)), [run.name for run in comparison.runs])
    success.set_ylim(len(comparison.runs) - 0.5, -0.6)
    success.xaxis.set_major_formatter(PercentFormatter(1.0))
    success.set(xlabel="success rate")
    seconds.set(xlabel="median time to goal [s]")
    for axes in (success, seconds):
        axes.grid(axis="x")
        axes.set_axisbelow(True)
        axes.tick_params(axis="y", length=0)
    return figure


def plot_aggregate(
    axes: Axes, row: int, aggregate: Aggregate, values: Sequence[float | None]
) -> None:
    """Draw a run's seeds, its mean with interval, and below it the interquartile mean.

    Args:
      axes: the axes to draw on.
      row: the number of the run, from above.
      aggregate: the quantity over its seeds or episodes.
      values: the quantity of each seed.
    """
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
