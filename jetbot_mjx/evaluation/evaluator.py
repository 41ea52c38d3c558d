"""Evaluate policies and baselines on fixed goals and compute metrics with confidence intervals.

Goals come from the task's own sampler under fixed keys, with one key for each episode, so that
episode i has the same goal however many episodes are run. There are two sets that share no key: one
for the evaluations during training, by which the best checkpoint is chosen, and one for the report.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Generic, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree, UInt32

from jetbot_mjx import envs
from jetbot_mjx.agents import Networks, PolicyParams, kernel_key, make_policy, raw_key
from jetbot_mjx.envs import DomainRandomizationWrapper, JetBotEnv, State
from jetbot_mjx.errors import check_count
from jetbot_mjx.evaluation.goal_set import MOST_GOALS
from jetbot_mjx.evaluation.rollout import Controller, Episodes, rollout_fn
from jetbot_mjx.runs import JsonObject
from jetbot_mjx.terminal import stage
from onekernel import ProgramCache

NORMAL_QUANTILE = 1.959963984540054
"""Quantile of the normal distribution at 97.5 %."""

_Results = TypeVar("_Results")

_REPORT_SEED = 20_251
_TRAINING_SEED = 20_252


def report_keys(episodes: int) -> UInt32[Array, "n 2"]:
    """Return the reset keys of the report's fixed goal set.

    Raises:
      InvalidError: `episodes` is not a number from 1 to `MOST_GOALS`.
    """
    check_count("episodes", episodes, MOST_GOALS)
    return _fixed_keys(_REPORT_SEED, episodes)


def training_keys(episodes: int) -> UInt32[Array, "n 2"]:
    """Return the reset keys of evaluations during training; `report_keys` has none of them."""
    return _fixed_keys(_TRAINING_SEED, episodes)


def _fixed_keys(seed: int, episodes: int) -> UInt32[Array, "n 2"]:
    key = kernel_key(jax.random.PRNGKey(seed))
    return raw_key(jax.vmap(jax.random.fold_in, in_axes=(None, 0))(key, jnp.arange(episodes)))


class Summary(NamedTuple):
    """A `Summary` holds the metrics of a set of episodes.

    Times and path efficiencies are computed over the successes only.
    """

    episodes: int
    successes: int
    success_rate: float
    success_low: float
    """Lower end of the 95 % Wilson interval."""
    success_high: float
    """Upper end of the interval."""
    time_to_goal_median: float | None
    """[s] Median over the successes; None without a success, like the next two fields."""
    time_to_goal_p95: float | None
    """[s] 95th percentile over the successes."""
    path_efficiency: float | None
    """Mean ratio of straight-line distance to distance travelled, at most 1."""
    episode_return: float
    """Mean over all episodes, close to the mean distance covered for every good policy."""
    final_distance_median: float
    """[m] Median over all episodes of the distance to the goal at the end, on the floor."""
    nonfinite_envs: int

    @property
    def score(self) -> float:
        """Return the number by which the best checkpoint of a training is found."""
        return self.success_rate


def summarize(episodes: Episodes, ctrl_dt: float) -> Summary:
    """Compute the metrics of a set of episodes.

    Args:
      episodes: the episodes of one controller.
      ctrl_dt: duration of one environment step [s].

    Returns:
      The metrics.
    """
    host = jax.device_get(episodes._replace(qpos=None, goal=None))
    won = host.success > 0
    seconds = host.steps * ctrl_dt
    return Summary(
        **success_and_time(won, seconds),
        time_to_goal_p95=float(np.percentile(seconds[won], 95)) if won.any() else None,
        path_efficiency=float(path_efficiencies(host)[won].mean()) if won.any() else None,
        episode_return=float(host.episode_return.mean()),
        final_distance_median=float(np.median(final_distances(host))),
        nonfinite_envs=int(host.nonfinite.sum()),
    )


def success_and_time(won: Bool[np.ndarray, " n"], seconds: Float[np.ndarray, " n"]) -> JsonObject:
    """Compute the fields that a `Summary` shares with the results in a range of goals.

    Args:
      won: whether each episode succeeded.
      seconds: the duration of each episode [s].

    Returns:
      The fields by name; None where there is no episode, or no success.
    """
    count, wins = won.size, int(won.sum())
    low, high = wilson_interval(wins, count) if count else (None, None)
    return {
        "episodes": count,
        "successes": wins,
        "success_rate": wins / count if count else None,
        "success_low": low,
        "success_high": high,
        "time_to_goal_median": float(np.median(seconds[won])) if wins else None,
    }


def json_values(values: Mapping[str, object]) -> JsonObject:
    """Return values in which named tuples are dictionaries and tuples are lists, at any depth."""
    return {name: _json_value(value) for name, value in values.items()}


def _json_value(value: object) -> object:
    if (as_dict := getattr(value, "_asdict", None)) is not None:
        value = as_dict()
    if isinstance(value, Mapping):
        return json_values(value)
    return [_json_value(one) for one in value] if isinstance(value, tuple | list) else value


def path_efficiencies(episodes: Episodes) -> Float[np.ndarray, " n"]:
    """Compute the ratio of straight-line distance to distance travelled, at most 1.

    Args:
      episodes: episodes on the host.
    """
    straight = np.linalg.norm(episodes.end_w - episodes.start_w, axis=-1)
    return np.minimum(straight / np.maximum(episodes.path_length, 1e-9), 1.0)


def final_distances(episodes: Episodes) -> Float[np.ndarray, " n"]:
    """Compute the distance on the floor from each robot's final position to its goal [m].

    Args:
      episodes: episodes on the host.
    """
    return np.linalg.norm(episodes.goal_w[:, :2] - episodes.end_w, axis=-1)


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Compute Wilson's score interval of a proportion, at 95 %.

        (p̂ + z²/2n ± z √(p̂(1-p̂)/n + z²/4n²)) / (1 + z²/n)

    It is that of `scipy.stats.binomtest`, which every training would take half a second to import.

    Args:
      successes: number of successes.
      trials: number of trials, at least 1.

    Returns:
      The lower and the upper end, within [0, 1].

    Source: E. B. Wilson, JASA 22 (1927), 209-212, doi:10.1080/01621459.1927.10502953.
    """
    p, n, z = successes / trials, trials, NORMAL_QUANTILE
    centre = p + z * z / (2 * n)
    spread = z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    scale = 1 + z * z / n
    # At the ends the sum is exactly 0 or 1, but for rounding.
    low = (centre - spread) / scale if successes > 0 else 0.0
    high = (centre + spread) / scale if successes < trials else 1.0
    return low, high


