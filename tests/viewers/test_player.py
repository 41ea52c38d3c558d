"""The player without a viewer: agents, time, and what a user can change."""

import itertools
import math
import shutil
import sys
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import gliding
from jetbot_mjx.config import load_config, parse_config
from jetbot_mjx.envs import kinematics
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.robot_model import QPOS_QUAT, QPOS_XYZ
from jetbot_mjx.envs.task import GoalTask
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs.checkpoint import load_policy
from jetbot_mjx.runs.checkpoint_store import checkpoint_path, checkpoint_steps
from jetbot_mjx.viewers import player as module
from jetbot_mjx.viewers.player import Player
from jetbot_mjx.viewers.step_fns import AGENTS, move_goal_error

SEED = 7
HOLD = 24  # control steps of standing still after an end


@pytest.fixture(scope="module", autouse=True)
def glide(smoke_run):
    """All robots of these tests glide, after the run was trained with those that do not."""
    with gliding.everywhere():
        yield


@pytest.fixture(scope="module")
def one(smoke_run):
    return Player(smoke_run, seed=SEED)


@pytest.fixture(scope="module")
def first_goal(one):
    return one.snapshot.goal_w


@pytest.fixture
def player(one, first_goal):
    """The one player, as if it had just been made, save that other goals come next."""
    del first_goal  # asked for so that it is noted before any test changes it
    one.agent, one.paused, one.speed = "policy", False, 1.0
    one.successes = one.episodes = 0
    one.outcome = None
    one.switch_checkpoint(max(one.checkpoints))
    one.drive(0.0, 0.0)
    one.reset()
    return one


@pytest.fixture
def wall(monkeypatch):
    """A wall clock that stands until it is told to go on."""
    clock = types.SimpleNamespace(now=1000.0)
    monkeypatch.setattr(module, "time", types.SimpleNamespace(monotonic=lambda: clock.now))
    return clock


def ticks(player, count):
    for _ in range(count):
        player.tick()


def tick_to_the_end(player):
    """Ticks until the episode ends; how many it took."""
    before = player.episodes
    for count in range(1, 300):
        player.tick()
        if player.episodes > before:
            return count
    raise AssertionError("no end within 300 steps")


def yaw(player):
    w, x, y, z = player.snapshot.qpos[QPOS_QUAT]
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def position(player):
    return np.array(player.snapshot.qpos[QPOS_XYZ][:2])


# Time.


def test_control_keeps_the_rate_of_the_environment(player, wall):
    player.speed = 1.0
    steps = []
    for passed in [0.013, 0.029, 0.016, 0.008] * 30:
        wall.now += passed
        steps.append(player.advance())
    assert sum(steps) == pytest.approx(60 * 1.98, abs=1)
    assert player.ticks.per_second(wall.now) == pytest.approx(60, abs=2)


def test_twice_the_pace_is_twice_the_steps(player, wall):
    player.speed = 2.0
    wall.now += 0.051
    assert player.advance() == 6
    player.speed = 100.0
    assert player.speed == 4.0


def test_a_player_that_was_held_up_does_not_race(player, wall):
    player.speed = 1.0
    wall.now += 30.0
    assert player.advance() == 6


def test_a_paused_player_makes_single_steps(player, wall):
    player.agent = "scripted"
    player.paused = True
    before = player.time
    for _ in range(10):
        wall.now += 0.1
        assert player.advance() == 0
    assert player.time == before
    player.tick()
    assert player.time == pytest.approx(before + 1 / 60)
    # What passed meanwhile is not made good.
    player.paused = False
    wall.now += 0.018
    assert player.advance() == 1


# Episodes.


def test_an_end_draws_a_new_goal_and_puts_the_robot_back(player):
    player.agent = "scripted"
    goal_w, key = player.snapshot.goal_w, player._states.key[0]
    tick_to_the_end(player)
    assert (player.successes, player.episodes, player.outcome) == (1, 1, "reached")
    end = position(player)
    ticks(player, HOLD - 1)
    np.testing.assert_array_equal(position(player), end)
    player.tick()
    # As the wrapper of trainings does: from the key that the episode carried.
    expected = player.env.reset(key)
    np.testing.assert_allclose(player.snapshot.goal_w, expected.goal, rtol=1e-6)
    assert not np.allclose(player.snapshot.goal_w, goal_w)
    np.testing.assert_array_equal(position(player), 0.0)
    assert (player.time, player.episodes) == (0.0, 1)


