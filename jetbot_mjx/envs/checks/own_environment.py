"""Check an environment of one's own: its traces, and a short drive of a few instances.

A training would run for minutes on a reward that is not a number, or with a state that is kept in
`self`. Here both are found in about a second, before anything of PPO is compiled.
"""

import functools
import time
from collections.abc import Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

import onekernel
from jetbot_mjx.config import Config
from jetbot_mjx.envs.adapted_env import AdaptedEnv
from jetbot_mjx.envs.checks.probe import first_key
from jetbot_mjx.envs.program_key import own_fingerprint
from jetbot_mjx.envs.robot_facts import step_rate
from jetbot_mjx.envs.state import State
from jetbot_mjx.errors import InvalidError, UserError
from jetbot_mjx.fallbacks import collect

INSTANCES, STEPS = 16, 64
"""Number of instances of the drive, and of environment steps of each."""

_MANY = 1024
"""Instances of the rate; of those without a kernel so many could take minutes."""

_LONGEST_RESET = 2.0
"""[s] what a reset of all instances may take."""

_QUICKLY: dict[str, str | bool] = {"xla_backend_optimization_level": "0"}
"""Options by which XLA compiles for a CPU in a third of the time; these programs run only once."""

_RARE = 0.01
"""Share of steps that may be non-finite in a training, which cuts such episodes off."""

ENVIRONMENT_CHECKS: Mapping[str, str] = {
    "interface": "it can be imported and built, and reset and step trace for one instance",
    "purity": "reset and step trace twice into the same program",
    "drive": f"{INSTANCES} instances for {STEPS} steps: finite, done is 0 or 1, resets are quick",
}
"""What `check_environment` looks at, by the name of each check, in their order."""


def check_environment(config: Config) -> Iterator[tuple[str, list[str]]]:
    """Check the environment that a configuration names.

    Args:
      config: the configuration of the run, which has an `environment`.

    Yields:
      The name and the findings of each of `ENVIRONMENT_CHECKS`; the checks after one with findings
      are skipped. A finding is one line with an error and its remedy.
    """
    try:
        env = AdaptedEnv(config)
    except UserError as error:
        yield "interface", [str(error)]
        return
    yield "interface", []
    findings = list(_impurities(env))
    yield "purity", findings
    if not findings:
        yield "drive", list(_faults(env, rare=0.0))


def describe_environment(config: Config) -> Iterator[tuple[str, str]]:
    """Tell the sizes of an environment, and its rate; what its step is as a kernel is printed.

    Args:
      config: the configuration of the run, which has an `environment`.

    Yields:
      A label and a text.
    """
    env = AdaptedEnv(config)
    kind = "choices" if env.is_discrete else f"action{'s' * (env.action_size > 1)}"
    yield "sizes", f"{env.observation_size} observations, {env.action_size} {kind}"
    yield "metrics", ", ".join(env.metrics) or "none"
    state = jax.eval_shape(env.reset, first_key())
    kept = sum(x.size for x in jax.tree.leaves(state.pipeline_state))
    yield "state", f"{kept} numbers that a later step reads"
    arguments = state, jax.ShapeDtypeStruct((env.action_size,), jnp.float32)
    one = onekernel.fuse(env.step, on_unsupported="xla")
    onekernel.explain(one, *arguments)
    is_kernel = isinstance(one.lowered(*arguments).one, onekernel.Kernel) and env.may_be_kernel
    instances = _MANY if is_kernel else INSTANCES
    # The reason why there is no kernel was told above.
    with collect():
        rate = step_rate(env, instances)
    device = jax.devices()[0].device_kind
    yield "rate", f"{rate:,.2g} environment steps/s of {instances:,} instances on this {device}"


def require_sound(env: AdaptedEnv) -> None:
    """Raise an error, before PPO is compiled, if an environment cannot be trained.

    Args:
      env: the environment.

    Raises:
      InvalidError: it is another program each time, or a short drive of it went wrong.
    """
    for find in (_impurities, _faults):
        found = next(find(env), None)
        if found:
            raise InvalidError(f"environment = {env.config.environment!r}: {found}")


