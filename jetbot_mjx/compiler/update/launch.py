"""Launch the kernels of PPO's update as one JAX function, which `jax.vmap` batches over seeds.

All policies of a batch are updated by the same launches: the batch axes become the third axis of
the grid, and each policy gets its share of the GPU's multiprocessors. The blocks of a policy write
a vector each, which XLA adds up in a fixed order.
"""

import functools
import math
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir
from jaxtyping import Array, Float, Int

from jetbot_mjx.compiler import ptx_backend
from jetbot_mjx.compiler.background import in_background
from jetbot_mjx.compiler.update import advantages, shapes
from jetbot_mjx.compiler.update import gradient as gradient_kernel
from jetbot_mjx.compiler.update.shapes import LossTerms, Minibatch, Tiling, UpdateShape

_LEAST_CAPABILITY = 80
"""Ten times the compute capability of the first GPUs with products of float16."""

PTX_VERSION = 81
"""Ten times the first version of PTX whose conversions to float16 saturate."""

_SHARED_MEMORY = {
    80: 166_912,
    86: 101_376,
    87: 166_912,
    89: 101_376,
    90: 232_448,
    110: 232_448,
    120: 101_376,
}
"""Bytes of shared memory that a block may have, by the least compute capability."""


def refusal(shape: UpdateShape, batch: Minibatch) -> str | None:
    """Return why the GPUs of this process cannot run the kernels, or None.

    Args:
      shape: the networks.
      batch: the minibatch.
    """
    try:
        capability = ptx_backend.compute_capability()
    except RuntimeError:
        return "there is no NVIDIA GPU"
    if capability < _LEAST_CAPABILITY:
        return f"it needs compute capability 8.0, and this GPU has {capability / 10:.1f}"
    memory = _shared_memory()
    if shapes.gradient_tiling(shape, memory) is None:
        return f"the networks do not fit in the {memory // 1024} KiB of shared memory of this GPU"
    if shapes.advantage_tiling(shape, batch, 1, memory) is None:
        return f"unrolls of {batch.time} steps do not fit in the {memory // 1024} KiB of this GPU"
    return None


def gradient(
    shape: UpdateShape,
    terms: LossTerms,
    params: Float[Array, " size"],
    mean: Float[Array, " obs"],
    scale: Float[Array, " obs"],
    rows: Float[Array, "collected time columns"],
    last: Float[Array, "collected obs"],
    unrolls: Int[Array, " unrolls"],
    noise: Float[Array, "time unrolls action"],
) -> Float[Array, " size"]:
    """Compute the gradient of PPO's loss by the parameters of both networks.

    Args:
      shape: the networks.
      terms: the constants of the loss.
      params: the parameters of both networks, in the order of `UpdateShape`.
      mean: what is subtracted from the observations.
      scale: what they are then multiplied by.
      rows: the collected steps, with the columns of `UpdateShape.columns`.
      last: the observations after the last steps.
      unrolls: the unrolls of the minibatch, as indices of the collected ones.
      noise: standard normal noise, which estimates the entropy.

    Returns:
      The gradient, with the sums of the metrics at their places.
    """
    arguments = (params, mean, scale, rows, last, unrolls, noise)
    return _gradient_p.bind(*arguments, shape=shape, terms=terms)


_gradient_p = Primitive("ppo_gradient")


@_gradient_p.def_abstract_eval
def _abstract(params: Any, *_: Any, shape: UpdateShape, terms: LossTerms) -> ShapedArray:
    return ShapedArray(params.shape, params.dtype)


@_gradient_p.def_impl
def _run(*arguments: Array, shape: UpdateShape, terms: LossTerms) -> Array:
    # Enable jit here: within `jax.disable_jit` this function would call itself.
    with jax.disable_jit(False):
        return _compiled(*arguments, shape=shape, terms=terms)


_compiled = jax.jit(_gradient_p.bind, static_argnames=("shape", "terms"))


