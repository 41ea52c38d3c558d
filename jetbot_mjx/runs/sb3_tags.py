"""Our figures under the names that people bring along: those of Stable-Baselines3."""

from collections.abc import Mapping
from typing import NamedTuple

from jetbot_mjx.config import PPOConfig


class Alias(NamedTuple):
    """One of our figures under another's name."""

    figure: str
    """Ours; or `env_steps`."""
    times: float = 1.0
    """What it is multiplied by,"""
    over: float | str = 1.0
    """and divided by: a number, or another of our figures."""


def aliases(ppo: PPOConfig) -> dict[str, Alias]:
    """Our figures by the names that Stable-Baselines3's PPO gives them, in its units.

    Only what means the same is here. Figures that both call alike need no alias.

    Args:
      ppo: of the run; nothing of it that is used here may change when a run goes on.

    Returns:
      By Stable-Baselines3's tag.

    Source: DLR-RM/stable-baselines3, stable_baselines3/ppo/ppo.py, common/on_policy_algorithm.py.
    """
    # Brax halves the squared error, and sees scaled rewards.
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
    env_steps: int, figures: Mapping[str, float | None], names: Mapping[str, Alias]
) -> dict[str, float]:
    """Adds what is known under other names, and leaves out what there is not.

    Args:
      env_steps: at that moment.
      figures: ours.
      names: from `aliases`.

    Returns:
      All figures that have a value.
    """
    known: dict[str, float] = {name: value for name, value in figures.items() if value is not None}
    ours = {**known, "env_steps": float(env_steps)}
    for tag, (figure, times, over) in names.items():
        divisor = ours.get(over) if isinstance(over, str) else over
        if figure in ours and divisor:
            known[tag] = ours[figure] * times / divisor
    return known