def _impurities(env: AdaptedEnv) -> Iterator[str]:
    """Trace reset and step once more, and compare the traces."""
    name = f"environment = {env.config.environment!r}: "
    try:
        again = AdaptedEnv(env.config, lambda **options: env.source)
    except UserError as error:
        yield str(error).removeprefix(name)
        return
    if own_fingerprint(env) != own_fingerprint(again) or env.metrics != again.metrics:
        yield (
            "reset and step are another program each time: draw random numbers from a key of JAX,"
            " not from NumPy or Python, and keep what changes in the state, not in self"
        )


def _faults(env: AdaptedEnv, rare: float = _RARE) -> Iterator[str]:
    """Drive a few instances with random and extreme actions, and look at what they return.

    Args:
      env: the environment.
      rare: the share of steps that may be non-finite.
    """
    keys = jax.random.split(first_key(), INSTANCES)
    reset = _compiled(jax.jit(jax.vmap(env.reset)).trace(keys))
    begin = time.perf_counter()
    first = jax.block_until_ready(reset(keys))
    seconds = time.perf_counter() - begin
    if seconds > _LONGEST_RESET:
        yield (
            f"a reset of {INSTANCES} instances takes {seconds:.1f} s, and every episode begins with"
            " one: compute in __init__ what all episodes share"
        )
        return
    if (count := INSTANCES - int(jnp.isfinite(first.obs).all(-1).sum())) > 0:
        yield f"the observation of reset is not finite in {count} of {INSTANCES} episodes"
        return
    drive = _compiled(jax.jit(functools.partial(_drive, env)).trace(first))
    told: dict[str, np.ndarray] = jax.device_get(drive(first))
    done, total = told.pop("done"), INSTANCES * STEPS
    for name, finite in told.items():
        count = total - int(finite.sum())
        if count > rare * total:
            yield (
                f"{name} is not finite in {count:,} of {total:,} steps under random actions and"
                " ±1: guard divisions, roots and logarithms"
            )
    wrong = done[~np.isin(done, (0.0, 1.0))]
    if wrong.size:
        yield f"done is {wrong[0]:.4g} in a step: it should be 0 or 1"
    elif done.all():
        yield "done is 1 in every step: it should be 1 only where an episode ends"


def _compiled(traced: jax.stages.Traced) -> jax.stages.Compiled:
    options: Any = _QUICKLY if jax.default_backend() == "cpu" else None
    return traced.lower().compile(options)


def _drive(env: AdaptedEnv, first: State) -> dict[str, Array]:
    """Step all instances; return of each step whether its numbers are finite, and `done`."""
    key = first_key()
    shape = STEPS, INSTANCES, env.action_size
    actions = jax.random.uniform(key, shape, minval=-1.0)
    # Half of the instances get the largest actions.
    extreme = (jnp.arange(INSTANCES) % 2 == 0)[:, None]
    actions = jnp.where(extreme, jnp.sign(actions), actions)

    def step_one(first: State, state: State, action: Array) -> tuple[State, dict[str, Array]]:
        after = env.step(state, action)
        shown = {"observation": after.obs, "reward": after.reward}
        shown |= {f"metrics[{name!r}]": x for name, x in after.metrics.items()}
        told = {name: jnp.isfinite(x).all() for name, x in shown.items()}
        # An episode that is over, or lost, begins again where it began.
        over = (after.done != 0) | ~told["observation"]
        following: PyTree = jax.tree.map(lambda a, b: jnp.where(over, a, b), first, after)
        return following, told | {"done": after.done}

    def step(states: State, action: Array) -> tuple[State, dict[str, Array]]:
        return jax.vmap(step_one)(first, states, action)

    return jax.lax.scan(step, first, actions)[1]