def _batch(
    arguments: Sequence[Array],
    axes: Sequence[int | None],
    *,
    shape: UpdateShape,
    terms: LossTerms,
) -> tuple[Array, int]:
    (size,) = {x.shape[i] for x, i in zip(arguments, axes, strict=True) if i is not None}
    moved = [
        jnp.broadcast_to(x, (size, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(arguments, axes, strict=True)
    ]
    return _gradient_p.bind(*moved, shape=shape, terms=terms), 0


batching.primitive_batchers[_gradient_p] = _batch


class _Kernel(NamedTuple):
    """A `_Kernel` is one of the two kernels, ready to launch."""

    name: str
    text: Future[str]
    """Its PTX."""
    grid: tuple[int, int, int]
    threads: int
    shared_memory: int
    """Dynamic shared memory of a block [bytes]."""

    def launch(
        self, arguments: Sequence[Array], *results: tuple[int, ...]
    ) -> list[Float[Array, "..."]]:
        """Run the kernel, and return float32 arrays of the given shapes."""
        like = [jax.ShapeDtypeStruct(shape, np.float32) for shape in results]
        return ptx_backend.launch_ptx(
            self.name,
            self.text.result(),
            arguments,
            like,
            self.grid,
            self.threads,
            self.shared_memory,
        )


@functools.cache
def prepare(
    shape: UpdateShape, terms: LossTerms, size: Minibatch, policies: int
) -> tuple[_Kernel, _Kernel]:
    """Divide the work among the blocks, and begin to compile both kernels to PTX.

    Args:
      shape: the networks.
      terms: the constants of the loss.
      size: the minibatch.
      policies: the number of policies that share the GPU.

    Returns:
      The kernels of the advantages and of the gradient.
    """

    def kernel(name: str, write: Callable[[], str], tiling: Tiling, x: int, y: int) -> _Kernel:
        architecture = ptx_backend.target_architecture()

        def compiled() -> str:
            text = ptx_backend.assembled(write(), architecture, PTX_VERSION)
            ptx_backend.assemble_ahead(text)
            return text

        return _Kernel(
            name, in_background(compiled), (x, y, policies), tiling.threads, tiling.layout["size"]
        )

    # Share the multiprocessors among all policies.
    most = max(1, ptx_backend.processor_count() // policies)
    tiling = shapes.advantage_tiling(shape, size, most, _shared_memory())
    assert tiling is not None
    parts = min(most, advantages.tile_count(tiling, size))
    write = functools.partial(advantages.advantages_text, tiling, size, terms)
    first = kernel(advantages.NAME, write, tiling, parts, 1)
    # Half of the blocks compute the policy's gradient, and half the values'.
    tiling = shapes.gradient_tiling(shape, _shared_memory())
    assert tiling is not None
    blocks = max(1, min(most // 2, gradient_kernel.tile_count(tiling, size)))
    write = functools.partial(gradient_kernel.gradient_text, tiling, size, terms, parts)
    return first, kernel(gradient_kernel.NAME, write, tiling, blocks, 2)


def _lowered(*arguments: Array, shape: UpdateShape, terms: LossTerms) -> Array:
    """Launch the kernels, while JAX lowers a program for an NVIDIA GPU."""
    batch = arguments[0].shape[:-1]
    policies, depth = math.prod(batch), len(batch)
    flat = [x.reshape(policies, *x.shape[depth:]) for x in arguments]
    params, mean, scale, rows, last, unrolls, noise = flat
    size = Minibatch(rows.shape[1], unrolls.shape[1], rows.shape[2])
    first, second = prepare(shape, terms, size, policies)
    parts, blocks = first.grid[0], second.grid[0]
    samples = policies, size.samples
    estimates = first.launch(
        [params, mean, scale, rows, last, unrolls], samples, samples, (policies, parts, 2)
    )
    (vectors,) = second.launch(
        [params, mean, scale, rows, unrolls, noise, *estimates], (policies, blocks, shape.size)
    )
    return vectors.sum(1).reshape(*batch, shape.size)


mlir.register_lowering(
    _gradient_p,
    mlir.lower_fun(_lowered, multiple_results=False),
    platform=ptx_backend.PLATFORM,
)


def _shared_memory() -> int:
    capability = ptx_backend.compute_capability()
    return _SHARED_MEMORY[max(x for x in _SHARED_MEMORY if x <= capability)]
