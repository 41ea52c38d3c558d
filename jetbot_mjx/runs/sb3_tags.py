"""Log metrics also under the tags of Stable-Baselines3."""

from collections.abc import Mapping
from typing import NamedTuple

from jetbot_mjx.config import PPOConfig


class Alias(NamedTuple):
    """An `Alias` computes the value of another library's tag from one of our metrics."""

    metric: str
    """Name of our metric, or `env_steps`."""
    times: float = 1.0
    """Factor that the metric is multiplied by."""
    over: float | str = 1.0
    """Divisor of the metric: a number, or the name of another of our metrics."""


def aliases(ppo: PPOConfig) -> dict[str, Alias]:
    """Return aliases of our metrics under the tags of Stable-Baselines3's PPO, in its units.

    Only metrics with the same meaning have an alias. Metrics that have the same name in both need
    none.

    Args:
      ppo: the run's settings of PPO; those that are used here must not change on resume.

    Returns:
      The aliases by Stable-Baselines3's tag.

    Source: DLR-RM/stable-baselines3, stable_baselines3/ppo/ppo.py, common/on_policy_algorithm.py.
    """
    # Brax halves the squared error and computes it on scaled rewards.
    value_loss = ppo.vf_loss_coefficient * ppo.reward_scaling**2 / 2
    return {
        "rollout/ep_rew_mean": Alias("rollout/episode_return"),
        "rollout/ep_len_mean": Alias("rollout/episode_length"),
        "eval/mean_reward": Alias("eval/episode_return"),
        "train/loss": Alias("loss/total"),
        "train/policy_gradient_loss": Alias("loss/policy"),
        "train/value_loss": Alias("loss/value", over=value_loss),
        "train/entropy_loss": Alias("policy/entropy", times=-1.0),
        "train/approx_kl": Alias("policy/kl"),
        "train/std": Alias("policy/std"),
        "train/learning_rate": Alias("policy/learning_rate"),
        "train/n_updates": Alias(
            "env_steps", ppo.num_updates_per_batch, over=ppo.steps_per_training_step
        ),
        "time/iterations": Alias("env_steps", over=ppo.steps_per_training_step),
        "time/total_timesteps": Alias("env_steps"),
        "time/time_elapsed": Alias("time/wall_seconds"),
        "time/fps": Alias("env_steps", over="time/wall_seconds"),
    }


def with_aliases(
    env_steps: int, metrics: Mapping[str, float | None], names: Mapping[str, Alias]
) -> dict[str, float]:
    """Add the aliases to metrics, and leave out metrics without a value.

    Args:
      env_steps: the number of environment steps so far.
      metrics: our metrics by name.
      names: the result of `aliases`.

    Returns:
      All metrics and aliases that have a value.
    """
    known: dict[str, float] = {name: value for name, value in metrics.items() if value is not None}
    ours = {**known, "env_steps": float(env_steps)}
    for tag, (metric, times, over) in names.items():
        divisor = ours.get(over) if isinstance(over, str) else over
        if metric in ours and divisor:
            known[tag] = ours[metric] * times / divisor
    return known