def test_the_first_goal_follows_from_the_seed(one, first_goal):
    keys = [jax.random.split(jax.random.PRNGKey(seed))[1] for seed in (SEED, SEED + 1)]
    same, other = (one.env.reset(key).goal for key in keys)
    np.testing.assert_allclose(first_goal, same, rtol=1e-6)
    assert not np.allclose(first_goal, other)


def test_the_time_limit_ends_an_episode(player):
    player.agent = "keyboard"
    assert tick_to_the_end(player) == 256
    assert (player.successes, player.episodes, player.outcome) == (0, 1, "out of time")
    assert player.time == 256 * player.env.dt


def test_a_reset_in_mid_episode_counts_no_episode(player):
    ticks(player, 10)
    goal_w = player.snapshot.goal_w
    player.reset()
    assert player.episodes == 0
    assert player.time == 0
    assert not np.allclose(player.snapshot.goal_w, goal_w)


@pytest.mark.parametrize(
    ("how", "outcome"),
    [
        ({"success": 1, "terminated": 1}, "reached"),
        ({"terminated": 1}, "failed"),
        ({"nonfinite": 1}, "non-finite state"),
        ({}, "out of time"),
    ],
)
def test_an_end_is_named(player, how, outcome):
    none = {"success": 0, "terminated": 0, "nonfinite": 0}
    assert module._outcome(player.snapshot._replace(**none | how)) == outcome


# Goals that a user moves.


def test_a_goal_that_is_moved_is_reached(player):
    player.agent = "scripted"
    ticks(player, 20)
    assert player.move_goal(-0.5, 0.3)
    np.testing.assert_allclose(player.snapshot.goal_w, [-0.5, 0.3, 0.05], rtol=1e-6)
    np.testing.assert_array_equal(player.snapshot.markers["goal"], player.snapshot.goal_w)
    tick_to_the_end(player)
    assert player.outcome == "reached"
    assert np.linalg.norm(position(player) - [-0.5, 0.3]) < 0.1
    assert player.distance < 0.1


def test_a_goal_that_is_moved_has_the_whole_time_limit(player):
    player.agent = "keyboard"
    ticks(player, 200)
    player.move_goal(0.0, 1.0)
    assert player.time == 0
    assert tick_to_the_end(player) == 256


def test_the_policy_observes_a_moved_goal_at_once(player):
    player.move_goal(0.0, 0.6)
    robot_at_rest = player._states.obs[0]
    # Egocentric: straight to the left, 0.6 m away.
    np.testing.assert_allclose(robot_at_rest[:5], [0, 0.6, 0, 1, 0.6], atol=1e-5)


def test_after_an_end_a_moved_goal_lets_the_robot_go_on_from_there(player):
    player.agent = "scripted"
    tick_to_the_end(player)
    end = position(player)
    target = end + np.float32(0.4)
    player.move_goal(float(target[0]), float(target[1]))
    assert player.snapshot.done == 0
    player.tick()
    assert np.linalg.norm(position(player) - end) < 0.05
    tick_to_the_end(player)
    assert np.linalg.norm(position(player) - target) < 0.1
    assert (player.successes, player.episodes) == (2, 2)


class DrawsMore(GoalTask):
    """Draws more than a position, and inherits a `move_goal` that knows of none of it."""

    def sample(self, key):
        return {"goal": super().sample(key), "bonus": jnp.zeros(2)}

    def goal_position(self, goal):
        return goal["goal"]


class StaysPut(GoalTask):
    move_goal = None


def state_of(task):
    this = sys.modules[__name__].__name__
    env = make_env(parse_config({"task": {"name": f"{this}:{task.__name__}"}}))
    return env, env.reset(jax.random.PRNGKey(0))


