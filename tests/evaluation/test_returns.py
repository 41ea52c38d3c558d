"""The metrics of episodes of which no goal is known, and the evaluation that they come from."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jetbot_mjx.agents.networks import PolicyParams, init_normalizer, make_networks
from jetbot_mjx.config import parse_config
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.evaluation.returns import ReturnEvaluator, return_baselines, summarize_returns
from jetbot_mjx.evaluation.rollout import ReturnEpisodes
from onekernel import ProgramCache

RETURNS = np.float32([1.0, 2.0, 3.0, 6.0])


def episodes(**fields):
    zeros = np.zeros(4, np.float32)
    known = {"success": zeros, "steps": np.float32([5, 10, 5, 20]), "episode_return": RETURNS}
    rest = {"terminated": zeros, "nonfinite": np.float32([0, 1, 0, 1]), "qpos": None}
    rest["metrics"] = {}
    return ReturnEpisodes(**(known | rest | fields))


def test_mean_and_interval_are_those_of_a_normal_distribution():
    summary = summarize_returns(episodes(), has_success=False)
    half = 1.959964 * RETURNS.std(ddof=1) / 2
    assert summary.episode_return == summary.score == 3.0
    assert (summary.return_low, summary.return_high) == pytest.approx((3.0 - half, 3.0 + half))
    told = summary.episodes, summary.return_min, summary.episode_length, summary.nonfinite_envs
    assert told == (4, 1.0, 10.0, 2)
    assert (summary.success_rate, summary.success_low, summary.success_high) == (None, None, None)


def test_the_score_is_the_success_rate_where_there_is_one():
    wins = episodes(success=np.float32([1, 0, 1, 1]))
    summary = summarize_returns(wins, has_success=True)
    assert summary.score == summary.success_rate == 0.75
    assert 0.2 < summary.success_low < 0.75 < summary.success_high < 1.0


def test_one_episode_has_no_spread():
    one = episodes()._replace(
        **dict.fromkeys({*ReturnEpisodes._fields} - {"qpos", "metrics"}, np.ones(1, np.float32))
    )
    summary = summarize_returns(one, has_success=False)
    assert (summary.return_low, summary.episode_return, summary.return_high) == (1.0, 1.0, 1.0)


def test_baselines_run_whole_episodes():
    config = parse_config(
        {
            "environment": "helpers.own_environments:Measured",
            "task": {"episode_length": 6},
            "ppo": {"network": {"policy_hidden_layer_sizes": [4]}},
        }
    )
    env = make_env(config)
    networks = make_networks(config.ppo, env.observation_size, env.action_size)
    evaluator = ReturnEvaluator(env, networks, ProgramCache({}), baselines=True)
    keys = jax.random.split(jax.random.PRNGKey(0), 3)
    params = PolicyParams(
        init_normalizer(env.observation_size),
        networks.policy_network.init(keys[0]),
        networks.value_network.init(keys[0]),
    )
    found = evaluator.run(params, keys, "zero")
    # Nothing pushes the point: each of its 6 rewards is that of where it starts.
    starts = np.asarray(jax.vmap(env.reset)(keys).obs[:, 0])
    np.testing.assert_allclose(found.episode_return, 6 * (1 - starts**2), rtol=1e-5)
    np.testing.assert_array_equal(found.steps, 6)
    # The trainer's own length is not among the environment's metrics.
    assert {*found.metrics} == {"<steps>", "speed", "broken"}
    np.testing.assert_array_equal(found.metrics["<steps>"], 6)
    summary = summarize_returns(found, has_success=False)
    assert summary.metrics == {"<steps>": 6.0, "speed": 0.0, "broken": None}
    assert {*return_baselines(env)} == {"random", "zero"}
    assert jnp.all(found.success == 0)