def policy_controller(networks: Networks) -> Controller:
    """Return a controller that applies a policy deterministically.

    Args:
      networks: the networks of the policy, whose parameters are the controller's parameters.

    Returns:
      The controller.
    """
    return lambda params, state, key: make_policy(networks, params)(state.obs)


class CompiledRollout(Generic[_Results]):
    """A `CompiledRollout` runs episodes under one of several controllers, by one program."""

    def __init__(
        self,
        run: Callable[..., _Results],
        controllers: Sequence[str],
        programs: ProgramCache,
        label: str = "",
        where: str = "",
    ) -> None:
        """Prepare the program, which compiles at its first use.

        Args:
          run: a function of the index of a controller, its parameters and the reset keys.
          controllers: the names of the controllers.
          programs: the cache of compiled programs for the environment's configuration.
          label: what tells the program from others of these controllers.
          where: what progress says about where they run, such as ` in C MuJoCo`.
        """
        self._run, self._names = jax.jit(run), list(controllers)
        self._name, self._where = f"episodes of {self._names}{label}", where
        self._programs = programs
        self._compiling: dict[int, Callable[[], jax.stages.Compiled]] = {}
        self._compiled: dict[int, jax.stages.Compiled] = {}

    def prepare(self, params: PolicyParams, episodes: int) -> None:
        """Begin to compile the program in a thread, which `run` waits for.

        Args:
          params: parameters of a policy.
          episodes: the number of episodes that will run at once.
        """
        if episodes in self._compiling or episodes in self._compiled:
            return
        like = jax.ShapeDtypeStruct((episodes, 2), np.uint32)
        arguments = np.int32(0), jax.device_get(params), like
        self._compiling[episodes] = self._programs.compile_later(
            f"{episodes} {self._name}", lambda: self._run.trace(*arguments)
        )

    def run(
        self, params: PolicyParams, keys: UInt32[Array, "n 2"], controller: str = "policy"
    ) -> _Results:
        """Run deterministic episodes of a policy, or episodes of a baseline.

        Args:
          params: parameters of the policy, or of any policy for a baseline.
          keys: one reset key for each episode.
          controller: `policy`, or the name of a baseline.

        Returns:
          The episodes.
        """
        # Move the parameters to the host: those from a trainer carry its sharding, and a compiled
        # program accepts only the sharding that it was compiled for.
        index = self._names.index(controller)
        arguments = np.int32(index), jax.device_get(params), np.asarray(keys)
        count = len(keys)
        if count not in self._compiled:
            with stage(f"compiling the episodes{self._where}"):
                self.prepare(params, count)
                self._compiled[count] = self._compiling.pop(count)()
        # One program drives them all, so that none can be counted.
        with stage(f"{count:,} episodes{self._where}, {controller}"):
            return jax.block_until_ready(self._compiled[count](*arguments))