@pytest.mark.parametrize(
    ("task", "reason"),
    [(StaysPut, "StaysPut has no move_goal"), (DrawsMore, "DrawsMore has a move_goal for another")],
)
def test_a_task_whose_goals_cannot_be_moved_says_so_in_one_line(task, reason):
    why = move_goal_error(*state_of(task))
    assert reason in why
    assert "\n" not in why


def test_a_goal_that_the_task_fixes_cannot_be_moved(player, monkeypatch):
    monkeypatch.setattr(player, "cannot_move_goal", "it stays")
    before = player.crowd
    assert not player.move_goal(0.1, 0.1)
    assert player.crowd is before
    ticks(player, 5)


def test_dragging_the_goal_moves_no_pillar(root, monkeypatch):
    monkeypatch.syspath_prepend(str(root / "examples"))
    env = make_env(load_config(root / "examples" / "obstacle.yaml"))
    state = env.reset(jax.random.PRNGKey(0))
    assert move_goal_error(env, state) == ""
    moved = env.task.move_goal(state.goal, jnp.array([0.1, 0.2, 0.05]))
    np.testing.assert_allclose(env.task.goal_position(moved), [0.1, 0.2, 0.05])
    np.testing.assert_array_equal(moved.pillar_w, state.goal.pillar_w)


# Many robots.


@pytest.fixture(scope="module")
def four(smoke_run):
    return Player(smoke_run, seed=SEED, robots=4, agent="scripted")


def test_many_robots_drive_as_each_would_alone(four, one, first_goal):
    four.reset()
    starts = np.array(four.crowd.goal_w)
    assert len({tuple(goal) for goal in starts.tolist()}) == 4
    one.agent = "scripted"
    one.reset()
    one.move_goal(*starts[2, :2])
    ticks(one, 25)
    ticks(four, 25)
    np.testing.assert_allclose(four.crowd.qpos[2], one.snapshot.qpos, atol=1e-4)
    # The first robot's goals are those of a player of one robot.
    alone = Player(one.run_dir, seed=SEED, robots=2)
    np.testing.assert_allclose(alone.crowd.goal_w[0], first_goal, rtol=1e-6)


def test_each_robot_pauses_after_its_episode_and_resets_alone(four):
    four.reset()
    four.robot = 1
    assert four.move_goal(0.2, 0.0)
    before = four.episodes, four.successes
    while not four.snapshot.done:
        four.tick()
    assert four.outcome == "reached"
    assert (four.episodes, four.successes) == (before[0] + 1, before[1] + 1)
    end, others = np.array(four.snapshot.qpos), np.array(four.crowd.steps[[0, 2, 3]])
    ticks(four, HOLD - 1)
    np.testing.assert_array_equal(four.snapshot.qpos, end)
    four.tick()
    np.testing.assert_array_equal(position(four), 0.0)
    assert four.time == 0
    np.testing.assert_array_equal(four.crowd.steps[[0, 2, 3]], others + HOLD)
    assert (four.episodes, four.successes) == (before[0] + 1, before[1] + 1)


def test_only_the_chosen_robots_goal_moves(four):
    four.reset()
    ticks(four, 3)
    before = np.array(four.crowd.goal_w)
    four.robot = 3
    assert four.move_goal(0.4, -0.5)
    np.testing.assert_allclose(four.snapshot.goal_w, [0.4, -0.5, 0.05], rtol=1e-6)
    np.testing.assert_array_equal(four.crowd.goal_w[:3], before[:3])
    assert four.crowd.steps.tolist() == [3, 3, 3, 0]
    four.robot = 0
    np.testing.assert_array_equal(four.snapshot.goal_w, before[0])


def test_random_agents_differ_from_robot_to_robot(four):
    four.reset()
    four.agent = "random"
    ticks(four, 10)
    assert len({tuple(qpos) for qpos in four.crowd.qpos.tolist()}) == 4
    four.agent = "scripted"


def test_the_terms_of_the_reward_add_up_over_the_episode(player):
    player.agent = "scripted"
    start = player.distance
    total = 0.0
    for _ in range(20):
        player.tick()
        total += float(player.snapshot.rewards["progress"])
    assert total == pytest.approx(start - player.distance, abs=1e-4)
    assert player.snapshot.returns["progress"] == pytest.approx(total, abs=1e-5)


