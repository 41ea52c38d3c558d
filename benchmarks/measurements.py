"""What is measured: four programs, and the clock that is held to them.

Nothing here prints or parses; `steps_per_second.py` beside this file is the command.
"""

# First, before Brax imports MJX and lets it print.
import jetbot_mjx  # noqa: F401  isort: skip

import math
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from brax.training import acting
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import networks as ppo_networks
from jaxtyping import Array, Float, PyTree, UInt32

from jetbot_mjx import brax_ppo, resumable_ppo
from jetbot_mjx.config import Config, parse_config
from jetbot_mjx.env import JetBotEnv, make_env
from jetbot_mjx.errors import UserError
from jetbot_mjx.metrics import CompileClock
from jetbot_mjx.model import WHEEL_RADIUS
from jetbot_mjx.policy import make_networks
from jetbot_mjx.preemption import Preemption
from jetbot_mjx.state import PhysicsState
from jetbot_mjx.trainer import Progress, Recorder
from jetbot_mjx.wrappers import wrap_for_training

WARM_UP_CALLS = 3  # GPUs record their command graphs in the second call
WARM_UP_INTERVALS = 2  # the first compiles; the second, the little that runs between intervals
_REPEAT_SECONDS = 0.25  # [s] a shorter repeat would time the dispatch
_Z_RANGE = (0.5 * WHEEL_RADIUS, 1.5 * WHEEL_RADIUS)  # [m] axle of a robot on its wheels


class Sizes(NamedTuple):
    """How much is measured."""

    repeats: int = 5
    unroll: int = 64
    """Environment steps in one compiled call."""
    training_steps: int = 16
    """Training steps in one repeat of `training`."""


class Row(NamedTuple):
    """One rate at one number of environments."""

    rate: str
    num_envs: int
    env_steps_per_second: float
    """Median of the repeats, summed over the environments."""
    physics_steps_per_second: float
    """The same, times the physics steps in an environment step."""
    microseconds_per_step: float
    """Median time in which all environments together make one step [µs]."""
    compile_seconds: float
    """Tracing, lowering and compiling [s]; no part of the rates."""
    repeats: list[float]
    """`env_steps_per_second` of each repeat."""
    steps_per_repeat: int
    """Steps that each environment made in one repeat."""
    episodes_per_env_step: float | None = None
    """Share of the steps that ended an episode; None: not counted."""
    nonfinite_worlds: int | None = None
    """Worlds that blew up and were reset, warm-up included; None: not counted."""


class _Tally(NamedTuple):
    """What every step adds to, so that the compiler can leave no part of a step out."""

    checksum: Float[Array, " n"]
    episodes: Float[Array, " n"]
    nonfinite: Float[Array, " n"]


class _Carry(NamedTuple):
    """What one call hands to the next: `PhysicsState` or `State`, a key, and the sums."""

    state: Any
    key: UInt32[Array, "2"]
    tally: _Tally


_Step = Callable[[_Carry], _Carry]


def measure_physics(config: Config, num_envs: int, sizes: Sizes) -> Row:
    """Times the physics of robots that drive about, each under random actions of its own."""
    env = make_env(config)

    def step(carry: _Carry) -> _Carry:
        key, actions = _random_actions(carry.key, num_envs)
        physics = jax.vmap(env.step_physics)(carry.state, jax.vmap(env.wheel_targets)(actions))
        checksum = carry.tally.checksum + _sums(physics)
        return _Carry(physics, key, carry.tally._replace(checksum=checksum))

    first = jax.jit(jax.vmap(env.reset))(_keys(num_envs)).pipeline_state
    row = _time("physics", env, step, first, calls=sizes.unroll, repeats=sizes.repeats)
    # Here no wrapper ends episodes or mends worlds; only the last look tells of them.
    return row._replace(episodes_per_env_step=None, nonfinite_worlds=None)


def measure_env(config: Config, num_envs: int, sizes: Sizes) -> Row:
    """Times the environment as trainers see it, under random actions."""
    env = make_env(config)
    batch = wrap_for_training(env, config.task.episode_length)

    def step(carry: _Carry) -> _Carry:
        key, actions = _random_actions(carry.key, num_envs)
        state = batch.step(carry.state, actions)
        told = (state.obs, state.reward, state.done, state.metrics, state.info)
        return _Carry(state, key, _add(carry.tally, _Tally(_sums(told), *_ended(state.info))))

    first = jax.jit(batch.reset)(_keys(num_envs))
    return _time("env", env, step, first, calls=sizes.unroll, repeats=sizes.repeats)


