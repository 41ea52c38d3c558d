"""Evaluate policies in an environment of one's own, whose returns are all that is known of it.

Episodes begin with fixed keys, those of `evaluator`, so that episode i begins alike for all
policies.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jetbot_mjx.agents import Networks
from jetbot_mjx.envs import AdaptedEnv
from jetbot_mjx.evaluation.evaluator import (
    NORMAL_QUANTILE,
    CompiledRollout,
    policy_controller,
    wilson_interval,
)
from jetbot_mjx.evaluation.rollout import Controller, ReturnEpisodes, return_rollout_fn
from onekernel import ProgramCache


class ReturnSummary(NamedTuple):
    """A `ReturnSummary` holds the metrics of episodes of which no goal is known.

    The success rate and its interval are None where the environment has no metric `success`.
    """

    episodes: int
    episode_return: float
    """Mean over all episodes."""
    return_low: float
    """Lower end of the 95 % interval of this mean, as of a normal distribution."""
    return_high: float
    """Upper end of the interval."""
    return_min: float
    """Smallest return of all episodes."""
    episode_length: float
    """Mean number of environment steps until the end."""
    nonfinite_envs: int
    metrics: Mapping[str, float | None]
    """Sum over an episode of each of the environment's own metrics, mean over all episodes; None:
    it is not finite."""
    success_rate: float | None = None
    success_low: float | None = None
    """Lower end of the 95 % Wilson interval."""
    success_high: float | None = None
    """Upper end of the interval."""

    @property
    def score(self) -> float:
        """Return the number by which the best checkpoint of a training is found."""
        return self.episode_return if self.success_rate is None else self.success_rate


def summarize_returns(episodes: ReturnEpisodes, *, has_success: bool) -> ReturnSummary:
    """Compute the metrics of a set of episodes.

    Args:
      episodes: the episodes of one controller.
      has_success: whether the environment tells successes.
    """
    host = jax.device_get(episodes._replace(qpos=None))
    returns = host.episode_return.astype(np.float64)
    count, mean = returns.size, float(returns.mean())
    spread = NORMAL_QUANTILE * float(returns.std(ddof=1)) / math.sqrt(count) if count > 1 else 0.0
    sums = {name: float(x.mean(dtype=np.float64)) for name, x in host.metrics.items()}
    success: dict[str, float] = {}
    if has_success:
        wins = int((host.success > 0).sum())
        low, high = wilson_interval(wins, count)
        success = {"success_rate": wins / count, "success_low": low, "success_high": high}
    return ReturnSummary(
        episodes=count,
        episode_return=mean,
        return_low=mean - spread,
        return_high=mean + spread,
        return_min=float(returns.min()),
        episode_length=float(host.steps.mean()),
        nonfinite_envs=int(host.nonfinite.sum()),
        metrics={name: mean if math.isfinite(mean) else None for name, mean in sums.items()},
        **success,
    )


class ReturnEvaluator(CompiledRollout[ReturnEpisodes]):
    """A `ReturnEvaluator` evaluates policies in an environment of one's own, and baselines."""

    def __init__(
        self,
        env: AdaptedEnv,
        networks: Networks,
        programs: ProgramCache,
        *,
        baselines: bool = False,
        record: bool = False,
    ) -> None:
        """Prepare the program, which compiles at its first use.

        Args:
          env: the environment, unwrapped.
          networks: the networks of the policies to evaluate.
          programs: the cache of compiled programs for the environment's configuration.
          baselines: whether `run` can also run the controllers of `return_baselines`.
          record: whether to record trajectories, of an environment with an `mj_model`.
        """
        controllers = {"policy": policy_controller(networks)}
        if baselines:
            controllers |= return_baselines(env)
        length = env.config.task.episode_length
        super().__init__(
            return_rollout_fn(env, [*controllers.values()], length, record=record),
            [*controllers],
            programs,
            ", recorded" if record else "",
        )


def return_baselines(env: AdaptedEnv) -> Mapping[str, Controller]:
    """Return controllers to compare a return with: uniform noise, and the zero action."""
    shape = (env.action_size,)
    return {
        "random": lambda params, state, key: jax.random.uniform(key, shape, minval=-1.0),
        "zero": lambda params, state, key: jnp.zeros(shape),
    }