# Who drives.


def test_every_agent_drives_differently(player):
    start, ends = player._states, {}
    for agent in AGENTS:
        player._states, player.agent = start, agent
        player.drive(0.5, -1.0)
        ticks(player, 20)
        ends[agent] = np.array(player.snapshot.qpos)
    for first, second in itertools.combinations(AGENTS, 2):
        assert np.abs(ends[first] - ends[second]).max() > 1e-3, (first, second)
    # One program for all of them.
    assert player._fns.step._cache_size() == 1


def test_the_policy_drives_as_its_checkpoint_says(player, smoke_run):
    start, limits = player._states, player.env.config.task
    ends = []
    for env_steps in (player.checkpoints[0], player.checkpoints[-1]):
        player.switch_checkpoint(env_steps)
        assert player.checkpoint == env_steps
        player._states, player.agent = start, "policy"
        ticks(player, 30)
        ends.append(player.snapshot.qpos)
        # The same by hand: what the policy wants, asked for as a user would.
        policy = load_policy(smoke_run, env_steps)
        player._states, player.agent = start, "keyboard"
        for _ in range(30):
            twist_b = kinematics.twist_from_action(
                policy(player._states.obs[0]),
                max_speed=limits.max_speed,
                max_yaw_rate=limits.max_yaw_rate,
            )
            player.drive(*map(float, twist_b))
            player.tick()
        np.testing.assert_allclose(player.snapshot.qpos, ends[-1], atol=1e-4)
    assert np.linalg.norm(ends[0][:2] - ends[1][:2]) > 1e-3
    assert player._fns.step._cache_size() == 1


def test_a_checkpoint_that_cannot_be_used_leaves_the_one_before(player):
    before = player.checkpoint
    with pytest.raises(UserError, match="no checkpoint at 5 steps"):
        player.switch_checkpoint(5)
    assert player.checkpoint == before
    player.tick()


def test_a_user_drives_ahead_and_to_the_left(player):
    player.agent = "keyboard"
    player.move_goal(-1.0, -1.0)
    player.drive(0.5, 0.0)
    ticks(player, 60)
    x, y = position(player)
    assert x == pytest.approx(0.5, abs=0.08)
    assert abs(y) < 0.02
    player.drive(0.0, 1.0)
    ticks(player, 40)
    before = yaw(player)
    ticks(player, 60)
    assert yaw(player) - before == pytest.approx(1.0, abs=0.1)


def test_requested_values_are_clipped_to_the_limits(player):
    player.drive(7.0, -70.0)
    assert player.command == pytest.approx((1.0, -math.pi))
    player.drive(-1.0, 0.0)
    assert player.command == (0.0, 0.0)


def test_presses_add_up_and_the_first_against_a_turn_ends_it(player):
    for _ in range(3):
        player.nudge(1, 1)
    assert player.command == pytest.approx((3 / 8, 3 / 8 * math.pi))
    player.nudge(-1, -1)
    assert player.command == pytest.approx((2 / 8, 0.0))
    player.nudge(0, -1)
    assert player.command == pytest.approx((2 / 8, -math.pi / 8))


def test_an_unknown_agent_is_refused(player):
    with pytest.raises(UserError, match="'nobody' is unknown: choose from policy, scripted"):
        Player(player.run_dir, agent="nobody")


# Where the policy comes from.


def test_checkpoints_written_meanwhile_are_listed(player, smoke_run, tmp_path, monkeypatch):
    run_dir = shutil.copytree(smoke_run, tmp_path / "run")
    monkeypatch.setattr(player, "run_dir", run_dir)
    steps = checkpoint_steps(run_dir)
    assert player.checkpoints == steps
    shutil.copytree(checkpoint_path(run_dir, steps[-1]), checkpoint_path(run_dir, 999_424))
    assert player.checkpoints == [*steps, 999_424]
    # The one that drives stays in the list, even where it has gone from the disk.
    shutil.rmtree(checkpoint_path(run_dir, player.checkpoint))
    assert player.checkpoint in player.checkpoints
