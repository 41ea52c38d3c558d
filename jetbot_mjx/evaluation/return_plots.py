"""Plot the returns of policies of an environment of one's own; each function returns a figure."""

import matplotlib
import numpy as np
from jaxtyping import Bool
from matplotlib.figure import Figure

from jetbot_mjx.evaluation.learning_curves import RETURN, label_curves, plot_curve
from jetbot_mjx.evaluation.return_report import ReturnReport

_BINS = 40


def plot_returns(report: ReturnReport) -> Figure:
    """Plot histograms of the returns and of the lengths of a policy's episodes.

    Args:
      report: the report of one policy.

    Returns:
      The figure. Episodes that the environment ended have another colour than those that the time
      limit ended, and so have successes, however they ended.
    """
    episodes = report.episodes
    kinds = _by_end(report)
    figure = Figure(figsize=(10.4, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    for axes, values, title in (
        (left, np.asarray(episodes.episode_return, float), "return"),
        (right, np.asarray(episodes.steps, float), "length [steps]"),
    ):
        axes.hist(
            [values[chosen] for _, _, chosen in kinds],
            bins=np.histogram_bin_edges(values, _BINS).tolist(),
            stacked=True,
            color=[color for _, color, _ in kinds],
            label=[label for label, _, _ in kinds],
        )
        axes.set(xlabel=title, ylabel="episodes")
        axes.set_axisbelow(True)
    left.axvline(report.policy.episode_return, color=_ink(), lw=1, ls="--", label="mean")
    left.legend(fontsize="small")
    return figure


def _by_end(report: ReturnReport) -> list[tuple[str, str, Bool[np.ndarray, " n"]]]:
    """Return label, colour and episodes of each way in which any episode ended."""
    ended = np.asarray(report.episodes.terminated) > 0
    kinds = [("ended by the time limit", "C0", ~ended), ("terminated", "C1", ended)]
    if report.policy.success_rate is not None:
        won = np.asarray(report.episodes.success) > 0
        kinds = [
            ("success", "C0", won),
            ("no success, ended by the time limit", "C2", ~won & ~ended),
            ("no success, terminated", "C1", ~won & ended),
        ]
    return [kind for kind in kinds if kind[2].any()]


def plot_return_curve(report: ReturnReport) -> Figure:
    """Plot the mean return over the training, the reported policy and the baselines.

    Args:
      report: the report of one policy, whose run has a learning curve.

    Returns:
      The figure.
    """
    figure = Figure(figsize=(10.4, 3.6), layout="constrained")
    axes = figure.add_subplot()
    plot_curve(axes, report.learning_curve, "C0", "during the training, its own starts")
    policy, x = report.policy, report.env_steps
    axes.plot(x, policy.episode_return, "D", color="C1", markersize=5, label="this report")
    axes.plot([x, x], [policy.return_low, policy.return_high], color="C1", marker="_")
    for style, (name, baseline) in zip((":", "-."), report.baselines.items(), strict=False):
        axes.axhline(baseline.episode_return, color=_ink(), lw=1, ls=style, label=name)
    label_curves(axes, RETURN)
    return figure


def _ink() -> str:
    return matplotlib.rcParams["text.color"]
