"""The goal task: observations, rewards, ends and goals."""

import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jetbot_mjx.config import TaskConfig
from jetbot_mjx.envs.task import (
    LAYOUTS,
    GoalTask,
    RobotState,
    Task,
    layout_size,
    layout_table,
    make_task,
    reach_on_floor,
)


def robot_at(x=0.0, y=0.0, z=0.0325, yaw=0.0, velocity=(0.0, 0.0, 0.0), spin=0.0):
    return RobotState(
        position_w=jnp.array([x, y, z], jnp.float32),
        quat=jnp.array([math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)], jnp.float32),
        linear_velocity_w=jnp.array(velocity, jnp.float32),
        angular_velocity_w=jnp.array([0.0, 0.0, spin], jnp.float32),
    )


def goal_at(x, y):
    return jnp.array([x, y, 0.05], jnp.float32)


@pytest.mark.parametrize(("height", "reach"), [(0.05, 0.1), (0.11, 0.08), (0.15, 0.0), (0.5, 0.0)])
def test_a_goal_is_reached_within_a_distance_on_the_floor(height, reach):
    task = GoalTask(TaskConfig())
    assert reach_on_floor(task, height) == pytest.approx(reach, abs=1e-6)
    for factor, reached in ((0.99, reach > 0), (1.01, False)):
        robot = robot_at(x=factor * reach, z=height)
        assert bool(task.success(robot, goal_at(0.0, 0.0))) == reached


def test_the_reach_of_a_task_with_goals_of_its_own_is_not_known():
    class High(GoalTask):
        def sample(self, key):
            return super().sample(key).at[2].add(1.0)

    assert reach_on_floor(High(TaskConfig()), 0.03) is None


@pytest.fixture(scope="module")
def goals():
    keys = jax.random.split(jax.random.PRNGKey(0), 4096)
    return np.asarray(jax.jit(jax.vmap(GoalTask(TaskConfig()).sample))(keys), np.float64)


def test_goal_distances_follow_the_tutorials_law(goals):
    distance = np.hypot(goals[:, 0], goals[:, 1])
    # r = √u + 0.2: P(r < d) = (d - 0.2)² on [0.2, 1.2].
    assert stats.kstest(distance, lambda d: np.clip(d - 0.2, 0, 1) ** 2).pvalue > 0.01
    np.testing.assert_allclose(distance.mean(), 2 / 3 + 0.2, atol=0.02)
    assert goals[:, 2] == pytest.approx(0.05)


def test_goal_directions_are_uniform_and_independent_of_the_distance(goals):
    angle = np.arctan2(goals[:, 0], goals[:, 1])
    assert stats.kstest(angle, stats.uniform(-np.pi, 2 * np.pi).cdf).pvalue > 0.01
    distance = np.hypot(goals[:, 0], goals[:, 1])
    assert stats.spearmanr(angle, distance).pvalue > 0.01


def test_the_sampler_test_would_notice_an_area_uniform_draw():
    u = np.random.default_rng(0).uniform(size=4096)
    area_uniform = np.sqrt(0.2**2 + u * (1.2**2 - 0.2**2))
    assert stats.kstest(area_uniform, lambda d: np.clip(d - 0.2, 0, 1) ** 2).pvalue < 1e-6


def test_the_world_observation_is_the_tutorials_16_numbers_in_its_order():
    robot = robot_at(1.0, 2.0, 0.03, yaw=math.pi / 2, velocity=(4.0, 5.0, 6.0), spin=7.0)
    obs = GoalTask(TaskConfig()).observe(robot, goal_at(8.0, 9.0))
    half = math.sqrt(0.5)
    expected = [1, 2, 0.03, half, 0, 0, half, 4, 5, 6, 0, 0, 7, 8, 9, 0.05]
    np.testing.assert_allclose(obs, expected, rtol=1e-6, atol=1e-7)


def test_the_egocentric_observation_by_hand():
    # Heading +y, the goal 0.5 m to the north-west: 0.3 m ahead and 0.4 m to the left.
    robot = robot_at(1.0, 1.0, yaw=math.pi / 2, velocity=(0.1, 0.6, 0.0), spin=2.0)
    obs = GoalTask(TaskConfig(observation="egocentric")).observe(robot, goal_at(0.6, 1.3))
    expected = [0.3, 0.4, 0.6, 0.8, 0.5, 0.6, 2.0]
    np.testing.assert_allclose(obs, expected, rtol=1e-5, atol=1e-6)


def test_the_egocentric_observation_is_the_same_wherever_the_robot_stands():
    task = GoalTask(TaskConfig(observation="egocentric"))
    here = task.observe(robot_at(velocity=(0.5, 0.0, 0.0)), goal_at(0.6, 0.2))
    turn = 2.0
    cos, sin = math.cos(turn), math.sin(turn)
    there = task.observe(
        robot_at(3.0, -2.0, yaw=turn, velocity=(0.5 * cos, 0.5 * sin, 0.0)),
        goal_at(3.0 + 0.6 * cos - 0.2 * sin, -2.0 + 0.6 * sin + 0.2 * cos),
    )
    np.testing.assert_allclose(here, there, atol=1e-5)


@pytest.mark.parametrize("name", [name for name in LAYOUTS if name])
def test_sizes_and_tables_follow_the_layout(name):
    task = GoalTask(TaskConfig(observation=name))
    obs = task.observe(robot_at(), goal_at(1.0, 0.0))
    assert obs.shape == (layout_size(task.layout),)
    table = layout_table(task.layout)
    assert table.count("\n") == len(task.layout) + 1
    for field in task.layout:
        assert field.name in table
    last = layout_size(task.layout) - 1
    assert table.splitlines()[-1].startswith((f"| {last} ", f"| {last - 2}-{last} "))


def test_reward_is_progress_and_telescopes():
    task = GoalTask(TaskConfig())
    goal = goal_at(1.0, 0.0)
    way = [robot_at(x) for x in (0.0, 0.1, 0.05, 0.4)]
    rewards = [task.reward(a, b, goal, jnp.zeros(2))[0] for a, b in itertools.pairwise(way)]
    np.testing.assert_allclose(rewards[1], -0.05, atol=1e-4)
    covered = task.distance(way[0], goal) - task.distance(way[-1], goal)
    np.testing.assert_allclose(sum(rewards), covered, rtol=1e-5)


def test_a_step_costs_what_is_stated_and_nothing_by_default():
    way = robot_at(0.0), robot_at(0.1), goal_at(1.0, 0.0), jnp.zeros(2)
    free, terms = GoalTask(TaskConfig()).reward(*way)
    assert set(terms) == {"progress"}
    dear, terms = GoalTask(TaskConfig(step_cost=0.03)).reward(*way)
    np.testing.assert_allclose(free - dear, 0.03, rtol=1e-4)
    np.testing.assert_allclose(sum(terms.values()), dear, rtol=1e-6)


@pytest.mark.parametrize(("gap", "reached"), [(0.0983, True), (0.0986, False)])
def test_success_is_a_ball_of_100_mm_hence_98_mm_on_the_floor(gap, reached):
    # √(0.1² - (0.05 - 0.0325)²) = 0.09846
    task = GoalTask(TaskConfig())
    robot = robot_at(1.0 - gap)
    assert bool(task.success(robot, goal_at(1.0, 0.0))) is reached
    assert bool(task.terminated(robot, goal_at(1.0, 0.0))) is reached


def test_the_goal_task_is_a_task():
    assert isinstance(make_task(TaskConfig()), Task)
