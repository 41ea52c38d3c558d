"""Train with Brax's own `brax.training.agents.ppo.train.train`; `trainer: brax` selects it.

This module contains no PPO. It translates the configuration, passes this project's wrappers and
network factory to Brax, and reports each epoch to a `TrainerCallback`. Such a training cannot be
resumed, because Brax keeps its state in local variables.
"""

import contextlib
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Self

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jax.typing import ArrayLike
from jaxtyping import PyTree

from jetbot_mjx.agents import LOSSES, PolicyParams
from jetbot_mjx.config import PPOConfig
from jetbot_mjx.envs import wrap_for_training
from jetbot_mjx.runs import Setup
from jetbot_mjx.training.callbacks import Progress, TrainerCallback


class _StopTraining(Exception):
    """Raised to leave Brax's training loop, which has no other way to stop early."""


class _LinearRate(float):
    """A step size that falls to zero: a number for Brax, and a schedule for optax.

    Brax has no such schedule, but it passes its step size to optax, which calls what is callable.
    """

    _schedule: optax.Schedule
    _gradient_steps_per_step: float

    def __new__(cls, initial: float, config: PPOConfig) -> Self:
        rate = super().__new__(cls, initial)
        rate._schedule = optax.linear_schedule(initial, 0.0, config.gradient_steps)
        rate._gradient_steps_per_step = config.gradient_steps / (config.all_steps)
        return rate

    def __call__(self, count: ArrayLike) -> ArrayLike:
        """Return the step size after a number of gradient steps."""
        return self._schedule(count)

    def at(self, env_steps: int) -> float:
        """Return the step size after a number of environment steps."""
        return float(np.asarray(self._schedule(env_steps * self._gradient_steps_per_step)))


def train(setup: Setup, recorder: TrainerCallback) -> None:
    """Train until the end, or until the callback asks to stop.

    Args:
      setup: environment and networks, of a configuration that has passed `check_devices`.
      recorder: the callback, which is invoked before the first step and after every interval.
    """
    config = setup.config
    ppo = config.ppo.model_dump(exclude={"network", "normalizer", "update"})
    rate = None
    if config.ppo.learning_rate_schedule == "LINEAR":
        rate = ppo["learning_rate"] = _LinearRate(config.ppo.learning_rate, config.ppo)
        ppo["learning_rate_schedule"] = "NONE"
    latest: PolicyParams | None = None
    clock = time.perf_counter()

    # Brax calls back twice in an epoch: first with the parameters, then with the metrics.
    def on_params(env_steps: int, make_policy: object, params: Sequence[PyTree]) -> None:
        nonlocal latest
        latest = PolicyParams(*params)
        if env_steps == 0:
            report(0, {})

    def report(env_steps: int, metrics: Mapping[str, jax.Array]) -> None:
        nonlocal clock
        seconds = time.perf_counter() - clock if env_steps else 0.0
        params = jax.device_get(latest)
        named = rename_metrics(metrics, config.ppo.entropy_cost)
        if rate is not None and metrics:
            named["policy/learning_rate"] = rate.at(env_steps)
        if not recorder.on_interval([Progress(env_steps, params, named, seconds)]):
            raise _StopTraining
        clock = time.perf_counter()

    from brax.training.agents.ppo import train as brax_train

    # Run Brax's trainer without its own evaluations.
    with device_put_replicated(), contextlib.suppress(_StopTraining):
        brax_train.train(
            environment=setup.env,
            episode_length=config.task.episode_length,
            # Brax annotates it as a function of the environment alone, but passes four arguments.
            wrap_env_fn=wrap_for_training,  # pyright: ignore[reportArgumentType]
            network_factory=lambda *_, **__: setup.networks,  # pyright: ignore[reportArgumentType]
            seed=config.seed,
            # Report at the beginning and after every interval; the recorder evaluates.
            num_evals=1 + max(1, round(config.ppo.num_timesteps / config.checkpoint_interval)),
            run_evals=False,
            # Brax resets an evaluation batch of this size even without evaluations.
            num_eval_envs=1,
            progress_fn=report,
            policy_params_fn=on_params,
            **ppo,
        )


def rename_metrics(metrics: Mapping[str, jax.Array], entropy_cost: float) -> dict[str, float]:
    """Return Brax's metrics under this project's names."""
    brax = {name.removeprefix("training/"): float(value) for name, value in metrics.items()}
    found = {ours: brax[theirs] for theirs, ours in LOSSES.items() if theirs in brax}
    if "entropy_loss" in brax and entropy_cost > 0:
        found["policy/entropy"] = -brax["entropy_loss"] / entropy_cost
    return found


@contextlib.contextmanager
def device_put_replicated() -> Iterator[None]:
    """Add to JAX the function that 0.10 removed and that Brax 0.14.2 still calls.

    The mesh axis is named `i`, as in Brax's `pmap`: under any other name the shardings of
    the first and the later epochs differ, and the epoch compiles twice.
    """

    def device_put_replicated(tree: PyTree, devices: Sequence[object]) -> PyTree:
        sharding = NamedSharding(Mesh(np.array(devices), ("i",)), PartitionSpec("i"))
        return jax.tree.map(
            lambda x: jax.device_put(jnp.stack([jnp.asarray(x)] * len(devices)), sharding), tree
        )

    jax.device_put_replicated = device_put_replicated
    try:
        yield
    finally:
        del jax.device_put_replicated