def measure_rollout(config: Config, num_envs: int, sizes: Sizes) -> Row:
    """Times Brax's own collection of data, under fresh networks of the configured sizes."""
    env = make_env(config)
    batch = wrap_for_training(env, config.task.episode_length)
    policy = _exploring_policy(config, env)
    fields = ("truncation", "episode_metrics", "episode_done")
    length = config.ppo.unroll_length

    def unroll(carry: _Carry) -> _Carry:
        key, unroll_key = jax.random.split(carry.key)
        state, data = acting.generate_unroll(batch, carry.state, policy, unroll_key, length, fields)
        checksum = _sums(jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), data))
        ended = _ended(data.extras["state_extras"])
        tally = _Tally(checksum, *(each.sum(axis=0) for each in ended))
        return _Carry(state, key, _add(carry.tally, tally))

    first = jax.jit(batch.reset)(_keys(num_envs))
    calls = math.ceil(sizes.unroll / length)
    return _time("rollout", env, unroll, first, calls=calls, length=length, repeats=sizes.repeats)


class Listener(Recorder):
    """Keeps neither logs nor checkpoints, only times."""

    def __init__(self, clock: CompileClock) -> None:
        """Prepares an empty list.

        Args:
          clock: of the compiler.
        """
        self._clock = clock
        self.rows: list[tuple[int, float, float]] = []
        """Environment steps, seconds since the last report, compilation among them."""
        self.finite = True

    def report(self, progress: Sequence[Progress]) -> bool:
        """Notes the times."""
        one = progress[0]
        compiling = self._clock.lap()
        # The resumable trainer's seconds are those of its compiled step alone.
        inside = compiling if one.state is None else 0.0
        self.rows.append((one.env_steps, one.seconds - inside, compiling))
        self.finite &= all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(one.params))
        return True


def measure_training(config: Config, num_envs: int, sizes: Sizes) -> Row:
    """Times the resumable trainer by its own reports, the first intervals left out."""
    config = training_config(config, num_envs, sizes, trainer="resumable")
    program = resumable_ppo.Program(config, env := make_env(config))
    preemption = Preemption(config.preemption_notice)
    return _time_trainer(
        "training", config, env, lambda to: resumable_ppo.train(config, program, to, preemption)
    )


def measure_stock(config: Config, num_envs: int, sizes: Sizes) -> Row:
    """Times Brax's own `ppo.train` under the same hyperparameters in the same way."""
    config = training_config(config, num_envs, sizes, trainer="brax")
    env = make_env(config)
    return _time_trainer("stock", config, env, lambda to: brax_ppo.train(config, env, to))


def _time_trainer(
    rate: str, config: Config, env: JetBotEnv, train: Callable[[Listener], None]
) -> Row:
    num_envs = config.ppo.num_envs
    with CompileClock() as clock:
        reports = Listener(clock)
        train(reports)
    if not reports.finite:
        raise UserError(f"training at {num_envs} environments: the parameters are not finite")
    steps = np.diff([env_steps for env_steps, _, _ in reports.rows])
    rates = (steps / [seconds for _, seconds, _ in reports.rows[1:]]).tolist()
    return _row(
        rate,
        env,
        num_envs,
        sum(compiling for _, _, compiling in reports.rows),
        rates[WARM_UP_INTERVALS:],
        int(steps[-1]) // num_envs,
    )


MEASUREMENTS: dict[str, Callable[[Config, int, Sizes], Row]] = {
    "physics": measure_physics,
    "env": measure_env,
    "rollout": measure_rollout,
    "training": measure_training,
    "stock": measure_stock,
}
"""By the name of the rate: each takes a configuration and a number of environments."""


