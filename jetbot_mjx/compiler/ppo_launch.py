"""Launch the kernels of PPO's update as JAX functions, which `jax.vmap` batches over seeds.

All policies of a batch are updated by one launch: the batch axes become the third axis of the grid,
and each policy gets its share of the GPU's multiprocessors. The blocks of a policy write a vector
each, which XLA adds up in a fixed order.
"""

import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir
from jaxtyping import Array, Float

from jetbot_mjx.compiler import ppo_kernel, ptx_backend
from jetbot_mjx.compiler.ppo_kernel import LossTerms, Tiling, UpdateShape

_LEAST_CAPABILITY = 80
"""Ten times the compute capability of the first GPUs with products of bfloat16."""

_SHARED_MEMORY = {80: 166_912, 86: 101_376, 87: 166_912, 89: 101_376, 90: 232_448, 100: 232_448}
"""Bytes of shared memory that a block may have, by the least compute capability."""


class Samples(NamedTuple):
    """A `Samples` holds a minibatch as the gradient's kernel takes it, one row for each sample."""

    observation: Float[Array, "samples obs"]
    raw_action: Float[Array, "samples action"]
    log_prob: Float[Array, " samples"]
    """Log-probability of the action in the policy that took it."""
    distribution: Float[Array, "samples 2*action"]
    """Parameters of the action distribution in that policy."""
    noise: Float[Array, "samples action"]
    """Standard normal noise, which estimates the entropy."""
    advantage: Float[Array, " samples"]
    target: Float[Array, " samples"]
    """Value targets."""


def refusal(shape: UpdateShape) -> str | None:
    """Return why the GPUs of this process cannot run the kernels of a shape, or None.

    Args:
      shape: the networks.
    """
    try:
        capability = ptx_backend.compute_capability()
    except RuntimeError:
        return "there is no NVIDIA GPU"
    if capability < _LEAST_CAPABILITY:
        return f"it needs compute capability 8.0, and this GPU has {capability / 10:.1f}"
    if ppo_kernel.choose_tiling(shape, _shared_memory(capability)) is None:
        return f"the networks do not fit in {_shared_memory(capability) / 1024:.0f} KiB of memory"
    return None


def _shared_memory(capability: int) -> int:
    if capability >= 120:
        return _SHARED_MEMORY[86]
    return _SHARED_MEMORY[max(x for x in _SHARED_MEMORY if x <= capability)]


def values(
    shape: UpdateShape,
    params: Float[Array, " size"],
    mean: Float[Array, " obs"],
    scale: Float[Array, " obs"],
    observation: Float[Array, "samples obs"],
    last: Float[Array, "unrolls obs"],
) -> Float[Array, " samples+unrolls"]:
    """Compute the values of two arrays of observations.

    Args:
      shape: the networks.
      params: the parameters of both networks, in the order of `ppo_kernel`.
      mean: what is subtracted from the observations.
      scale: what they are then multiplied by.
      observation: the observations.
      last: more observations.

    Returns:
      The values of the former, followed by those of the latter.
    """
    arguments = (params, mean, scale, observation, last)
    return _update_p.bind(*arguments, shape=shape, terms=None)


def gradient(
    shape: UpdateShape,
    terms: LossTerms,
    params: Float[Array, " size"],
    mean: Float[Array, " obs"],
    scale: Float[Array, " obs"],
    samples: Samples,
) -> Float[Array, " size"]:
    """Compute the gradient of PPO's loss by the parameters of both networks.

    Args:
      shape: the networks.
      terms: the constants of the loss.
      params: the parameters of both networks, in the order of `ppo_kernel`.
      mean: what is subtracted from the observations.
      scale: what they are then multiplied by.
      samples: the minibatch.

    Returns:
      The gradient, and the sums of the metrics at their places.
    """
    return _update_p.bind(params, mean, scale, *samples, shape=shape, terms=terms)


_update_p = Primitive("ppo_update")


def _result(arguments: Sequence[Any], shape: UpdateShape, terms: LossTerms | None) -> int:
    if terms is not None:
        return shape.size
    return arguments[3].shape[-2] + arguments[4].shape[-2]


@_update_p.def_abstract_eval
def _abstract(*arguments: Any, shape: UpdateShape, terms: LossTerms | None) -> ShapedArray:
    batch = arguments[0].shape[:-1]
    return ShapedArray((*batch, _result(arguments, shape, terms)), np.dtype(np.float32))


@_update_p.def_impl
def _run(*arguments: Array, shape: UpdateShape, terms: LossTerms | None) -> Array:
    with jax.disable_jit(False):
        return _compiled(*arguments, shape=shape, terms=terms)


_compiled = jax.jit(_update_p.bind, static_argnames=("shape", "terms"))


def _batch(
    arguments: Sequence[Array],
    axes: Sequence[int | None],
    *,
    shape: UpdateShape,
    terms: LossTerms | None,
) -> tuple[Array, int]:
    (size,) = {x.shape[i] for x, i in zip(arguments, axes, strict=True) if i is not None}
    moved = [
        jnp.broadcast_to(x, (size, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(arguments, axes, strict=True)
    ]
    return _update_p.bind(*moved, shape=shape, terms=terms), 0


batching.primitive_batchers[_update_p] = _batch


def _lowered(*arguments: Array, shape: UpdateShape, terms: LossTerms | None) -> Array:
    """Launch the kernel, while JAX lowers a program for an NVIDIA GPU."""
    batch = arguments[0].shape[:-1]
    policies, depth = math.prod(batch), len(batch)
    flat = [x.reshape(policies, *x.shape[depth:]) for x in arguments]
    length = _result(arguments, shape, terms)
    samples = flat[3].shape[1]
    last = 0 if terms is not None else flat[4].shape[1]
    architecture = ptx_backend.target_architecture()
    tiling = ppo_kernel.choose_tiling(shape, _shared_memory(ptx_backend.compute_capability()))
    assert tiling is not None
    text = _text(tiling, samples, last, terms, architecture)
    # Share the multiprocessors among all policies and, for the gradient, among both networks.
    networks = 1 if terms is None else 2
    processors = jax.local_devices(backend=ptx_backend.PLATFORM)[0].core_count
    tiles = -(-(samples + last) // tiling.rows)
    blocks = max(1, min(tiles, processors // (networks * policies)))
    rows = (policies, length) if terms is None else (policies, blocks, length)
    (result,) = ptx_backend.launch_ptx(
        ppo_kernel.NAME,
        text,
        flat,
        [jax.ShapeDtypeStruct(rows, np.float32)],
        (blocks, networks, policies),
        ppo_kernel.THREADS,
        tiling.layout["size"],
    )
    if terms is not None:
        result = result.sum(1)
    return result.reshape(*batch, length)


mlir.register_lowering(
    _update_p,
    mlir.lower_fun(_lowered, multiple_results=False),
    platform=ptx_backend.PLATFORM,
)


@functools.cache
def _text(
    tiling: Tiling, samples: int, last: int, terms: LossTerms | None, architecture: int
) -> str:
    """Return the PTX of a kernel."""
    if terms is None:
        text = ppo_kernel.values_text(tiling, samples, last)
    else:
        text = ppo_kernel.gradient_text(tiling, samples, terms)
    return ptx_backend.assembled(text, architecture)
