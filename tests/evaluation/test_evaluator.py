"""The evaluation of a policy on fixed goals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from helpers.further import slow_fixture
from helpers.gliding import Gliding
from jetbot_mjx.config import parse_config
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.evaluation.evaluator import (
    BASELINES,
    Evaluator,
    report_keys,
    summarize,
    training_keys,
    wilson_interval,
)
from jetbot_mjx.evaluation.rollout import Episodes, rollout_fn

EPISODES = 32


@pytest.mark.parametrize(("wins", "count"), [(0, 20), (1, 20), (10, 20), (20, 20), (1013, 1024)])
def test_the_interval_is_wilsons(wins, count):
    expected = stats.binomtest(wins, count).proportion_ci(0.95, method="wilson")
    np.testing.assert_allclose(wilson_interval(wins, count), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("truth", [0.5, 0.9, 0.99])
@pytest.mark.parametrize("count", [64, 256, 1024])
def test_the_interval_covers_the_truth(truth, count):
    wins = np.random.default_rng(0).binomial(count, truth, 1000)
    intervals = np.array([wilson_interval(int(one), count) for one in wins])
    covered = np.mean((intervals[:, 0] <= truth) & (truth <= intervals[:, 1]))
    assert covered >= 0.93


def test_the_figures_by_hand():
    episodes = Episodes(
        success=jnp.array([1.0, 1.0, 0.0, 0.0]),
        steps=jnp.array([60.0, 120.0, 256.0, 7.0]),
        episode_return=jnp.array([0.9, 0.5, -0.4, 0.0]),
        terminated=jnp.array([1.0, 1.0, 0.0, 0.0]),
        nonfinite=jnp.array([0.0, 0.0, 0.0, 1.0]),
        path_length=jnp.array([1.0, 1.0, 3.0, 0.0]),
        start_w=jnp.zeros((4, 2)),
        start_yaw=jnp.zeros(4),
        end_w=jnp.array([[0.9, 0.0], [0.3, 0.4], [1.0, 0.0], [0.0, 0.0]]),
        goal_w=jnp.array([[1.0, 0, 0.05], [0.3, 0.5, 0.05], [0, 0, 0.05], [0.5, 0, 0.05]]),
        goal=None,
        qpos=None,
    )
    got = summarize(episodes, 1 / 60)
    assert (got.episodes, got.successes, got.success_rate) == (4, 2, 0.5)
    assert got.time_to_goal_median == pytest.approx(1.5)
    assert got.time_to_goal_p95 == pytest.approx(1.95)
    assert got.path_efficiency == pytest.approx((0.9 + 0.5) / 2)
    assert got.episode_return == pytest.approx(0.25)
    assert got.final_distance_median == pytest.approx(0.3)  # of 0.1, 0.1, 1.0, 0.5
    assert got.nonfinite_envs == 1


def test_without_a_success_there_is_no_time_to_goal():
    zeros = dict.fromkeys(Episodes._fields, jnp.zeros(3))
    places = {"start_w": jnp.zeros((3, 2)), "end_w": jnp.zeros((3, 2)), "goal_w": jnp.zeros((3, 3))}
    got = summarize(Episodes(**{**zeros, **places, "goal": None, "qpos": None}), 1 / 60)
    assert (got.time_to_goal_median, got.time_to_goal_p95, got.path_efficiency) == (None,) * 3


def test_the_goal_sets_are_fixed_and_share_no_key():
    keys = report_keys(64)
    np.testing.assert_array_equal(keys, report_keys(64))
    np.testing.assert_array_equal(keys[:10], report_keys(10))
    both = np.concatenate([keys, training_keys(64)])
    assert len(np.unique(both, axis=0)) == 128


def test_the_reports_goals_are_those_of_version_1(world_env):
    # Other numbers here mean other goals: raise GOAL_SET_VERSION with them.
    goals = jax.vmap(world_env.reset)(report_keys(1024)).goal
    expected = [[-0.9417, 0.1728], [0.4117, 0.9321], [-0.7720, -0.8731]]
    np.testing.assert_allclose(goals[:3, :2], expected, atol=1e-3)
    np.testing.assert_allclose(np.asarray(goals[:, :2]).mean(axis=0), [0.0039, -0.0186], atol=1e-3)


def test_no_key_of_a_controller_is_one_that_a_reset_draws_from():
    told = set()

    def act(params, state, key):
        del params, state
        jax.debug.callback(lambda key: told.add(tuple(key.tolist())), key)
        return jnp.zeros(2)

    keys, steps = report_keys(2), 3
    jax.block_until_ready(rollout_fn(Gliding(parse_config({})), [act], steps)(0, None, keys))
    jax.effects_barrier()
    assert len(told) == 2 * steps
    # The episode's own, the goal's, and those of the episodes that would follow.
    drawn = {tuple(key.tolist()) for one in keys for key in (one, *jax.random.split(one, 8))}
    assert not told & drawn


@slow_fixture(scope="module", params=["isaac", "real"])
def driven(request):
    env = make_env(parse_config({"robot": {"preset": request.param}}))
    controllers = [make(env) for make in BASELINES.values()]
    rollout = jax.jit(rollout_fn(env, controllers, 256, record=True))
    keys = report_keys(EPISODES)
    runs = {name: jax.device_get(rollout(i, None, keys)) for i, name in enumerate(BASELINES)}
    return env, rollout, runs


def test_the_scripted_baseline_reaches_every_goal(driven):
    env, _, runs = driven
    assert summarize(runs["scripted"], env.dt).success_rate == 1.0


@pytest.mark.parametrize("name", ["random", "constant"])
def test_the_blind_baselines_hardly_ever_do(driven, name):
    env, _, runs = driven
    assert summarize(runs[name], env.dt).success_rate < 0.25


def test_a_rollout_repeats_itself(driven):
    _, rollout, runs = driven
    again = jax.device_get(rollout(list(BASELINES).index("random"), None, report_keys(EPISODES)))
    jax.tree.map(np.testing.assert_array_equal, again, runs["random"])


def test_an_episode_ends_at_its_success_and_the_robot_stands_still(driven):
    _, _, runs = driven
    episodes = runs["scripted"]
    assert episodes.qpos.shape == (EPISODES, 257, 9)
    for i in range(EPISODES):
        end = int(episodes.steps[i])
        xyz = episodes.qpos[i, :, :3]
        distance = np.linalg.norm(xyz - episodes.goal_w[i], axis=-1)
        assert distance[end] < 0.1 <= distance[end - 1]
        assert np.all(episodes.qpos[i, end:] == episodes.qpos[i, end])
        walked = np.linalg.norm(np.diff(xyz[: end + 1, :2], axis=0), axis=-1).sum()
        np.testing.assert_allclose(episodes.path_length[i], walked, rtol=1e-4)
        covered = distance[0] - distance[end]
        np.testing.assert_allclose(episodes.episode_return[i], covered, atol=1e-4)
    np.testing.assert_array_equal(episodes.terminated, 1)
    np.testing.assert_array_equal(episodes.start_yaw, 0)


def test_constant_actions_drive_straight_ahead_until_time_is_up(driven):
    _, _, runs = driven
    episodes = runs["constant"]
    missed = episodes.success == 0
    np.testing.assert_array_equal(episodes.steps[missed], 256)
    np.testing.assert_array_equal(episodes.terminated, ~missed)
    assert np.all(np.abs(episodes.end_w[missed, 1]) < 0.02)


def test_a_compilation_that_failed_is_tried_again():
    tries = []

    class Programs:
        """A cache whose first compilation fails."""

        def compile_later(self, name, trace):
            tries.append(name)

            def program():
                if len(tries) == 1:
                    raise RuntimeError("no memory")
                return lambda *arguments: arguments[2]

            return program

    env = make_env(parse_config({}))
    evaluator = Evaluator(env, networks=None, programs=Programs())
    keys = report_keys(4)
    evaluator.prepare({}, 4)
    with pytest.raises(RuntimeError, match="no memory"):
        evaluator.run({}, keys)
    for _ in range(2):
        np.testing.assert_array_equal(evaluator.run({}, keys), keys)
    evaluator.prepare({}, 4)
    assert tries == ["4 episodes of ['policy']"] * 2
