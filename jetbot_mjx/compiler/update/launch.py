"""Run the kernels of PPO as JAX functions, which `jax.vmap` batches over seeds."""

import math
import types
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir
from jaxtyping import Array, Float, Int

from jetbot_mjx.compiler.kernel import Backend
from jetbot_mjx.compiler.update import launch_cpu, launch_gpu
from jetbot_mjx.compiler.update.adam import ALIASES, SIZES, AdamRule
from jetbot_mjx.compiler.update.cpu_unroll import Unroll
from jetbot_mjx.compiler.update.shapes import LossTerms, Minibatch, UpdateShape

_LAUNCHERS: dict[str, Any] = {"gpu": launch_gpu, "cpu": launch_cpu}
"""The modules that launch the kernels, by the kind of JAX's default device."""


def backend() -> Backend:
    """Return the back end that compiles the kernels for JAX's default device."""
    return _LAUNCHERS[jax.default_backend()].BACKEND


def refusal(shape: UpdateShape, batch: Minibatch) -> str | None:
    """Return why this process cannot run the kernels, or None.

    Args:
      shape: the networks.
      batch: the minibatch.
    """
    launcher = _LAUNCHERS.get(jax.default_backend())
    if launcher is None:
        return f"it needs a CPU or an NVIDIA GPU, and this is {jax.default_backend()}"
    return launcher.refusal(shape, batch)


def computes_at_once() -> bool:
    """Return whether one kernel computes all minibatches on JAX's default device: `update`."""
    return hasattr(_LAUNCHERS.get(jax.default_backend()), "launch_update")


def prepare(
    rule: AdamRule, batch: Minibatch, environments: int, policies: int, *, at_once: bool
) -> None:
    """Begin to compile the kernels, before a program is traced that launches them.

    Args:
      rule: the networks, and how the step size changes.
      batch: the minibatch.
      environments: the number of environments of a policy.
      policies: the number of policies that are trained at once.
      at_once: whether `update` is what it launches, and not `gradient` and `adam`.
    """
    launcher = _LAUNCHERS[jax.default_backend()]
    launcher.prepare(rule, batch, environments, policies, at_once=at_once)


def unrolls_at_once() -> bool:
    """Return whether one kernel computes an unroll on JAX's default device: `unroll`."""
    return hasattr(_LAUNCHERS.get(jax.default_backend()), "launch_unroll")


def prepare_unroll(spec: Unroll, environments: int, time: int) -> None:
    """Begin to compile the kernel of `unroll`.

    Args:
      spec: the networks and the environment.
      environments: the number of environments.
      time: the number of steps.
    """
    _LAUNCHERS[jax.default_backend()].prepare_unroll(spec, environments, time)


class Actions(NamedTuple):
    """An `Actions` holds actions and how likely they were, under Brax's names."""

    action: Float[Array, "environments action"]
    raw_action: Float[Array, "environments action"]
    """The action before its tanh, if the distribution has one."""
    log_prob: Float[Array, " environments"]
    """Logarithm of the probability of the raw action."""
    distribution_params: Float[Array, "environments 2*action"]
    """Parameters of the distribution; of a `normal` one, means and standard deviations."""


def actions(
    shape: UpdateShape,
    params: Float[Array, " size"],
    mean: Float[Array, " obs"],
    scale: Float[Array, " obs"],
    observations: Float[Array, "environments obs"],
    noise: Float[Array, "environments action"],
) -> Actions:
    """Run the policy network and draw actions.

    Args:
      shape: the networks.
      params: the parameters of both networks, in the order of `UpdateShape`.
      mean: what is subtracted from the observations.
      scale: what they are then multiplied by.
      observations: the observations.
      noise: standard normal noise, from which the actions follow.
    """
    return Actions(*_actions_p.bind(params, mean, scale, observations, noise, spec=shape))


def unroll(
    spec: Unroll,
    params: Float[Array, " size"],
    mean: Float[Array, " obs"],
    scale: Float[Array, " obs"],
    start: Float[Array, "environments state"],
    noise: Float[Array, "time environments action"],
) -> tuple[Float[Array, "environments state"], Float[Array, "time environments kept"], Actions]:
    """Draw actions and step the environments with them, again and again.

    Args:
      spec: the networks and the environment.
      params: the parameters of both networks, in the order of `UpdateShape`.
      mean: what is subtracted from the observations.
      scale: what they are then multiplied by.
      start: the states before the first step.
      noise: standard normal noise, from which the actions follow.

    Returns:
      The states after the last step; what is kept of the states after each step; and the actions
      of all steps.
    """
    end, kept, *drawn = _unroll_p.bind(params, mean, scale, start, noise, spec=spec)
    return end, kept, Actions(*drawn)


