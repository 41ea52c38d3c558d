"""Plots show the numbers of the report, and leave no settings of Matplotlib behind."""

import io

import matplotlib
import numpy as np
import pytest
from PIL import Image

from helpers.reports import CTRL_DT, comparison_of, make_episodes, make_report, polar, wins
from helpers.reports import report_of as judged
from jetbot_mjx.evaluation import plots
from jetbot_mjx.evaluation.curves import CurvePoint
from jetbot_mjx.evaluation.learning_curves import (
    plot_learning_curve,
    plot_learning_curves,
    plot_runs,
)
from jetbot_mjx.evaluation.moments import shown_goals
from jetbot_mjx.evaluation.report import by_goal


def texts(axes):
    return [text.get_text() for text in axes.texts]


def corner(png):
    return Image.open(io.BytesIO(png)).convert("RGB").getpixel((0, 0))


def test_a_theme_holds_while_it_lasts_and_no_longer():
    report = make_report(make_episodes([[1, 0], [0, 1]], [1, 0]))
    before = dict(matplotlib.rcParams)
    corners = []
    for name in plots.THEMES:
        with plots.theme(name):
            corners.append(corner(plots.to_png(plots.plot_distributions(report))))
    light, dark = corners
    assert min(light) > 200 > 80 > max(dark)
    assert dict(matplotlib.rcParams) == before


def test_every_cell_of_the_map_tells_its_count():
    goals = polar(np.linspace(0.2, 1.2, 40), np.linspace(-180, 180, 40))
    cells = by_goal(make_episodes(goals, np.arange(40) % 3 > 0), CTRL_DT)
    success, seconds = plots.plot_by_goal(cells).axes
    found = [cell for cell in cells if cell.episodes]
    assert len(found) < len(cells)
    assert texts(success) == [f"{cell.successes}\nof {cell.episodes}" for cell in found]
    timed = [cell for cell in cells if cell.successes]
    assert texts(seconds) == [f"{cell.time_to_goal_median:.2f}" for cell in timed]
    hatched = [bar for bar in success.patches if bar.get_hatch()]
    assert len(hatched) == len(cells) - len(found)


def test_left_is_left_on_the_map():
    # One goal ahead to the left: its cell begins at 22.5° on an axis that runs to the left.
    axes = plots.plot_by_goal(by_goal(make_episodes([[0.5, 0.5]], [1]), CTRL_DT)).axes[0]
    (bar,) = [bar for bar in axes.patches if not bar.get_hatch()]
    assert np.degrees(bar.get_x()) == pytest.approx(22.5)
    assert (axes.get_theta_offset(), axes.get_theta_direction()) == (np.pi / 2, 1)


def test_a_plan_view_shows_every_kind_and_failures_on_top():
    won = np.arange(1000) >= 400
    shown = shown_goals(make_episodes(np.ones((1000, 2)), won), 100, 200)
    assert shown == [*range(400, 500), *range(200)]
    assert shown_goals(make_episodes(np.ones((3, 2)), [0, 1, 0]), 100, 200) == [1, 0, 2]


def test_a_policy_without_a_success_has_no_path_efficiency_to_show():
    report = make_report(make_episodes([[1, 0], [0, 1]], [0, 0]))
    left, right = plots.plot_distributions(report).axes
    assert texts(right) == ["no goal was reached"]
    assert sum(bar.get_height() for bar in left.patches) == 2


@pytest.mark.parametrize(
    ("won", "wanted"),
    [([1, 1], ["reached"]), ([0, 0], ["not reached"]), ([0, 1], ["reached", "not reached"])],
)
def test_legends_list_what_the_plots_show(won, wanted):
    episodes = make_episodes([[1, 0], [0, 1]], won, qpos=np.zeros((2, 61, 9)))
    (plan,) = plots.plot_trajectories(episodes).axes
    distances, _ = plots.plot_distributions(make_report(episodes)).axes
    assert [text.get_text() for text in plan.get_legend().get_texts()][1:] == wanted
    labels = [text.get_text() for text in distances.get_legend().get_texts()]
    assert [label for label in labels if "radius" not in label] == wanted


def test_the_reported_policy_is_marked_on_its_learning_curve():
    curve = [CurvePoint(steps, 0.5, 0.4, 0.6, None) for steps in (0, 2048, 4096)]
    report = make_report(make_episodes([[1, 0], [0, 1]], [1, 0]), curve=curve)
    (axes,) = plot_learning_curve(report).axes
    line, rule, mark, *_ = axes.lines
    np.testing.assert_array_equal(line.get_xdata(), [0, 2048, 4096])
    assert list(rule.get_xdata()) == [2048, 2048]
    assert (*mark.get_xdata(), *mark.get_ydata()) == (2048, 0.5)
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert labels == ["during the training, its own goals", "this report, the report's goals"]


def test_checkpoints_of_one_run_share_one_curve():
    curve = [CurvePoint(0, 0.1, 0.0, 0.2, None), CurvePoint(2048, 0.9, 0.8, 1.0, None)]
    other = [point._replace(success_rate=0.15) for point in curve]
    runs = {"early": curve, "late": curve, "other": other, "without": []}
    comparison = comparison_of(**{name: [judged(wins(5), curve=c)] for name, c in runs.items()})
    (axes,) = plot_learning_curves(comparison).axes
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert labels == ["early; late", "other"]


def test_every_run_has_its_row():
    comparison = comparison_of(
        a=[judged(wins(8)), judged(wins(9))], none=[judged(wins(0)), judged(wins(0))]
    )
    success, seconds = plot_runs(comparison).axes
    assert [label.get_text() for label in success.get_yticklabels()] == ["a", "none"]
    # Mean and interquartile mean, each with a line for its interval.
    assert len(success.lines) == 8
    assert len(seconds.lines) == 4
