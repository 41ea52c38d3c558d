"""Plot the returns of policies of an environment of one's own; each function returns a figure."""

from collections.abc import Sequence

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, PercentFormatter

from jetbot_mjx.evaluation.learning_curves import plot_aggregate
from jetbot_mjx.evaluation.return_report import ReturnComparison, ReturnPoint, ReturnReport

_BINS = 40


def plot_returns(report: ReturnReport) -> Figure:
    """Plot histograms of the returns and of the lengths of a policy's episodes.

    Args:
      report: the report of one policy.

    Returns:
      The figure. Episodes that the environment ended have another colour than those that the time
      limit ended.
    """
    episodes = report.episodes
    ended = np.asarray(episodes.terminated) > 0
    figure = Figure(figsize=(10.4, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    for axes, values, title in (
        (left, np.asarray(episodes.episode_return, float), "return"),
        (right, np.asarray(episodes.steps, float), "length [steps]"),
    ):
        axes.hist(
            [values[~ended], values[ended]],
            bins=np.histogram_bin_edges(values, _BINS).tolist(),
            stacked=True,
            color=["C0", "C1"],
            label=["ended by the time limit", "terminated"],
        )
        axes.set(xlabel=title, ylabel="episodes")
        axes.set_axisbelow(True)
    left.axvline(report.policy.episode_return, color=_ink(), lw=1, ls="--", label="mean")
    left.legend(fontsize="small")
    return figure


def plot_return_curve(report: ReturnReport) -> Figure:
    """Plot the mean return over the training, the reported policy and the baselines.

    Args:
      report: the report of one policy, whose run has a learning curve.

    Returns:
      The figure.
    """
    figure = Figure(figsize=(10.4, 3.6), layout="constrained")
    axes = figure.add_subplot()
    _plot_band(axes, report.learning_curve, "C0", "during the training, its own starts")
    policy, x = report.policy, report.env_steps
    axes.plot(x, policy.episode_return, "D", color="C1", markersize=5, label="this report")
    axes.plot([x, x], [policy.return_low, policy.return_high], color="C1", marker="_")
    for style, (name, baseline) in zip((":", "-."), report.baselines.items(), strict=False):
        axes.axhline(baseline.episode_return, color=_ink(), lw=1, ls=style, label=name)
    _label_curves(axes)
    return figure


def plot_return_curves(comparison: ReturnComparison) -> Figure:
    """Plot the mean return over the training of every run, with a band.

    Args:
      comparison: a comparison of runs, some of which have a learning curve.

    Returns:
      The figure.
    """
    figure = Figure(figsize=(10.4, 4.0), layout="constrained")
    axes = figure.add_subplot()
    for index, run in enumerate(comparison.runs):
        if run.learning_curve:
            seeds = f", {len(run.seeds)} seeds" if len(run.seeds) > 1 else ""
            _plot_band(axes, run.learning_curve, f"C{index}", run.name + seeds)
    _label_curves(axes)
    return figure


def plot_return_runs(comparison: ReturnComparison) -> Figure:
    """Plot the mean return of every run, and its success rate if there is one, with intervals.

    Args:
      comparison: a comparison of runs.

    Returns:
      The figure.
    """
    runs = comparison.runs
    has_success = any(run.success_rate for run in runs)
    figure = Figure(figsize=(10.4, 1.0 + 0.45 * len(runs)), layout="constrained")
    grid = figure.subplots(1, 1 + has_success, sharey=True, squeeze=False)[0]
    for row, run in enumerate(runs):
        policies = [report.policy for report in run.seeds.values()]
        plot_aggregate(grid[0], row, run.episode_return, [x.episode_return for x in policies])
        if run.success_rate:
            plot_aggregate(grid[1], row, run.success_rate, [x.success_rate for x in policies])
    grid[0].set_yticks(range(len(runs)), [run.name for run in runs])
    grid[0].set_ylim(len(runs) - 0.5, -0.6)
    grid[0].set(xlabel="mean return")
    if has_success:
        grid[1].set(xlabel="success rate")
        grid[1].xaxis.set_major_formatter(PercentFormatter(1.0))
    for axes in grid:
        axes.grid(axis="x")
        axes.set_axisbelow(True)
        axes.tick_params(axis="y", length=0)
    return figure


def _plot_band(axes: Axes, points: Sequence[ReturnPoint], color: str, label: str) -> None:
    steps = [point.env_steps for point in points]
    low, high = [x.return_low for x in points], [x.return_high for x in points]
    axes.fill_between(steps, low, high, color=color, alpha=0.25, lw=0)
    means = [point.episode_return for point in points]
    axes.plot(steps, means, color=color, marker="o", markersize=4, label=label)


def _label_curves(axes: Axes) -> None:
    axes.set(xlabel="environment steps", ylabel="mean return")
    axes.xaxis.set_major_formatter(EngFormatter())
    axes.grid()
    axes.set_axisbelow(True)
    axes.legend(loc="best", fontsize="small")


def _ink() -> str:
    return matplotlib.rcParams["text.color"]