def training_config(config: Config, num_envs: int, sizes: Sizes, trainer: str) -> Config:
    """The configuration with which `training` and `stock` are measured.

    One training step learns from one unroll of every environment. The number of minibatches
    stays; their size follows the number of environments.

    Args:
      config: the run's.
      num_envs: environments, over all devices.
      sizes: repeats, and training steps in each.
      trainer: as in the configuration.

    Returns:
      The adapted configuration.

    Raises:
      UserError: the environments cannot be dealt into the minibatches or over the devices.
    """
    minibatches = config.ppo.num_minibatches
    if num_envs % minibatches:
        fit = minibatches * max(1, round(num_envs / minibatches))
        raise UserError(
            f"--num-envs {num_envs} cannot be dealt into ppo.num_minibatches = {minibatches}:"
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
    if trainer == "brax" and config.ppo.learning_rate_schedule == "LINEAR":
        # It does not know this schedule, which costs nothing that could be timed.
        values["ppo"]["learning_rate_schedule"] = "NONE"
    adapted = parse_config(values, source=f"--num-envs {num_envs}")
    adapted.check_devices(jax.device_count())
    return adapted


def _time(
    rate: str,
    env: JetBotEnv,
    step: _Step,
    first: PyTree,
    *,
    calls: int,
    repeats: int,
    length: int = 1,
) -> Row:
    """Compiles `calls` of a step of `length` environment steps into one program; times that."""
    num_envs = jax.tree.leaves(first)[0].shape[0]
    zeros = jnp.zeros(num_envs)
    carry = _Carry(first, jax.random.PRNGKey(1), _Tally(zeros, zeros, zeros))

    def run(carry: _Carry) -> _Carry:
        return jax.lax.scan(lambda carry, _: (step(carry), None), carry, length=calls)[0]

    begun = time.perf_counter()
    program = jax.jit(run).lower(carry).compile()
    compile_seconds = time.perf_counter() - begun

    seconds = math.inf
    for _ in range(WARM_UP_CALLS):
        carry, seconds = _clocked(program, carry, 1)
    program_calls = max(1, math.ceil(_REPEAT_SECONDS / seconds))
    steps = program_calls * calls * length
    rates = []
    for _ in range(repeats):
        carry, seconds = _clocked(program, carry, program_calls)
        rates.append(num_envs * steps / seconds)

    _check(rate, carry)
    env_steps = num_envs * (WARM_UP_CALLS * calls * length + repeats * steps)
    return _row(rate, env, num_envs, compile_seconds, rates, steps)._replace(
        episodes_per_env_step=float(carry.tally.episodes.sum()) / env_steps,
        nonfinite_worlds=int(carry.tally.nonfinite.sum()),
    )


def _clocked(program: _Step, carry: _Carry, calls: int) -> tuple[_Carry, float]:
    """Calls a program, each time on what it last returned, and takes the time [s]."""
    begun = time.perf_counter()
    for _ in range(calls):
        carry = program(carry)
    jax.block_until_ready(carry)
    return carry, time.perf_counter() - begun


def _row(
    rate: str,
    env: JetBotEnv,
    num_envs: int,
    compile_seconds: float,
    repeats: list[float],
    steps_per_repeat: int,
) -> Row:
    median = statistics.median(repeats)
    return Row(
        rate=rate,
        num_envs=num_envs,
        env_steps_per_second=median,
        physics_steps_per_second=median * env.config.physics.n_substeps,
        microseconds_per_step=1e6 * num_envs / median,
        compile_seconds=compile_seconds,
        repeats=repeats,
        steps_per_repeat=steps_per_repeat,
    )


def _check(rate: str, carry: _Carry) -> None:
    """Refuses the rate of robots that no longer exist: what is not a number steps fast."""
    state = carry.state
    physics = state if isinstance(state, PhysicsState) else state.pipeline_state
    z = np.asarray(physics.qpos[:, 2])
    sound = (z > _Z_RANGE[0]) & (z < _Z_RANGE[1])
    for leaf in jax.tree.leaves((physics, carry.tally)):
        sound &= np.isfinite(np.asarray(leaf).reshape(z.size, -1)).all(axis=1)
    if not sound.all():
        raise UserError(
            f"{rate} at {z.size} environments: {z.size - sound.sum()} worlds are not finite, or"
            " their robots not on the floor, so that the rate means nothing"
        )


def _exploring_policy(config: Config, env: JetBotEnv) -> Callable[..., Any]:
    """Brax's sampling policy, as its trainer builds it, on freshly initialised networks."""
    networks = make_networks(
        config.ppo.network,
        env.observation_size,
        env.action_size,
        normalize=config.ppo.normalize_observations,
    )
    normalizer = running_statistics.init_state(
        specs.Array((env.observation_size,), np.dtype("float32"))
    )
    weights = networks.policy_network.init(jax.random.PRNGKey(0))
    return ppo_networks.make_inference_fn(networks)((normalizer, weights))


def _keys(num_envs: int) -> UInt32[Array, "n 2"]:
    return jax.random.split(jax.random.PRNGKey(0), num_envs)


def _random_actions(
    key: UInt32[Array, "2"], num_envs: int
) -> tuple[UInt32[Array, "2"], Float[Array, "n 2"]]:
    key, action_key = jax.random.split(key)
    return key, jax.random.uniform(action_key, (num_envs, 2), minval=-1.0, maxval=1.0)


def _ended(info: PyTree) -> tuple[Array, Array]:
    """Where episodes ended, and where they did because the world blew up."""
    done = info["episode_done"]
    return done, done * info["episode_metrics"]["nonfinite_worlds"]


def _sums(tree: PyTree) -> Float[Array, " n"]:
    """One sum for each environment over everything in a tree."""
    leaves = [leaf.reshape(leaf.shape[0], -1) for leaf in jax.tree.leaves(tree)]
    zeros = jnp.zeros(leaves[0].shape[0])
    return sum((leaf.astype(jnp.float32).sum(axis=1) for leaf in leaves), zeros)


def _add(total: _Tally, step: _Tally) -> _Tally:
    return jax.tree.map(jnp.add, total, step)
