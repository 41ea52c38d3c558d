"""The stock trainer: `brax.training.agents.ppo.train.train` on our environment.

Nothing of PPO is written here. This module translates the configuration, hands Brax our
wrappers, and reports each epoch through one callback. `trainer: brax` selects it.
"""

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from brax.training.agents.ppo import train as brax_train
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jetbot_mjx.config import Config
from jetbot_mjx.env import JetBotEnv
from jetbot_mjx.policy import PolicyParams, network_factory
from jetbot_mjx.wrappers import wrap_for_training


class Progress(NamedTuple):
    """What a trainer reports at each checkpoint interval."""

    env_steps: int
    """Environment steps so far."""
    params: PolicyParams
    metrics: Mapping[str, float]
    """Losses and the like, by Brax's names under `training/`."""
    seconds: float
    """Wall time that the steps since the last report took, compilation included."""


def train(config: Config, env: JetBotEnv, report: Callable[[Progress], None]) -> PolicyParams:
    """Trains a policy.

    Args:
      config: the run; `check_devices` has passed it.
      env: the environment, unwrapped.
      report: called before the first step and after every interval.

    Returns:
      The last parameters.
    """
    ppo = config.ppo.model_dump(exclude={"network"})
    num_intervals = max(1, round(config.ppo.num_timesteps / config.checkpoint_interval))
    latest: dict[str, Any] = {}
    # Brax annotates it as a function of the environment alone, and calls it with all four.
    wrap_env_fn: Any = wrap_for_training
    clock = time.perf_counter()

    # Brax calls back twice an epoch: first with the parameters, then with the metrics.
    def on_params(env_steps: int, make_policy: object, params: tuple[Any, Any, Any]) -> None:
        del make_policy
        latest["params"] = PolicyParams(*params)
        if env_steps == 0:
            report(Progress(0, latest["params"], {}, 0.0))
            restart_clock()

    def on_metrics(env_steps: int, metrics: Mapping[str, Any]) -> None:
        seconds = time.perf_counter() - clock
        values = {name: float(value) for name, value in metrics.items()}
        report(Progress(env_steps, latest["params"], values, seconds))
        restart_clock()

    def restart_clock() -> None:
        nonlocal clock
        clock = time.perf_counter()

    with device_put_replicated():
        _, params, _ = brax_train.train(
            environment=env,
            episode_length=config.task.episode_length,
            wrap_env_fn=wrap_env_fn,
            network_factory=network_factory(config.ppo.network),
            seed=config.seed,
            # One initial report and one after every interval; the evaluations are ours.
            num_evals=num_intervals + 1,
            run_evals=False,
            # Without evaluations Brax still resets an evaluation batch of this size.
            num_eval_envs=1,
            progress_fn=on_metrics,
            policy_params_fn=on_params,
            **ppo,
        )
    return PolicyParams(*params)


@contextlib.contextmanager
def device_put_replicated() -> Iterator[None]:
    """Lends JAX ≥ 0.10 the function that it dropped and that Brax 0.14.2 still calls.

    The mesh axis is named `i`, as in Brax's `pmap`: under any other name the shardings of
    the first and the later epochs differ, and the epoch compiles twice.
    """
    if hasattr(jax, "device_put_replicated"):
        yield
        return

    def device_put_replicated(tree: Any, devices: Sequence[Any]) -> Any:
        sharding = NamedSharding(Mesh(np.array(devices), ("i",)), PartitionSpec("i"))
        return jax.tree.map(
            lambda x: jax.device_put(jnp.stack([jnp.asarray(x)] * len(devices)), sharding), tree
        )

    jax.device_put_replicated = device_put_replicated
    try:
        yield
    finally:
        del jax.device_put_replicated