class Evaluator(CompiledRollout[Episodes]):
    """An `Evaluator` evaluates policies of a robot, and optionally baselines."""

    def __init__(
        self,
        env: JetBotEnv | DomainRandomizationWrapper,
        networks: Networks,
        programs: ProgramCache,
        *,
        baselines: bool = False,
        record: bool = False,
        where: str = "",
    ) -> None:
        """Prepare the program, which compiles at its first use.

        Args:
          env: one unwrapped environment, or one with domain randomization.
          networks: the networks of the policies to evaluate.
          programs: the cache of compiled programs for the environment's configuration.
          baselines: whether `run` can also run the controllers of `BASELINES`.
          record: whether to record trajectories.
          where: as for `CompiledRollout`.
        """
        controllers = {"policy": policy_controller(networks)}
        if baselines:
            controllers |= {name: make(env) for name, make in BASELINES.items()}
        length = env.config.task.episode_length
        drawn = isinstance(env, DomainRandomizationWrapper)
        super().__init__(
            rollout_fn(env, [*controllers.values()], length, record=record),
            [*controllers],
            programs,
            f"{', recorded' if record else ''}{', drawn' if drawn else ''}",
            f"{where}{' on drawn robots' if drawn else ''}",
        )


def _random(env: JetBotEnv | DomainRandomizationWrapper) -> Controller:
    shape = (env.action_size,)
    return lambda params, state, key: jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)


def _constant(env: JetBotEnv | DomainRandomizationWrapper) -> Controller:
    """Return a controller that holds the middle of the action range: half speed straight ahead."""
    return lambda params, state, key: jnp.zeros(env.action_size)


def _turn_then_go(env: JetBotEnv | DomainRandomizationWrapper) -> Controller:
    """Return a controller that turns towards the goal and drives faster the better it is aligned.

    It turns in place until the goal lies ahead.
    """
    steering = 4.0  # [1/s] yaw rate per heading error
    damping = 0.3  # reduction of the yaw rate per yaw rate, against oscillation by motor lag
    cone = 0.6  # [rad] heading error within which it drives

    def act(params: PyTree, state: State, key: UInt32[Array, "2"]) -> Float[Array, " action"]:
        robot = envs.robot_state(state.pipeline_state)
        offset_w = env.task.goal_position(state.goal)[:2] - robot.position_w[:2]
        goal_b = envs.to_body(envs.yaw(robot.quat), offset_w)
        error = jnp.arctan2(goal_b[1], goal_b[0])
        aligned = (jnp.cos(error) - math.cos(cone)) / (1.0 - math.cos(cone))
        speed = env.config.task.max_speed * jnp.maximum(aligned, 0.0)
        yaw_rate = steering * error - damping * robot.angular_velocity_w[2]
        return env.action_of_twist(jnp.stack([speed, yaw_rate]))

    return act


BASELINES = {"scripted": _turn_then_go, "random": _random, "constant": _constant}
"""Baselines to compare a success rate with: turn-then-go, uniform noise, straight ahead."""
