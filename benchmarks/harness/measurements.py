"""Measure six rates, each of a program of its own.

`benchmarks/steps_per_second.py` is the command; this module neither prints nor parses.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from brax.training import acting
from brax.training.agents.ppo import networks as ppo_networks
from jaxtyping import Array, PyTree

from benchmarks.harness.timing import (
    Carry,
    Row,
    Tally,
    TimedProgram,
    add_tallies,
    env_keys,
    make_row,
    random_actions,
    sum_per_env,
)
from jetbot_mjx.agents.networks import init_normalizer, make_networks
from jetbot_mjx.config import Config, parse_config
from jetbot_mjx.envs.jetbot_env import JetBotEnv, make_jetbot_env
from jetbot_mjx.envs.wrappers import wrap_for_training
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs import Setup
from jetbot_mjx.runs.metrics import CompileClock
from jetbot_mjx.training import brax_trainer, ppo_trainer
from jetbot_mjx.training.callbacks import Progress, TrainerCallback
from jetbot_mjx.training.preemption import Preemption

_LONGEST_HOLD = 24  # environment steps
WARM_UP_INTERVALS = 2  # the first compiles; the second compiles what runs between intervals


class Sizes(NamedTuple):
    """`Sizes` holds how much is measured."""

    repeats: int = 5
    unroll: int = 64
    """Environment steps in one compiled call."""
    training_steps: int = 16
    """Training steps in one repeat of `training`."""


def _measure(timed: TimedProgram, sizes: Sizes) -> Row:
    return timed.row([timed.repeat() for _ in range(sizes.repeats)])


def _measure_physics(timed: TimedProgram, sizes: Sizes) -> Row:
    # Without a wrapper no episode ends and no state is reset, so nothing is counted.
    return _measure(timed, sizes)._replace(episodes_per_env_step=None, nonfinite_envs=None)


def prepare_physics(config: Config, num_envs: int, sizes: Sizes) -> TimedProgram:
    """Compile the physics alone, under random actions in every step."""
    env = make_jetbot_env(config)

    def step(carry: Carry) -> Carry:
        key, actions = random_actions(carry.key, num_envs)
        physics = jax.vmap(env.physics.step)(carry.state, jax.vmap(env.wheel_targets)(actions))
        checksum = carry.tally.checksum + sum_per_env(physics)
        return Carry(physics, key, carry.tally._replace(checksum=checksum))

    first = jax.jit(jax.vmap(env.reset))(env_keys(num_envs)).pipeline_state
    n_substeps = config.physics.n_substeps
    return TimedProgram("physics", step, first, n_substeps=n_substeps, calls=sizes.unroll)


def measure_physics(config: Config, num_envs: int, sizes: Sizes) -> Row:
    """Time the physics alone under random actions."""
    return _measure_physics(prepare_physics(config, num_envs, sizes), sizes)


def measure_switched(config: Config, num_envs: int, sizes: Sizes) -> Row:
    """Time the physics alone under commands of ±1, as trained policies give them.

    Each robot holds every command for a fixed number of steps, drawn from 1 to 24.
    """
    env = make_jetbot_env(config)
    robots = env_keys(num_envs)
    holds = jax.vmap(lambda key: jax.random.randint(key, (), 1, _LONGEST_HOLD + 1))(robots)

    def action(key: Array, hold: Array, time: Array) -> Array:
        turn = jnp.round(time / env.dt).astype(int) // hold
        return jax.random.rademacher(jax.random.fold_in(key, turn), (2,), jnp.float32)

    def step(carry: Carry) -> Carry:
        actions = jax.vmap(action)(robots, holds, carry.state.time)
        physics = jax.vmap(env.physics.step)(carry.state, jax.vmap(env.wheel_targets)(actions))
        checksum = carry.tally.checksum + sum_per_env(physics)
        return Carry(physics, carry.key, carry.tally._replace(checksum=checksum))

    first = jax.jit(jax.vmap(env.reset))(robots).pipeline_state
    n_substeps = config.physics.n_substeps
    timed = TimedProgram("switched", step, first, n_substeps=n_substeps, calls=sizes.unroll)
    return _measure_physics(timed, sizes)


def prepare_env(config: Config, num_envs: int, sizes: Sizes) -> TimedProgram:
    """Compile the environment with the training wrappers, under random actions."""
    env = make_jetbot_env(config)
    batch = wrap_for_training(env, config.task.episode_length)

    def step(carry: Carry) -> Carry:
        key, actions = random_actions(carry.key, num_envs)
        state = batch.step(carry.state, actions)
        outputs = (state.obs, state.reward, state.done, state.metrics, state.info)
        tally = Tally(sum_per_env(outputs), *_count_ends(state.info))
        return Carry(state, key, add_tallies(carry.tally, tally))

    first = jax.jit(batch.reset)(env_keys(num_envs))
    n_substeps = config.physics.n_substeps
    return TimedProgram("env", step, first, n_substeps=n_substeps, calls=sizes.unroll)


def measure_env(config: Config, num_envs: int, sizes: Sizes) -> Row:
    """Time the environment with the training wrappers under random actions."""
    return _measure(prepare_env(config, num_envs, sizes), sizes)


def measure_rollout(config: Config, num_envs: int, sizes: Sizes) -> Row:
    """Time Brax's `generate_unroll` with untrained networks of the configured sizes."""
    env = make_jetbot_env(config)
    batch = wrap_for_training(env, config.task.episode_length)
    policy = _exploring_policy(config, env)
    fields = ("truncation", "episode_metrics", "episode_done")
    length = config.ppo.unroll_length

    def unroll(carry: Carry) -> Carry:
        key, unroll_key = jax.random.split(carry.key)
        state, data = acting.generate_unroll(batch, carry.state, policy, unroll_key, length, fields)
        checksum = sum_per_env(jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), data))
        ends = _count_ends(data.extras["state_extras"])
        tally = Tally(checksum, *(each.sum(axis=0) for each in ends))
        return Carry(state, key, add_tallies(carry.tally, tally))

    first = jax.jit(batch.reset)(env_keys(num_envs))
    calls = math.ceil(sizes.unroll / length)
    n_substeps = config.physics.n_substeps
    timed = TimedProgram(
        "rollout", unroll, first, n_substeps=n_substeps, calls=calls, length=length
    )
    return _measure(timed, sizes)


