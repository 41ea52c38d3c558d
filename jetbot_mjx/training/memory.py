"""Estimate a training's device memory from shapes, before anything is compiled.

A device holds a copy of the parameters and its share of the environments. A training step then
needs room for what it collects, and collects and learns one after the other: the larger of the
two counts, or the evaluation where that is larger still.
"""

import os
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree

from jetbot_mjx.agents.ppo import PPO
from jetbot_mjx.config import Config
from jetbot_mjx.envs import mjx
from jetbot_mjx.envs.jetbot_env import JetBotEnv
from jetbot_mjx.envs.robot_model import make_mj_model
from jetbot_mjx.envs.wrappers import wrap_for_training

GIB = 2**30

_MOST_ENVS = 2**24
_KEY = jax.ShapeDtypeStruct((2,), np.uint32)
_FLOAT = 4

_LAYERS = 1.6
"""What a gradient keeps at once of the layers of a minibatch, as XLA was seen to need: all of
them on the way there, and on the way back some once more."""


_TAKEN = 1.18
"""What is taken for what is counted, at the most: for one size, programs that XLA compiled on two
occasions took 15 and 17 GiB of an H200."""

_PROGRAMS = 112 * 2**20
"""What programs and the libraries that they call take besides, as it told of 256 [bytes]."""


class Sizes(NamedTuple):
    """The memory that one of each takes [bytes]."""

    environment: int
    """The state of an environment."""
    physics: int
    """What is computed on the way to its next state."""
    sample: int
    """An environment step as it is collected."""
    learnt: int
    """What learning looks at of it."""
    unroll: int
    """What an unroll ends with."""
    layers: int
    """The networks' units, for one sample."""
    parameters: int
    """Networks, Adam's moments, normaliser, sums: a whole copy."""


class Footprint(NamedTuple):
    """The memory that a training takes on each device [bytes]."""

    num_envs: int
    """Environments, all devices together."""
    batch_size: int
    """Unrolls per minibatch, all devices together."""
    parameters: int
    """Networks, Adam's moments and the normaliser."""
    environments: int
    """Their states."""
    collecting: int
    """One step of all environments, and what is collected."""
    learning: int
    """What is collected, shuffled, and the networks' layers for a minibatch."""
    evaluation: int
    """The episodes of an evaluation, on the first device."""

    @property
    def counted(self) -> int:
        """Return what its arrays take at the fullest moment."""
        most = max(self.collecting, self.learning, self.evaluation)
        return self.parameters + self.environments + most

    @property
    def total(self) -> int:
        """Return what a device has to have for it: all that is counted, and what comes on top."""
        return int(_TAKEN * self.counted) + _PROGRAMS


def sizes(config: Config, env: JetBotEnv) -> Sizes:
    """Ask JAX for the shapes of a training; nothing is computed.

    Args:
      config: the run.
      env: its environment, unwrapped.

    Returns:
      What one of each takes.
    """
    ppo = PPO(config.ppo, wrap_for_training(env, config.task.episode_length))
    state = jax.eval_shape(ppo.init, _KEY)
    _, data, _ = jax.eval_shape(ppo.collect, state, state.key)
    unrolls = config.ppo.batch_size * config.ppo.num_minibatches
    samples = unrolls * config.ppo.unroll_length
    ends = _bytes(data.next_observation)
    books = _bytes(data.extras["state_extras"])
    everything = _bytes(data) - ends
    learnt = everything - books + _bytes(data.extras["state_extras"]["truncation"])
    environments = _bytes(state.env_state)
    network = config.ppo.network
    units = sum(network.policy_hidden_layer_sizes) + sum(network.value_hidden_layer_sizes)
    return Sizes(
        environment=environments // config.ppo.num_envs,
        physics=_physics(config, env),
        sample=everything // samples,
        learnt=learnt // samples,
        unroll=ends // unrolls,
        layers=_FLOAT * units,
        parameters=_bytes(state) - environments,
    )


def _physics(config: Config, env: JetBotEnv) -> int:
    if env.physics.impl != "xla":
        # One kernel keeps what it computes to itself: what comes in and what goes out.
        return 2 * _bytes(jax.eval_shape(env.reset, _KEY).pipeline_state)
    world = make_mj_model(env.robot, config.physics, build_scene=env.task.build_scene, visual=False)
    return _bytes(mjx.make_data(world))


