"""Compute PPO's gradient by kernels as one JAX function, which `jax.vmap` batches over seeds."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir
from jaxtyping import Array, Float, Int

from jetbot_mjx.compiler.kernel import Backend
from jetbot_mjx.compiler.update import launch_cpu, launch_gpu
from jetbot_mjx.compiler.update.shapes import Minibatch, UpdateShape

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


def prepare(shape: UpdateShape, batch: Minibatch, policies: int) -> None:
    """Begin to compile the kernels, before a program is traced that launches them.

    Args:
      shape: the networks.
      batch: the minibatch.
      policies: the number of policies that are trained at once.
    """
    _LAUNCHERS[jax.default_backend()].prepare(shape, batch, policies)


def gradient(
    shape: UpdateShape,
    params: Float[Array, " size"],
    mean: Float[Array, " obs"],
    scale: Float[Array, " obs"],
    rows: Float[Array, "collected time columns"],
    last: Float[Array, "collected obs"],
    unrolls: Int[Array, " unrolls"],
    noise: Float[Array, "time unrolls action"],
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
      unrolls: the unrolls of the minibatch, as indices of the collected ones.
      noise: standard normal noise, which estimates the entropy.
      terms: the coefficients of the loss, in the order of `LossTerms`.

    Returns:
      The gradient, with the sums of the metrics at their places.
    """
    arguments = (params, mean, scale, rows, last, unrolls, noise, terms)
    return _gradient_p.bind(*arguments, shape=shape)


_gradient_p = Primitive("ppo_gradient")


@_gradient_p.def_abstract_eval
def _abstract(params: Any, *_: Any, shape: UpdateShape) -> ShapedArray:
    return ShapedArray(params.shape, params.dtype)


@_gradient_p.def_impl
def _run(*arguments: Array, shape: UpdateShape) -> Array:
    # Enable jit here: within `jax.disable_jit` this function would call itself.
    with jax.disable_jit(False):
        return _compiled(*arguments, shape=shape)


_compiled = jax.jit(_gradient_p.bind, static_argnames="shape")


def _batch(
    arguments: Sequence[Array],
    axes: Sequence[int | None],
    *,
    shape: UpdateShape,
) -> tuple[Array, int]:
    (size,) = {x.shape[i] for x, i in zip(arguments, axes, strict=True) if i is not None}
    moved = [
        jnp.broadcast_to(x, (size, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(arguments, axes, strict=True)
    ]
    return _gradient_p.bind(*moved, shape=shape), 0


batching.primitive_batchers[_gradient_p] = _batch


def _lowered(launcher: Any) -> Callable[..., Array]:
    """Return the function that JAX lowers for a platform."""

    def lowered(*arguments: Array, shape: UpdateShape) -> Array:
        batch = arguments[0].shape[:-1]
        policies, depth = math.prod(batch), len(batch)
        flat = [x.reshape(policies, *x.shape[depth:]) for x in arguments]
        return launcher.launch(shape, flat).reshape(*batch, shape.size)

    return lowered


for _launcher in _LAUNCHERS.values():
    mlir.register_lowering(
        _gradient_p,
        mlir.lower_fun(_lowered(_launcher), multiple_results=False),
        platform=_launcher.BACKEND.PLATFORM,
    )