class IntervalTimer(TrainerCallback):
    """A callback that records the times of the training intervals and writes nothing."""

    def __init__(self, clock: CompileClock) -> None:
        """Start without recorded intervals.

        Args:
          clock: Measures the time that JAX compiles.
        """
        self._clock = clock
        self.rows: list[tuple[int, float, float]] = []
        """For each interval: environment steps so far, its seconds, its compile seconds."""
        self.finite = True

    def on_interval(self, progress: Sequence[Progress]) -> bool:
        """Record the times of one interval."""
        one = progress[0]
        compiling = self._clock.lap()
        # The resumable trainer reports the seconds of its compiled step without compilation.
        included = compiling if one.state is None else 0.0
        self.rows.append((one.env_steps, one.seconds - included, compiling))
        self.finite &= all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(one.params))
        return True


def measure_training(config: Config, num_envs: int, sizes: Sizes) -> Row:
    """Time the resumable trainer by its own reports, without the first intervals."""
    config = training_config(config, num_envs, sizes, trainer="resumable")
    program = ppo_trainer.CompiledTrainer.from_setup(Setup(config))
    preemption = Preemption(config.preemption_notice)
    return _time_trainer(
        "training",
        config,
        lambda timer: ppo_trainer.train(program, timer, preemption, config.checkpoint_interval),
    )


def measure_brax(config: Config, num_envs: int, sizes: Sizes) -> Row:
    """Time Brax's own `ppo.train` with the same hyperparameters in the same way."""
    config = training_config(config, num_envs, sizes, trainer="brax")
    setup = Setup(config)
    return _time_trainer("brax", config, lambda timer: brax_trainer.train(setup, timer))


def _time_trainer(rate: str, config: Config, train: Callable[[IntervalTimer], None]) -> Row:
    num_envs = config.ppo.num_envs
    with CompileClock() as clock:
        timer = IntervalTimer(clock)
        train(timer)
    if not timer.finite:
        raise UserError(f"training at {num_envs} environments: the parameters are not finite")
    steps = np.diff([env_steps for env_steps, _, _ in timer.rows])
    rates = (steps / [seconds for _, seconds, _ in timer.rows[1:]]).tolist()
    return make_row(
        rate,
        config.physics.n_substeps,
        num_envs,
        sum(compiling for _, _, compiling in timer.rows),
        rates[WARM_UP_INTERVALS:],
        int(steps[-1]) // num_envs,
    )


MEASUREMENTS: dict[str, Callable[[Config, int, Sizes], Row]] = {
    "physics": measure_physics,
    "switched": measure_switched,
    "env": measure_env,
    "rollout": measure_rollout,
    "training": measure_training,
    "brax": measure_brax,
}
"""The functions that measure the rates, by the name of the rate."""


def training_config(config: Config, num_envs: int, sizes: Sizes, trainer: str) -> Config:
    """Return the configuration with which `training` and `brax` are measured.

    One training step learns from one unroll of every environment. The number of minibatches is
    unchanged; their size depends on the number of environments.

    Args:
      config: The configuration of the run.
      num_envs: The number of environments on all devices together.
      sizes: The number of repeats, and of training steps in each.
      trainer: The trainer, as in the configuration.

    Returns:
      The adapted configuration.

    Raises:
      UserError: The environments cannot be divided among the minibatches or the devices.
    """
    minibatches = config.ppo.num_minibatches
    if num_envs % minibatches:
        fit = minibatches * max(1, round(num_envs / minibatches))
        raise UserError(
            f"--num-envs {num_envs} cannot be divided by ppo.num_minibatches = {minibatches}:"
            f" for example {fit}, or --skip training"
        )
    interval = num_envs * config.ppo.unroll_length * sizes.training_steps
    values = config.model_dump(mode="json")
    values |= {"trainer": trainer, "checkpoint_interval": interval, "stop_at_success": None}
    values["ppo"] |= {
        "num_envs": num_envs,
        "batch_size": num_envs // minibatches,
        "num_timesteps": interval * (WARM_UP_INTERVALS + sizes.repeats),
    }
    if trainer == "brax":
        # Brax has neither setting, and their cost is too small to be measured.
        values["ppo"]["normalizer"] = "brax"
        if config.ppo.learning_rate_schedule == "LINEAR":
            values["ppo"]["learning_rate_schedule"] = "NONE"
    adapted = parse_config(values, source=f"--num-envs {num_envs}")
    adapted.check_devices(jax.device_count())
    return adapted


def _exploring_policy(config: Config, env: JetBotEnv) -> Callable[..., Any]:
    """Return Brax's sampling policy, as its trainer builds it, with untrained networks."""
    networks: Any = make_networks(config.ppo, env.observation_size, env.action_size)
    normalizer = init_normalizer(env.observation_size)
    weights = networks.policy_network.init(jax.random.PRNGKey(0))
    return ppo_networks.make_inference_fn(networks)((normalizer, weights))


def _count_ends(info: PyTree) -> tuple[Array, Array]:
    """Return masks of the episodes that ended and of those that ended in a non-finite state."""
    done = info["episode_done"]
    return done, done * info["episode_metrics"]["nonfinite_envs"]
