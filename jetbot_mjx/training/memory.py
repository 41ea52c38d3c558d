"""Estimate a training's device memory from shapes, before anything is compiled.

Each device holds a copy of the parameters P and its share of the environments E. A training step
collects experience and then learns from it, and an evaluation runs between steps, so that only the
largest of the three counts:

    memory = 1.18 (P + E + max(collecting, learning, evaluation)) + 112 MiB

The factor and the constant were measured on one NVIDIA H200.
"""

import math
import os
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree

from jetbot_mjx.agents import PPO, activation_bytes
from jetbot_mjx.config import Config
from jetbot_mjx.envs import AdaptedEnv, JetBotEnv, make_data
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs import Setup
from jetbot_mjx.terminal import text_table
from jetbot_mjx.training.ppo_trainer import build_ppo

GIB = 2**30

_MOST_ENVS = 2**24
_KEY = jax.ShapeDtypeStruct((2,), np.uint32)
_FLOAT = 4

_LAYERS = 1.6
"""Memory of a gradient, as a multiple of the activations of a minibatch, as measured with XLA: the
forward pass stores all of them, the backward pass some of them again."""

_DRAWING = 3
"""Memory of drawing random numbers, as a multiple of the numbers: XLA stores the counters of the
generator and the pairs of words that it makes."""

_OVERHEAD = 1.18
"""Largest measured ratio of allocated to counted memory: for one size, programs that XLA compiled
on two occasions took 15 and 17 GiB of an H200."""

_PROGRAMS = 112 * 2**20
"""Memory of the programs and of the libraries that they call, as measured [bytes]."""


class Sizes(NamedTuple):
    """A `Sizes` holds the memory of one environment, one sample and so on [bytes]."""

    environment: int
    """The state of an environment."""
    physics: int
    """The intermediate results of one physics step of one environment."""
    sample: int
    """One collected environment step."""
    learned: int
    """The part of a collected step that the loss reads."""
    unroll: int
    """The last observation of one unroll."""
    layers: int
    """The activations of both networks and of their convolutions for one sample."""
    gradient: int
    """What a gradient stores of one sample; nothing if activations stay within a kernel."""
    noise: int
    """The noise that estimates the entropy of one sample in all passes, if it is drawn ahead."""
    parameters: int
    """One copy of the networks, Adam's moments, the normaliser and the sums of metrics."""


class Footprint(NamedTuple):
    """A `Footprint` holds the memory that a training takes on each device [bytes]."""

    num_envs: int
    """Number of environments over all devices."""
    batch_size: int
    """Unrolls per minibatch over all devices."""
    parameters: int
    """Networks, Adam's moments and the normaliser."""
    environments: int
    """The states of the environments."""
    collecting: int
    """One physics step or the actions of all environments, and the collected steps."""
    learning: int
    """The collected steps, their shuffled copy, the noise, and the activations of a minibatch."""
    evaluation: int
    """The episodes of an evaluation, on the first device."""

    @property
    def counted(self) -> int:
        """Return the largest memory of all arrays at one time."""
        most = max(self.collecting, self.learning, self.evaluation)
        return self.parameters + self.environments + most

    @property
    def settings(self) -> str:
        """Return the arguments that set this number of environments."""
        return f"--set ppo.num_envs={self.num_envs} --set ppo.batch_size={self.batch_size}"

    @property
    def total(self) -> int:
        """Return the memory that a device needs: the arrays, the overhead and the programs."""
        return int(_OVERHEAD * self.counted) + _PROGRAMS


