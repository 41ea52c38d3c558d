"""Check an environment of one's own: its traces, and a short drive of a few instances.

A training would run for minutes on a reward that is not a number, or with a state that is kept in
`self`. Here both are found before anything of PPO is compiled.

Protocol:

1. Trace reset and step once more: an impure one is another program each time.
2. Compare a batch with single instances, if a batch may be something else: JAX batches all its own
   operations, and not what the user batches.
3. Drive a few instances, and look at all that they return. Most of the time is that of lowering
   physics to a kernel, which the training needs as well and does not repeat.
"""

import functools
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Jaxpr, jaxprs_in_params
from jaxtyping import Array, Float, PyTree, UInt32

import onekernel
from jetbot_mjx.config import Config
from jetbot_mjx.envs.adapted_env import AdaptedEnv
from jetbot_mjx.envs.checks.errors import describe_error
from jetbot_mjx.envs.checks.probe import first_key
from jetbot_mjx.envs.foreign import SUCCESS
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
    "batch": "a batch of instances makes the steps that each of them makes alone",
    "drive": f"{INSTANCES} instances for {STEPS} steps: finite, done and success are 0 or 1, resets"
    " are quick",
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
    checks = {"purity": _impurities(env), "batch": _unlike_alone(env), "drive": _faults(env, 0.0)}
    for name, found in checks.items():
        findings = list(found)
        yield name, findings
        if findings:
            return


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
    yield "rate", f"{rate:,.0f} environment steps/s of {instances:,} instances on this {device}"


def require_sound(env: AdaptedEnv) -> None:
    """Raise an error, before PPO is compiled, if an environment cannot be trained.

    Args:
      env: the environment.

    Raises:
      InvalidError: it is another program each time, a batch of instances makes other steps than
        each of them alone, or a short drive of it went wrong.
    """
    for findings in (_impurities(env), _unlike_alone(env), _faults(env)):
        found = next(findings, None)
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
    told, seconds = _timed(functools.partial(_drive, env), keys)
    if seconds > _LONGEST_RESET:
        # Find out whether it was the resets.
        _, seconds = _timed(jax.vmap(env.reset), keys)
    if seconds > _LONGEST_RESET:
        yield (
            f"a reset of {INSTANCES} instances takes {seconds:.1f} s, and every episode begins with"
            " one: compute in __init__ what all episodes share"
        )
        return
    if (count := INSTANCES - int(told.pop("first").sum())) > 0:
        yield f"the observation of reset is not finite in {count} of {INSTANCES} episodes"
        return
    yield from _told_faults(told, rare)


def _told_faults(told: dict[str, np.ndarray], rare: float) -> Iterator[str]:
    """Say what is wrong in the results of `_drive`."""
    flags, total = {name: told.pop(name) for name in ("done", SUCCESS)}, INSTANCES * STEPS
    for name, finite in told.items():
        count = total - int(finite.sum())
        if count > rare * total:
            yield (
                f"{name} is not finite in {count:,} of {total:,} steps under random actions and"
                " ±1: guard divisions, roots and logarithms"
            )
    for name, values in flags.items():
        wrong = values[np.isfinite(values) & ~np.isin(values, (0.0, 1.0))]
        if wrong.size:
            yield f"{name} is {wrong[0]:.4g} in a step: it should be 0 or 1"
    if (flags["done"] == 1.0).all():
        yield (
            "done is 1 in the first step of every episode: it should be 1 only where an episode"
            " ends"
        )


def _timed(function: Callable[[Array], PyTree], keys: Array) -> tuple[Any, float]:
    """Return what a function returns, on the host, and the seconds that it took once compiled."""
    options: Any = _QUICKLY if jax.default_backend() == "cpu" else None
    program = jax.jit(function).trace(keys).lower().compile(options)
    begin = time.perf_counter()
    result = jax.device_get(program(keys))
    return result, time.perf_counter() - begin


def _actions(env: AdaptedEnv) -> Float[Array, "steps instances action"]:
    """Draw the actions of a drive; half of the instances get the largest ones."""
    shape = STEPS, INSTANCES, env.action_size
    actions = jax.random.uniform(first_key(), shape, minval=-1.0)
    extreme = (jnp.arange(INSTANCES) % 2 == 0)[:, None]
    return jnp.where(extreme, jnp.sign(actions), actions)


def _drive(env: AdaptedEnv, keys: UInt32[Array, "instances 2"]) -> dict[str, Array]:
    """Step all instances; tell of each step whether its numbers are finite, and the two flags.

    `first` tells whether the observation of the reset is finite.
    """

    def step_one(first: State, state: State, action: Array) -> tuple[State, dict[str, Array]]:
        kept, shown = env.outcome(state, action)
        told = {"observation": shown.obs, "reward": shown.reward}
        told |= {f"metrics[{name!r}]": x for name, x in shown.metrics.items()}
        told = {name: jnp.isfinite(x).all() for name, x in told.items()}
        # An episode that is over, or lost, begins again where it began.
        over = (shown.done != 0) | ~told["observation"]
        after = env.follow(state, kept, shown)
        following: PyTree = jax.tree.map(lambda a, b: jnp.where(over, a, b), first, after)
        flags = {"done": shown.done, SUCCESS: shown.metrics.get(SUCCESS, jnp.zeros(()))}
        return following, told | flags

    first: PyTree = jax.vmap(env.reset)(keys)

    def step(states: State, action: Array) -> tuple[State, dict[str, Array]]:
        return jax.vmap(step_one)(first, states, action)

    told = jax.lax.scan(step, first, _actions(env))[1]
    return told | {"first": jnp.isfinite(first.obs).all(-1)}


_BATCHED_BY_USERS = {"custom_vmap_call", "ffi_call", "io_callback", "pure_callback"}
"""Primitives that a batch computes as the user says."""


def _unlike_alone(env: AdaptedEnv) -> Iterator[str]:
    """Compare a reset and a step of a batch with those of single instances.

    Args:
      env: the environment.
    """
    if not any(_BATCHED_BY_USERS.intersection(_primitives(one.jaxpr)) for one in env.traced):
        return

    def reset(key: UInt32[Array, "2"]) -> dict[str, Array]:
        state: PyTree = env.reset(key)
        return {"obs": state.obs, **state.pipeline_state.kept}

    def step(key: UInt32[Array, "2"], action: Float[Array, " action"]) -> dict[str, Array]:
        kept, shown = env.outcome(env.reset(key), action)
        return {"obs": shown.obs, "reward": shown.reward, "done": shown.done, **kept}

    keys = jax.random.split(first_key(), INSTANCES)
    for function, arguments in ((reset, (keys,)), (step, (keys, _actions(env)[0]))):
        name, program = function.__name__, jax.jit(function)
        try:
            together = jax.device_get(jax.jit(jax.vmap(function))(*arguments))
            alone = [jax.device_get(program(*one)) for one in zip(*arguments, strict=True)]
        except Exception as error:
            yield describe_error(error, f"a batch of {name}s", ())
            return
        for leaf, batch in together.items():
            single = np.stack([one[leaf] for one in alone])
            if not np.allclose(batch, single, rtol=1e-3, atol=1e-3, equal_nan=True):
                yield (
                    f"a {name} of {INSTANCES} instances gives another {leaf} than each of them"
                    " alone: no instance may know of the others"
                )
                return


def _primitives(jaxpr: Jaxpr) -> Iterator[str]:
    """Return the names of all primitives of a trace."""
    for equation in jaxpr.eqns:
        yield equation.primitive.name
        for inner in jaxprs_in_params(equation.params):
            yield from _primitives(inner)
