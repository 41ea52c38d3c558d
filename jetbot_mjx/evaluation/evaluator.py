"""The one protocol by which a policy is judged: fixed goals, baselines, honest intervals.

Goals come from the task's own sampler under fixed keys, one key an episode, so that episode
i has the same goal however many are run. Two sets that share no key: one for the evaluations
during training, by which the best checkpoint is chosen, and one for the report.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from brax.training.agents.ppo import networks as ppo_networks
from jaxtyping import Array, Float, UInt32

from jetbot_mjx.agents.networks import PolicyParams, make_policy
from jetbot_mjx.compiler.program_cache import Programs
from jetbot_mjx.envs import kinematics
from jetbot_mjx.envs.domain_randomization import VariedEnv
from jetbot_mjx.envs.jetbot_env import JetBotEnv
from jetbot_mjx.envs.program_key import programs_of
from jetbot_mjx.envs.state import State, robot_state
from jetbot_mjx.evaluation.rollout import Controller, Episodes, rollout_fn

GOAL_SET_VERSION = 1
"""Raised whenever the goals or the rules of the report change."""

REPORT_GOALS = 1024
"""How many of its fixed goals a report takes, unless told otherwise."""

MOST_GOALS = 1_048_576
"""As many can be asked for."""

_REPORT_SEED = 20_251
_TRAINING_SEED = 20_252


def report_keys(episodes: int) -> UInt32[Array, "n 2"]:
    """Reset keys of the report's fixed goal set."""
    return _fixed_keys(_REPORT_SEED, episodes)


def training_keys(episodes: int) -> UInt32[Array, "n 2"]:
    """Reset keys of the evaluations during training, none of them in `report_keys`."""
    return _fixed_keys(_TRAINING_SEED, episodes)


def _fixed_keys(seed: int, episodes: int) -> UInt32[Array, "n 2"]:
    key = jax.random.PRNGKey(seed)
    return jax.vmap(jax.random.fold_in, in_axes=(None, 0))(key, jnp.arange(episodes))


class Summary(NamedTuple):
    """The figures of a set of episodes. Times and paths are those of the successes."""

    episodes: int
    successes: int
    success_rate: float
    success_low: float
    """Lower end of the 95 % Wilson interval."""
    success_high: float
    """Upper end of it."""
    time_to_goal_median: float | None
    """[s]; None without a success, like the next two."""
    time_to_goal_p95: float | None
    """[s]"""
    path_efficiency: float | None
    """Mean of straight line over way travelled, at most 1."""
    episode_return: float
    """Mean over all episodes; it ends near the mean distance covered, whoever drives well."""
    final_distance_median: float
    """[m] on the floor, over all episodes."""
    nonfinite_worlds: int


def summarize(episodes: Episodes, ctrl_dt: float) -> Summary:
    """Reduces episodes to the figures of a report.

    Args:
      episodes: of one controller.
      ctrl_dt: duration of one environment step [s].

    Returns:
      The figures.
    """
    host = jax.device_get(episodes._replace(qpos=None, goal=None))
    won = host.success > 0
    count, wins = won.size, int(won.sum())
    low, high = wilson_interval(wins, count)
    seconds = host.steps[won] * ctrl_dt
    return Summary(
        episodes=count,
        successes=wins,
        success_rate=wins / count,
        success_low=low,
        success_high=high,
        time_to_goal_median=float(np.median(seconds)) if wins else None,
        time_to_goal_p95=float(np.percentile(seconds, 95)) if wins else None,
        path_efficiency=float(path_efficiencies(host)[won].mean()) if wins else None,
        episode_return=float(host.episode_return.mean()),
        final_distance_median=float(np.median(final_distances(host))),
        nonfinite_worlds=int(host.nonfinite.sum()),
    )


def path_efficiencies(episodes: Episodes) -> Float[np.ndarray, " n"]:
    """Straight line from start to end over the way travelled, at most 1.

    Args:
      episodes: on the host.
    """
    straight = np.linalg.norm(episodes.end_w - episodes.start_w, axis=-1)
    return np.minimum(straight / np.maximum(episodes.path_length, 1e-9), 1.0)


def final_distances(episodes: Episodes) -> Float[np.ndarray, " n"]:
    """From where the robots ended to their goals, on the floor [m].

    Args:
      episodes: on the host.
    """
    return np.linalg.norm(episodes.goal_w[:, :2] - episodes.end_w, axis=-1)


def wilson_interval(successes: int, trials: int, z: float = 1.959964) -> tuple[float, float]:
    """Wilson's score interval of a proportion.

        (p̂ + z²/2n ± z √(p̂(1-p̂)/n + z²/4n²)) / (1 + z²/n)

    Args:
      successes: how many.
      trials: out of how many, at least 1.
      z: quantile of the normal distribution; the default gives 95 %.

    Returns:
      Lower and upper end, within [0, 1].

    Source: E. B. Wilson, JASA 22 (1927), 209-212, doi:10.1080/01621459.1927.10502953.
    """
    p, n = successes / trials, trials
    centre = p + z * z / (2 * n)
    spread = z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    scale = 1 + z * z / n
    return max(0.0, (centre - spread) / scale), min(1.0, (centre + spread) / scale)