def gradient(
    shape: UpdateShape,
    params: Float[Array, " size"],
    mean: Float[Array, " obs"],
    scale: Float[Array, " obs"],
    rows: Float[Array, "collected time columns"],
    last: Float[Array, "collected obs"],
    unrolls: Int[Array, "minibatches unrolls"],
    noise: Float[Array, "minibatches time unrolls action"],
    index: Int[Array, ""],
    terms: Float[Array, " terms"],
) -> Float[Array, " size"]:
    """Compute the gradient of PPO's loss by the parameters of both networks.

    Args:
      shape: the networks.
      params: the parameters of both networks, in the order of `UpdateShape`.
      mean: what is subtracted from the observations.
      scale: what they are then multiplied by.
      rows: the collected steps, with the columns of `UpdateShape.columns`.
      last: the observations after the last steps.
      unrolls: the unrolls of all minibatches, as indices of the collected ones.
      noise: standard normal noise, which estimates the entropy.
      index: the minibatch.
      terms: the coefficients of the loss, in the order of `LossTerms`.

    Returns:
      The gradient, with the sums of the metrics at their places.
    """
    arguments = (params, mean, scale, rows, last, unrolls, noise, index, terms)
    return _gradient_p.bind(*arguments, spec=shape)[0]


def adam(
    rule: AdamRule,
    gradient: Float[Array, " size"],
    params: Float[Array, " size"],
    mu: Float[Array, " size"],
    nu: Float[Array, " size"],
    progress: Float[Array, "steps+1 progress"],
    index: Int[Array, ""],
    terms: Float[Array, " terms"],
) -> tuple[Array, Array, Array, Array]:
    """Make a step of Adam, whose equations are in `jetbot_mjx.compiler.update.adam`.

    Args:
      rule: what the vectors hold, and how the step size changes.
      gradient: the gradient, with the sums of the metrics at their places.
      params: the parameters.
      mu: mean of the gradients.
      nu: mean of their squares.
      progress: a row of `Progress` before each step, and one after the last.
      index: the step, whose row is read and whose next row is written.
      terms: an array of `AdamTerms`.

    Returns:
      The next parameters, means and progress.
    """
    made = _adam_p.bind(gradient, params, mu, nu, progress, index, terms, spec=rule)
    return made[0], made[1], made[2], made[3]


def update(
    rule: AdamRule,
    mean: Float[Array, " obs"],
    scale: Float[Array, " obs"],
    rows: Float[Array, "collected time columns"],
    last: Float[Array, "collected obs"],
    unrolls: Int[Array, "minibatches unrolls"],
    noise: Float[Array, "minibatches time unrolls action"],
    terms: Float[Array, " terms"],
    adam_terms: Float[Array, " adam_terms"],
    params: Float[Array, " size"],
    mu: Float[Array, " size"],
    nu: Float[Array, " size"],
    progress: Float[Array, "steps+1 progress"],
) -> tuple[Array, Array, Array, Array]:
    """Make a step of Adam along the gradient of each minibatch, as `gradient` and `adam` do.

    Args:
      rule: the networks, and how the step size changes.
      mean: what is subtracted from the observations.
      scale: what they are then multiplied by.
      rows: the collected steps, with the columns of `UpdateShape.columns`.
      last: the observations after the last steps.
      unrolls: the unrolls of all minibatches, as indices of the collected ones.
      noise: standard normal noise, which estimates the entropy.
      terms: the coefficients of the loss, in the order of `LossTerms`.
      adam_terms: an array of `AdamTerms`.
      params: the parameters of both networks, in the order of `UpdateShape`.
      mu: mean of the gradients.
      nu: mean of their squares.
      progress: a row of `Progress` before each step, and one after the last.

    Returns:
      The parameters, means and progress after the last minibatch.
    """
    given = mean, scale, rows, last, unrolls, noise, terms, adam_terms, params, mu, nu, progress
    made = _update_p.bind(*given, spec=rule)
    return made[0], made[1], made[2], made[3]


