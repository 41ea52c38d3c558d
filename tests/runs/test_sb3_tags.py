"""Stable-Baselines3's names of metrics, with their units."""

from jetbot_mjx.config import PPOConfig
from jetbot_mjx.runs.sb3_tags import aliases, with_aliases

PPO = PPOConfig(
    num_envs=8,
    batch_size=5,
    num_minibatches=8,
    unroll_length=3,
    num_updates_per_batch=7,
    vf_loss_coefficient=0.5,
    reward_scaling=10.0,
)
"""A training step of it is 120 environment steps."""


def test_figures_have_the_names_and_units_of_stable_baselines3_as_well():
    # What Brax computes of these: a policy loss of 0.1, squared errors of 4 m² in the mean (400 in
    # scaled rewards) and an entropy of 1.5 nat.
    metrics = {
        "rollout/episode_return": 0.75,
        "rollout/episode_length": 64.0,
        "eval/episode_return": 0.5,
        "loss/total": 99.9,
        "loss/policy": 0.1,
        "loss/value": 0.5 * 0.5 * 400,
        "policy/entropy": 1.5,
        "policy/kl": 0.01,
        "policy/std": 0.3,
        "policy/learning_rate": 1e-3,
        "time/wall_seconds": 80.0,
    }
    found = with_aliases(1_200, metrics, aliases(PPO))
    assert {name: found.pop(name) for name in metrics} == metrics
    assert found == {
        "rollout/ep_rew_mean": 0.75,
        "rollout/ep_len_mean": 64.0,
        "eval/mean_reward": 0.5,
        "train/loss": 99.9,
        "train/policy_gradient_loss": 0.1,
        "train/value_loss": 4.0,
        "train/entropy_loss": -1.5,
        "train/approx_kl": 0.01,
        "train/std": 0.3,
        "train/learning_rate": 1e-3,
        "train/n_updates": 70.0,
        "time/iterations": 10.0,
        "time/total_timesteps": 1_200.0,
        "time/time_elapsed": 80.0,
        "time/fps": 15.0,
    }


def test_a_metric_without_a_value_has_no_alias():
    metrics = {"rollout/episode_return": None, "time/wall_seconds": 0.0}
    found = with_aliases(0, metrics, aliases(PPO))
    assert found == {
        "time/wall_seconds": 0.0,
        "train/n_updates": 0.0,
        "time/iterations": 0.0,
        "time/total_timesteps": 0.0,
        "time/time_elapsed": 0.0,
    }