def policy_controller(networks: ppo_networks.PPONetworks) -> Controller:
    """The controller that acts as a policy does, without exploring.

    Args:
      networks: of the policy; its parameters are the controller's.

    Returns:
      The controller.
    """

    def act(params: PolicyParams, state: State, key: UInt32[Array, "2"]) -> Float[Array, "2"]:
        del key
        return make_policy(networks, params)(state.obs)

    return act


class Evaluator:
    """Judges policies, and baselines beside them, in one compiled program."""

    def __init__(
        self,
        env: JetBotEnv | VariedEnv,
        networks: ppo_networks.PPONetworks,
        *,
        baselines: bool = False,
        record: bool = False,
        programs: Programs | None = None,
    ) -> None:
        """Prepares the program; it compiles at its first use.

        Args:
          env: one environment, unwrapped, or one whose robots differ.
          networks: of the policies to judge.
          baselines: whether `run_baselines` will be wanted.
          record: whether to keep trajectories.
          programs: of the environment's configuration; None: they are not kept.
        """
        self._env = env
        self._names = ["policy", *(BASELINES if baselines else ())]
        controllers = [policy_controller(networks)]
        if baselines:
            controllers += [make(env) for make in BASELINES.values()]
        length = env.config.task.episode_length
        self._run = jax.jit(rollout_fn(env, controllers, length, record=record))
        drawn = ", drawn" if isinstance(env, VariedEnv) else ""
        self._name = f"episodes of {self._names}{', recorded' if record else ''}{drawn}"
        self._programs = programs or programs_of(env.config, keep=False)
        self._compiled: dict[int, jax.stages.Compiled] = {}

    def run(self, params: PolicyParams, keys: UInt32[Array, "n 2"]) -> Episodes:
        """Deterministic episodes of a policy.

        Args:
          params: the policy's.
          keys: one reset key an episode.

        Returns:
          The episodes.
        """
        return self._episodes(0, params, keys)

    def run_baselines(
        self, params: PolicyParams, keys: UInt32[Array, "n 2"]
    ) -> dict[str, Episodes]:
        """The same episodes under each baseline.

        Args:
          params: of any policy; the program takes them, the baselines do not use them.
          keys: one reset key an episode.

        Returns:
          The episodes by the baseline's name.
        """
        return {
            name: self._episodes(index, params, keys)
            for index, name in enumerate(self._names)
            if index > 0
        }

    def _episodes(self, index: int, params: PolicyParams, keys: UInt32[Array, "n 2"]) -> Episodes:
        # On the host: parameters straight from a trainer carry its sharding, and what is compiled
        # takes one alone.
        arguments = np.int32(index), jax.device_get(params), np.asarray(keys)
        count = len(keys)
        if count not in self._compiled:
            self._compiled[count] = self._programs.compile(
                f"{count} {self._name}", lambda: self._run.trace(*arguments)
            )
        return self._compiled[count](*arguments)


def _random(env: JetBotEnv | VariedEnv) -> Controller:
    def act(params: Any, state: State, key: UInt32[Array, "2"]) -> Float[Array, "2"]:
        del params, state
        return jax.random.uniform(key, (env.action_size,), minval=-1.0, maxval=1.0)

    return act


def _constant(env: JetBotEnv | VariedEnv) -> Controller:
    """The middle of the action range: half speed straight ahead."""

    def act(params: Any, state: State, key: UInt32[Array, "2"]) -> Float[Array, "2"]:
        del params, state, key
        return jnp.zeros(env.action_size)

    return act


def _turn_then_go(env: JetBotEnv | VariedEnv) -> Controller:
    """Turns until the goal lies ahead, and drives the faster the better it is aligned."""
    steering = 4.0  # [1/s] yaw rate per heading error
    damping = 0.3  # yaw rate taken back per yaw rate: the motors lag, and it would swing
    cone = 0.6  # [rad] heading error within which it drives

    def act(params: Any, state: State, key: UInt32[Array, "2"]) -> Float[Array, "2"]:
        del params, key
        robot = robot_state(state.pipeline_state)
        offset_w = env.task.goal_position(state.goal)[:2] - robot.position_w[:2]
        goal_b = kinematics.to_body(kinematics.yaw(robot.quat), offset_w)
        error = jnp.arctan2(goal_b[1], goal_b[0])
        aligned = (jnp.cos(error) - math.cos(cone)) / (1.0 - math.cos(cone))
        speed = env.config.task.max_speed * jnp.maximum(aligned, 0.0)
        yaw_rate = steering * error - damping * robot.angular_velocity_w[2]
        return kinematics.action_from_twist(
            jnp.stack([speed, yaw_rate]),
            max_speed=env.config.task.max_speed,
            max_yaw_rate=env.config.task.max_yaw_rate,
        )

    return act


BASELINES = {"scripted": _turn_then_go, "random": _random, "constant": _constant}
"""Controllers to read a success rate against: turn-then-go, uniform noise, straight ahead."""