def _primitive(
    name: str,
    sizes: Callable[..., list[tuple[int, ...]]],
    integers: Collection[int] = (),
    aliases: Mapping[int, int] = types.MappingProxyType({}),
) -> Primitive:
    """Return a primitive that the function `launch_{name}` of a launcher computes.

    Args:
      name: its name.
      sizes: a function from what the launcher is told, and the shapes of the arguments, to those of
        the results.
      integers: which arguments are int32; the others are float32.
      aliases: which arguments it changes, and as which results it returns them. XLA would copy
        them if they had another shape, so the launcher gets and returns them as they are.
    """
    primitive = Primitive(f"ppo_{name}")
    primitive.multiple_results = True
    compiled = jax.jit(primitive.bind, static_argnames="spec")

    @primitive.def_abstract_eval
    def abstract(*arguments: Any, spec: Any) -> list[ShapedArray]:
        # All arguments have the policies, if any, as their first axes.
        batch = arguments[0].shape[:-1]
        inner = [x.shape[len(batch) :] for x in arguments]
        for i, x in enumerate(arguments):
            dtype = np.int32 if i in integers else np.float32
            if x.shape[: len(batch)] != batch or x.dtype != dtype:
                raise TypeError(f"{name}: argument {i} is {x}, not {np.dtype(dtype)} of {batch}")
        return [ShapedArray((*batch, *size), np.float32) for size in sizes(spec, *inner)]

    @primitive.def_impl
    def run(*arguments: Array, spec: Any) -> list[Array]:
        # Enable jit here: within `jax.disable_jit` this function would call itself.
        with jax.disable_jit(False):
            return compiled(*arguments, spec=spec)

    def batched(
        arguments: Sequence[Array], axes: Sequence[int | None], *, spec: Any
    ) -> tuple[list[Array], list[int]]:
        (size,) = {x.shape[i] for x, i in zip(arguments, axes, strict=True) if i is not None}
        moved = [
            jnp.broadcast_to(x, (size, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
            for x, axis in zip(arguments, axes, strict=True)
        ]
        results = primitive.bind(*moved, spec=spec)
        return results, [0] * len(results)

    def lowered_by(launch: Callable[..., list[Array]]) -> Callable[..., list[Array]]:
        def lowered(*arguments: Array, spec: Any) -> list[Array]:
            batch = arguments[0].shape[:-1]
            policies, depth = math.prod(batch), len(batch)
            flat = [
                x if i in aliases else x.reshape(policies, *x.shape[depth:])
                for i, x in enumerate(arguments)
            ]
            return [
                x if i in aliases.values() else x.reshape(*batch, *x.shape[1:])
                for i, x in enumerate(launch(spec, flat))
            ]

        return lowered

    batching.primitive_batchers[primitive] = batched
    for launcher in _LAUNCHERS.values():
        if launch := getattr(launcher, f"launch_{name}", None):
            lowering = mlir.lower_fun(lowered_by(launch))
            mlir.register_lowering(primitive, lowering, platform=launcher.BACKEND.PLATFORM)
    return primitive


_Size = tuple[int, ...]


def _gradient_sizes(shape: UpdateShape, *given: _Size) -> list[_Size]:
    (collected, time, _), (minibatches, unrolls) = given[3], given[5]
    statistics, terms = (shape.observations,), (len(LossTerms._fields),)
    rows, last = (collected, time, shape.columns["size"]), (collected, shape.observations)
    noise = minibatches, time, unrolls, shape.actions
    size, drawn = (shape.size,), (minibatches, unrolls)
    wanted = size, statistics, statistics, rows, last, drawn, noise, (), terms
    _check("gradient", given, wanted)
    return [size]


def _actions_sizes(shape: UpdateShape, *given: _Size) -> list[_Size]:
    statistics, environments = (shape.observations,), given[3][0]
    rows, noise = (environments, shape.observations), (environments, shape.actions)
    _check("actions", given, ((shape.size,), statistics, statistics, rows, noise))
    return shape.drawn_shapes(environments)


def _unroll_sizes(unroll: Unroll, *given: _Size) -> list[_Size]:
    shape, state = unroll.shape, (unroll.state,)
    statistics, (time, environments) = (shape.observations,), given[4][:2]
    noise = time, environments, shape.actions
    wanted = (shape.size,), statistics, statistics, (environments, *state), noise
    _check("unroll", given, wanted)
    _check("unroll", tuple(x.shape for x in unroll.kernel.results()), (state,))
    each = [(environments, len(unroll.kept)), *shape.drawn_shapes(environments)]
    return [(environments, *state), *((time, *sizes) for sizes in each)]


def _adam_sizes(rule: AdamRule, *given: _Size) -> list[_Size]:
    size, terms = (rule.shape.size,), (SIZES["adam_terms"],)
    progress = rule.steps + 1, SIZES["progress"]
    _check("adam", given, (size, size, size, size, progress, (), terms))
    return [size, size, size, progress]


def _update_sizes(rule: AdamRule, *given: _Size) -> list[_Size]:
    shape, time = rule.shape, given[2][1]
    (count, unrolls), size = given[4], (shape.size,)
    gradient = size, *given[:6], (), given[6]
    _gradient_sizes(shape, *gradient)
    progress = rule.steps + 1, SIZES["progress"]
    _check("update", given[7:], ((SIZES["adam_terms"],), size, size, size, progress))
    if (count, unrolls * time) != (rule.steps, rule.samples):
        raise TypeError(f"update: {count} x {unrolls} unrolls of {time} steps do not fit {rule}")
    return [size, size, size, progress]


def _check(name: str, given: tuple[_Size, ...], wanted: tuple[_Size, ...]) -> None:
    """Refuse what a kernel would read beyond its end."""
    if given != wanted:
        raise TypeError(f"{name}: the shapes are {given} instead of {wanted}")


_gradient_p = _primitive("gradient", _gradient_sizes, (5, 7))
_actions_p = _primitive("actions", _actions_sizes)
_unroll_p = _primitive("unroll", _unroll_sizes)
_adam_p = _primitive("adam", _adam_sizes, (5,), ALIASES)
_update_p = _primitive("update", _update_sizes, (4,), launch_cpu.ALIASES)
