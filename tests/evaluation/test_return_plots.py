"""The figures about returns show the numbers of the reports."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_rgba

from helpers.reports import return_report_of
from jetbot_mjx.evaluation.curves import ReturnPoint
from jetbot_mjx.evaluation.learning_curves import plot_learning_curves, plot_runs
from jetbot_mjx.evaluation.return_plots import plot_return_curve, plot_returns
from jetbot_mjx.evaluation.return_report import compare_returns

CURVE = ReturnPoint(0, 1.0, 0.5, 1.5), ReturnPoint(2048, 3.0, 2.0, 4.0)


def test_histograms_hold_every_episode_by_how_it_ended():
    report = return_report_of([1.0, 2.0, 2.0, 7.0])
    ended = np.array([0, 0, 0, 1], np.float32)
    report = report._replace(episodes=report.episodes._replace(terminated=ended))
    left, right = plot_returns(report).axes
    for axes in (left, right):
        by_end = [sum(patch.get_height() for patch in bars) for bars in axes.containers]
        assert by_end == [3, 1]
    assert left.lines[0].get_xdata()[0] == report.policy.episode_return


@pytest.mark.parametrize(
    ("success", "terminated", "labels"),
    [
        (None, [0, 0, 0], ["ended by the time limit"]),
        (None, [1, 0, 1], ["ended by the time limit", "terminated"]),
        ([1, 1, 1], [1, 0, 1], ["success"]),
        ([1, 0, 1], [1, 1, 0], ["success", "no success, terminated"]),
        (
            [0, 0, 1],
            [0, 1, 0],
            ["success", "no success, ended by the time limit", "no success, terminated"],
        ),
    ],
)
def test_histograms_tell_successes_and_name_only_what_they_show(success, terminated, labels):
    report = return_report_of([1.0, 2.0, 3.0])
    fields = {"success": success or [0, 0, 0], "terminated": terminated}
    arrays = {name: np.array(values, np.float32) for name, values in fields.items()}
    policy = report.policy._replace(success_rate=success and sum(success) / 3)
    report = report._replace(episodes=report.episodes._replace(**arrays), policy=policy)
    axes = plot_returns(report).axes[0]
    told = [text.get_text() for text in axes.get_legend().get_texts()]
    assert sorted(told) == sorted(["mean", *labels])
    heights = [patch.get_height() for patch in axes.patches]
    assert sum(heights) == 3
    colors = {patch.get_facecolor() for patch in axes.patches if patch.get_height()}
    assert len(colors) == len(labels)
    # Orange warns of episodes that ended without a success.
    assert (to_rgba("C1") in colors) == any(one.endswith("terminated") for one in labels)


def test_a_curve_shows_the_training_the_report_and_the_baselines():
    report = return_report_of([1.0, 2.0], curve=CURVE)
    report = report._replace(baselines={"zero": report.policy._replace(episode_return=-1.0)})
    (axes,) = plot_return_curve(report).axes
    assert list(axes.lines[0].get_ydata()) == [1.0, 3.0]
    assert axes.lines[1].get_xydata().tolist() == [[2048, 1.5]]
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert labels == ["during the training, its own starts", "this report", "zero"]


def test_a_comparison_draws_every_run_once():
    seeds = {f"seed-{i}": return_report_of([1.0 + i], curve=CURVE) for i in range(2)}
    comparison = compare_returns(Path("there"), {"a": seeds, "b": {"seed-0": seeds["seed-1"]}})
    (axes,) = plot_learning_curves(comparison).axes
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert labels == ["a, 2 seeds", "b"]
    (returns,) = plot_runs(comparison).axes
    assert [text.get_text() for text in returns.get_yticklabels()] == ["a", "b"]
    success = comparison.runs[0].episode_return
    told = comparison._replace(
        runs=tuple(x._replace(success_rate=success) for x in comparison.runs)
    )
    assert len(plot_runs(told).axes) == 2
