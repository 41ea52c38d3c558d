"""The report of a policy, from episodes made by hand."""

import json
import math
import shlex
from pathlib import Path

import numpy as np
import pytest

from helpers.reports import CTRL_DT, make_episodes, make_report, polar
from jetbot_mjx.evaluation.evaluator import wilson_interval
from jetbot_mjx.evaluation.report import (
    ENDED_BY_TASK,
    NON_FINITE,
    SECTORS,
    TIME_LIMIT,
    by_goal,
    find_failures,
    goal_positions,
)


def test_bearings_are_relative_to_the_start_pose():
    goals = [[1, 0], [0, 1], [0, -1], [-1, 0]]
    distance, bearing = goal_positions(make_episodes(goals, np.ones(4)))
    np.testing.assert_allclose(bearing, [0, 90, -90, 180], atol=1e-4)
    np.testing.assert_allclose(distance, 1)
    turned = make_episodes(goals, np.ones(4), start_yaw=np.full(4, math.pi / 2, np.float32))
    np.testing.assert_allclose(goal_positions(turned)[1], [-90, 0, 180, 90], atol=1e-4)
    moved = make_episodes(goals, np.ones(4), start_w=np.tile(np.float32([1, 1]), (4, 1)))
    np.testing.assert_allclose(goal_positions(moved)[1], [-90, 180, -116.565, -153.435], atol=1e-2)


def test_a_cell_counts_the_goals_of_its_ring_and_sector():
    rng = np.random.default_rng(0)
    distance, bearing = rng.uniform(0.2, 1.2, 400), rng.uniform(-180, 180, 400)
    won = rng.random(400) < 0.7
    steps = rng.integers(20, 200, 400)
    cells = by_goal(make_episodes(polar(distance, bearing), won, steps), CTRL_DT)
    assert len(cells) % SECTORS == 0
    assert sum(cell.episodes for cell in cells) == 400
    for cell in cells:
        behind = cell.bearing_high > 180
        turned = np.where(bearing < 0, bearing + 360, bearing) if behind else bearing
        here = (cell.bearing_low <= turned) & (turned < cell.bearing_high)
        here &= (cell.distance_low <= distance) & (distance < cell.distance_high)
        assert (cell.episodes, cell.successes) == (here.sum(), (here & won).sum())
        assert cell.time_to_goal_median == pytest.approx(np.median(steps[here & won]) * CTRL_DT)
        assert (cell.success_low, cell.success_high) == wilson_interval(
            cell.successes, cell.episodes
        )


def test_a_cell_without_a_goal_has_no_rate_and_one_without_a_success_no_time():
    cells = by_goal(make_episodes([[0.3, 0], [1.1, 0]], [0, 1]), CTRL_DT)
    inner, outer = cells[0], cells[-SECTORS]
    empty = cells[1]
    assert (empty.episodes, empty.success_rate, empty.success_low) == (0, None, None)
    assert (inner.success_rate, inner.time_to_goal_median) == (0.0, None)
    assert (outer.success_rate, outer.time_to_goal_median) == (1.0, pytest.approx(1.0))


@pytest.mark.parametrize("distance", [0.2, 1.0, 40.0])
def test_goals_that_are_all_as_far_make_one_ring(distance):
    goals = polar(np.full(16, distance), np.arange(16) * 22.5 + 5)
    cells = by_goal(make_episodes(goals, np.ones(16)), CTRL_DT)
    assert [cell.episodes for cell in cells] == [2] * SECTORS


def test_a_failure_tells_where_the_goal_was_and_how_it_ended():
    episodes = make_episodes(
        [[1, 0], [0, 0.5], [0, -0.5], [-1, 0]],
        [1, 0, 0, 0],
        terminated=np.float32([1, 0, 1, 0]),
        nonfinite=np.float32([0, 0, 0, 1]),
    )
    found = find_failures(episodes, Path("runs/a"), 2048)
    assert [failure.goal for failure in found] == [1, 2, 3]
    assert [failure.ended for failure in found] == [TIME_LIMIT, ENDED_BY_TASK, NON_FINITE]
    np.testing.assert_allclose([failure.distance for failure in found], [0.5, 0.5, 1.0])
    np.testing.assert_allclose([failure.bearing for failure in found], [90, -90, 180], atol=1e-4)
    np.testing.assert_allclose([failure.final_distance for failure in found], 0.3, rtol=1e-5)


def test_a_replay_command_survives_the_shell():
    episodes = make_episodes([[1, 0], [0, 1]], [1, 0])
    (failure,) = find_failures(episodes, Path("my runs/it's"), 2048)
    words = shlex.split(failure.replay)
    assert words[:2] == ["jetbot-mjx", "render"]
    assert words[2:] == ["my runs/it's", "--checkpoint", "2048", "--goals", "1"]


def test_goals_that_cannot_be_rendered_have_no_replay_command(monkeypatch):
    monkeypatch.setattr("jetbot_mjx.evaluation.report.REPORT_GOALS", 1)
    found = find_failures(make_episodes([[1, 0], [0, 1]], [0, 0]), Path("runs/a"), 2048)
    assert found[0].replay.endswith("--goals 0")
    assert found[1].replay is None


def test_a_report_is_json_and_names_its_run():
    report = make_report(make_episodes([[1, 0], [0, 1]], [1, 0]), "runs/five/seed-2")
    values = json.loads(json.dumps(report.to_json(), allow_nan=False))
    assert values["run"] == report.name == "five/seed-2"
    assert values["settings"]["task.episode_length"] == 256
    assert sum(cell["episodes"] for cell in values["cells"]) == values["policy"]["episodes"]
    assert len(values["failures"]) == 1
    assert make_report(report.episodes, "runs/alone").name == "alone"


def test_a_goal_that_rounding_moved_over_the_edge_makes_no_further_ring():
    cells = by_goal(make_episodes([[0.2 - 1e-7, 0], [1.2 + 1e-7, 0]], [1, 1]), CTRL_DT)
    assert (cells[0].distance_low, cells[-1].distance_high) == (0.2, 1.2)
    assert sum(cell.episodes for cell in cells) == 2