def sizes(ppo: PPO, env: JetBotEnv | AdaptedEnv) -> Sizes:
    """Trace a training for its shapes; nothing is computed.

    Args:
      ppo: PPO with the wrapped environment, from `build_ppo`.
      env: the same environment, unwrapped.

    Returns:
      The memory of one environment, one sample and so on.
    """
    # Trace the state, and what one training step collects.
    state = jax.eval_shape(ppo.init, _KEY)
    _, data, _ = jax.eval_shape(ppo.collect, jax.eval_shape(ppo.packed, state), state.key)
    config = ppo.config
    unrolls = config.batch_size * config.num_minibatches
    samples = unrolls * config.unroll_length
    # Of the episode statistics, the loss reads the truncation only.
    ends = _bytes(data.next_observation)
    statistics = _bytes(data.extras["state_extras"])
    collected = _bytes(data) - ends
    learned = collected - statistics + _bytes(data.extras["state_extras"]["truncation"])
    environments = _bytes(state.env_state)
    network = config.network
    units = sum(network.policy_hidden_layer_sizes) + sum(network.value_hidden_layer_sizes)
    size = env.observation_size
    encoded = 0 if isinstance(size, int) else activation_bytes(network, size)
    return Sizes(
        environment=environments // config.num_envs,
        physics=_physics(env),
        sample=collected // samples,
        learned=learned // samples,
        unroll=ends // unrolls,
        layers=_FLOAT * units + encoded,
        gradient=ppo.learner.keeps_activations * int(_LAYERS * (_FLOAT * units + encoded)),
        noise=ppo.learner.draws_ahead * _FLOAT * config.num_updates_per_batch * env.action_size,
        parameters=_bytes(state) - environments,
    )


def _physics(env: JetBotEnv | AdaptedEnv) -> int:
    """Return the memory of one physics step of one environment [bytes].

    What XLA keeps in a step of an environment of one's own is not known.
    """
    if isinstance(env, AdaptedEnv) or env.physics.impl != "xla":
        # A single kernel stores its input and output only, no intermediate results.
        return 2 * _bytes(jax.eval_shape(env.reset, _KEY).pipeline_state)
    return _bytes(make_data(env.physics.mj_model))