def footprint(config: Config, each: Sizes, device_count: int) -> Footprint:
    """Return what a training takes on each device.

    Args:
      config: the run; `num_envs` and `batch_size` may be others than those of `each`.
      each: what one of each takes.
      device_count: devices of all processes together.

    Returns:
      The memory, part by part.
    """
    ppo = config.ppo
    minibatch = -(-ppo.batch_size // device_count) * ppo.unroll_length
    unrolls = -(-ppo.batch_size * ppo.num_minibatches // device_count)
    samples = unrolls * ppo.unroll_length
    environments = -(-ppo.num_envs // device_count)
    stepped = environments * each.environment
    collected = samples * each.sample + unrolls * each.unroll
    shuffled = samples * each.learnt + unrolls * each.unroll
    return Footprint(
        num_envs=ppo.num_envs,
        batch_size=ppo.batch_size,
        parameters=config.seeds * each.parameters,
        environments=config.seeds * stepped,
        collecting=config.seeds * (collected + environments * each.physics),
        learning=config.seeds
        * (
            collected
            + shuffled
            + stepped
            + each.parameters
            + int(_LAYERS * minibatch * each.layers)
        ),
        evaluation=config.evaluation.episodes * (2 * each.environment + each.physics),
    )


def resized(config: Config, factor: float) -> Config | None:
    """Return the same training with more or fewer environments, and minibatches that go with them.

    Args:
      config: the run.
      factor: on `ppo.num_envs` and `ppo.batch_size`.

    Returns:
      The configuration; None where the numbers would not be whole.
    """
    num_envs, batch_size = config.ppo.num_envs * factor, config.ppo.batch_size * factor
    if not (num_envs.is_integer() and batch_size.is_integer()):
        return None
    ppo = config.ppo.model_copy(update={"num_envs": int(num_envs), "batch_size": int(batch_size)})
    return config.model_copy(update={"ppo": ppo})


def ladder(config: Config, each: Sizes, device_count: int, limit: int) -> list[Footprint]:
    """Yield sizes by factors of two, from a quarter up to the first that does not fit.

    Args:
      config: the run.
      each: what one of each takes.
      device_count: devices of all processes together.
      limit: a device's memory [bytes].

    Returns:
      What they take, ascending, the configured size always among them.
    """
    found = []
    power = -2
    while power <= 0 or (found[-1].total <= limit and found[-1].num_envs < _MOST_ENVS):
        if (changed := resized(config, 2.0**power)) is not None and _shared(changed, device_count):
            found.append(footprint(changed, each, device_count))
        power += 1
    return found


def next_that_fits(
    config: Config, each: Sizes, device_count: int, limit: int | None
) -> Footprint | None:
    """Return the largest training that is smaller than this by a factor of two or more, and fits.

    Args:
      config: the run.
      each: what one of each takes.
      device_count: devices of all processes together.
      limit: a device's memory [bytes]; None: not known, and everything fits.

    Returns:
      What it takes; None where none fits.
    """
    power = -1
    while (changed := resized(config, 2.0**power)) is not None and _shared(changed, device_count):
        found = footprint(changed, each, device_count)
        if limit is None or found.total <= limit:
            return found
        power -= 1
    return None


def advice(config: Config, env: JetBotEnv, device_count: int, limit: int | None) -> str:
    """Return what to say of a training that ran out of memory.

    Args:
      config: the run.
      env: its environment, unwrapped.
      device_count: devices of all processes together.
      limit: a device's memory [bytes]; None: not known.

    Returns:
      One line that names the next smaller size that fits.
    """
    each = sizes(config, env)
    wanted, fits = (
        footprint(config, each, device_count),
        next_that_fits(config, each, device_count, limit),
    )
    has = "" if limit is None else f" ({limit / GIB:.2f} GiB)"
    said = (
        f"the device's memory{has} does not suffice for ppo.num_envs = {wanted.num_envs}, which"
        f" takes about {wanted.total / GIB:.2f} GiB: "
    )
    if fits is None:
        return f"{said}choose smaller networks, ppo.unroll_length or evaluation.episodes"
    return (
        f"{said}--set ppo.num_envs={fits.num_envs} --set ppo.batch_size={fits.batch_size} takes"
        f" {fits.total / GIB:.2f} GiB; python -m jetbot_mjx.plan tells more"
    )


def device_memory() -> int | None:
    """Return what this process's first device has for JAX [bytes]; None: it does not say."""
    device: Any = jax.local_devices()[0]
    if device.platform != "cpu":
        stats = device.memory_stats() or {}
        return stats.get("bytes_limit")
    try:
        host = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (ValueError, OSError):
        return None
    # A CPU that stands for several devices has one memory.
    return host // jax.local_device_count()


def _shared(config: Config, device_count: int) -> bool:
    return config.ppo.num_envs % device_count == 0 and config.ppo.batch_size % device_count == 0


def _bytes(tree: PyTree) -> int:
    return sum(
        int(np.prod(x.shape, dtype=int)) * np.dtype(x.dtype).itemsize for x in jax.tree.leaves(tree)
    )