class MemoryModel(NamedTuple):
    """A `MemoryModel` predicts the memory of a training and of larger and smaller ones."""

    config: Config
    """The configuration of the run."""
    each: Sizes
    """The memory of one environment, one sample and so on, from `sizes`."""
    device_count: int
    """Number of devices over all processes."""

    def footprint(self) -> Footprint:
        """Compute the memory that the training takes on each device."""
        # Divide environments and samples among the devices, rounded up.
        config, each, ppo = self.config, self.each, self.config.ppo
        minibatch = -(-ppo.batch_size // self.device_count) * ppo.unroll_length
        unrolls = -(-ppo.batch_size * ppo.num_minibatches // self.device_count)
        samples = unrolls * ppo.unroll_length
        environments = -(-ppo.num_envs // self.device_count)
        # Add up the parts; every seed takes all of them but the evaluation.
        stepped = environments * each.environment
        # An environment is stepped after its action is known, not at the same time.
        working = max(each.physics, each.layers)
        collected = samples * each.sample + unrolls * each.unroll
        shuffled = samples * each.learned + unrolls * each.unroll
        # Noise is drawn before the update, which holds the states before the unroll, as rows, and
        # their copy.
        noise = samples * each.noise
        updating = 2 * stepped + each.parameters + minibatch * each.gradient + noise
        return Footprint(
            num_envs=ppo.num_envs,
            batch_size=ppo.batch_size,
            parameters=config.seeds * each.parameters,
            environments=config.seeds * stepped,
            collecting=config.seeds * (collected + stepped + environments * working),
            learning=config.seeds * (collected + shuffled + max(updating, _DRAWING * noise)),
            evaluation=config.evaluation.episodes * (2 * each.environment + working),
        )

    def resized(self, factor: float) -> Footprint | None:
        """Return the footprint with `ppo.num_envs` and `ppo.batch_size` multiplied by a factor.

        Returns:
          The footprint; None if the products are not whole numbers, or if the devices cannot share
          the environments and minibatches evenly.
        """
        ppo = self.config.ppo
        changed = {name: getattr(ppo, name) * factor for name in ("num_envs", "batch_size")}
        if any(value % self.device_count for value in changed.values()):
            return None
        ppo = ppo.model_copy(update={name: int(value) for name, value in changed.items()})
        return self._replace(config=self.config.model_copy(update={"ppo": ppo})).footprint()

    def ladder(self, limit: int) -> list[Footprint]:
        """Return footprints by factors of two, from a quarter up to the first that does not fit.

        Args:
          limit: memory of a device [bytes].

        Returns:
          The footprints in ascending order, always including that of the configured size.
        """
        found = []
        power = -2
        while power <= 0 or (found[-1].total <= limit and found[-1].num_envs < _MOST_ENVS):
            if one := self.resized(2.0**power):
                found.append(one)
            power += 1
        return found

    def next_that_fits(self, limit: int | None) -> Footprint | None:
        """Return the largest training that fits and is smaller by a power of two.

        Args:
          limit: memory of a device [bytes]; None: not known, and everything fits.

        Returns:
          Its footprint; None if none fits.
        """
        power = -1
        while (found := self.resized(2.0**power)) and limit is not None and found.total > limit:
            power -= 1
        return found

    def advice(self, limit: int | None) -> str:
        """Return the error message for a training that ran out of memory.

        Args:
          limit: memory of a device [bytes]; None: not known.

        Returns:
          One line that names the next smaller size that fits.
        """
        wanted, fits = self.footprint(), self.next_that_fits(limit)
        available = "" if limit is None else f" ({limit / GIB:.2f} GiB)"
        problem = (
            f"the device's memory{available} is too small for ppo.num_envs = {wanted.num_envs},"
            f" which takes about {wanted.total / GIB:.2f} GiB: "
        )
        if fits is None:
            return f"{problem}choose smaller networks, ppo.unroll_length or evaluation.episodes"
        size = f"{fits.total / GIB:.2f} GiB"
        return f"{problem}{fits.settings} takes {size}; jetbot-mjx plan lists other sizes"


def device_memory() -> int | None:
    """Return the memory of this process's first device [bytes]; None if it does not report it."""
    device = jax.local_devices()[0]
    if device.platform != "cpu":
        stats = device.memory_stats() or {}
        return stats.get("bytes_limit")
    try:
        host = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    # Windows has no such function.
    except (AttributeError, ValueError, OSError):
        return None
    # Several CPU devices share the memory of the host.
    return host // jax.local_device_count()


class MemoryPlan(NamedTuple):
    """A `MemoryPlan` holds the memory that a training needs and the memory of each device."""

    config: Config
    device_count: int
    limit: int
    """Memory of each device [bytes]."""
    footprints: list[Footprint]
    """Memory footprints in ascending order of the number of environments."""

    @property
    def largest(self) -> Footprint | None:
        """Return the largest footprint that fits, or None."""
        return max((one for one in self.footprints if one.total <= self.limit), default=None)

    @property
    def fits(self) -> bool:
        """Return whether the configuration fits as it is."""
        asked = self.config.ppo.num_envs
        return next(one for one in self.footprints if one.num_envs == asked).total <= self.limit


def plan_memory(config: Config, memory: float | None = None) -> MemoryPlan:
    """Predict the memory of a training from shapes alone, without compiling anything.

    Args:
      config: The configuration of the run.
      memory: The memory of each device [GiB], or None for what the first device reports.

    Returns:
      The needed memory by the number of environments.

    Raises:
      UserError: the devices cannot share the environments, or do not report their memory.
    """
    device_count = jax.device_count()
    config.check_devices(device_count)
    limit = device_memory() if memory is None else int(memory * GIB)
    if limit is None:
        raise UserError("this device does not report its memory: give --memory GIB")
    setup = Setup(config)
    model = MemoryModel(config, sizes(build_ppo(setup), setup.env), device_count)
    return MemoryPlan(config, device_count, limit, model.ladder(limit))


def memory_table(plan: MemoryPlan) -> str:
    """Return a plan as a table for the terminal."""
    parts = ("parameters", "environments", "collecting", "learning", "evaluation")
    rows = [("", "num_envs", "batch_size", *parts, "needed", "")]
    rows += [
        (
            ">" if one.num_envs == plan.config.ppo.num_envs else "",
            f"{one.num_envs:,}",
            f"{one.batch_size:,}",
            *(f"{getattr(one, part) / GIB:.3f}" for part in parts),
            f"{one.total / GIB:.3f}",
            "" if one.total <= plan.limit else "does not fit",
        )
        for one in plan.footprints
    ]
    remedy = "none of them fits: try a smaller network or evaluation.episodes"
    if best := plan.largest:
        remedy = f"the largest of these that fits: {best.settings}"
    return (
        f"GiB on each of {plan.device_count} x {jax.devices()[0].device_kind},"
        f" which has {plan.limit / GIB:.1f}; > marks the configuration\n"
        f"{text_table(rows)}\n{remedy}"
    )


def _bytes(tree: PyTree) -> int:
    return sum(math.prod(x.shape) * np.dtype(x.dtype).itemsize for x in jax.tree.leaves(tree))
