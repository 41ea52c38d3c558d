"""Launch the kernels of PPO on NVIDIA GPUs.

All policies of a batch share the launches: the policies are the third axis of the
grid, and each gets its share of the GPU's multiprocessors. The blocks of a policy write a vector
each, which XLA adds up in a fixed order.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from jetbot_mjx.compiler import ptx_backend
from jetbot_mjx.compiler.background import in_background
from jetbot_mjx.compiler.kernel import Backend
from jetbot_mjx.compiler.update import actions, adam, advantages, gpu_adam, shapes
from jetbot_mjx.compiler.update import gradient as gradient_kernel
from jetbot_mjx.compiler.update.adam import AdamRule
from jetbot_mjx.compiler.update.shapes import (
    MOST_OBSERVATIONS,
    MOST_OUTPUTS,
    MOST_SUMS,
    MOST_WIDTH,
    Minibatch,
    Tiling,
    UpdateShape,
)

BACKEND: Backend = ptx_backend
"""The back end that compiles the kernels."""

_LEAST_CAPABILITY = 80
"""Ten times the compute capability of the first GPUs with products of float16."""

PTX_VERSION = 81
"""Ten times the first version of PTX whose conversions to float16 saturate."""

_ELEMENTS = 2
"""Elements of the vectors that a thread updates, if the GPU has enough multiprocessors."""

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
    outputs = max(shape.outputs)
    if shape.observations > MOST_OBSERVATIONS:
        return f"it takes at most {MOST_OBSERVATIONS} numbers, not {shape.observations}"
    if outputs > MOST_OUTPUTS:
        return f"it takes at most {MOST_OUTPUTS} outputs, not {outputs}"
    if shape.width % 16 or shape.width > MOST_WIDTH:
        return f"it takes layers of 16, 32, ... {MOST_WIDTH} units, not {shape.width}"
    if shape.sums > MOST_SUMS:
        return "the gradient of these networks does not fit in the registers of a block"
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


class _Kernel(NamedTuple):
    """A `_Kernel` is a kernel, ready to launch."""

    name: str
    text: Future[str]
    """Its PTX."""
    grid: tuple[int, int, int]
    threads: int
    shared_memory: int
    """Dynamic shared memory of a block [bytes]."""

    def launch(
        self,
        arguments: Sequence[Array],
        *results: tuple[int, ...],
        aliases: Mapping[int, int] | None = None,
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
            aliases,
        )


def _kernel(
    name: str,
    write: Callable[[], str],
    grid: tuple[int, int, int],
    threads: int,
    shared_memory: int,
) -> _Kernel:
    """Begin to compile a kernel to PTX."""
    architecture = ptx_backend.target_architecture()

    def compiled() -> str:
        text = ptx_backend.assembled(write(), architecture, PTX_VERSION)
        ptx_backend.assemble_ahead(text)
        return text

    return _Kernel(name, in_background(compiled), grid, threads, shared_memory)


def _tiled(
    name: str, write: Callable[[], str], tiling: Tiling, grid: tuple[int, int, int]
) -> _Kernel:
    """Begin to compile a kernel whose blocks loop over tiles."""
    return _kernel(name, write, grid, tiling.threads, tiling.layout["size"])


def _most_blocks(policies: int) -> int:
    """Return the multiprocessors for each of the policies that share the GPU."""
    return max(1, ptx_backend.processor_count() // policies)


@functools.cache
def _action_kernel(shape: UpdateShape, environments: int, policies: int) -> _Kernel:
    """Return the kernel of the actions."""
    most = _most_blocks(policies)
    tiling = shapes.action_tiling(shape, environments, most, _shared_memory())
    assert tiling is not None
    blocks = min(most, actions.tile_count(tiling, environments))
    write = functools.partial(actions.actions_text, tiling, environments)
    return _tiled(actions.NAME, write, tiling, (blocks, 1, policies))


@functools.cache
def _gradient_kernels(
    shape: UpdateShape, size: Minibatch, policies: int
) -> tuple[_Kernel, _Kernel]:
    """Return the kernels of the advantages and of the gradient."""
    most = _most_blocks(policies)
    tiling = shapes.advantage_tiling(shape, size, most, _shared_memory())
    assert tiling is not None
    parts = min(most, advantages.tile_count(tiling, size))
    write = functools.partial(advantages.advantages_text, tiling, size)
    first = _tiled(advantages.NAME, write, tiling, (parts, 1, policies))
    # Half of the blocks compute the policy's gradient, and half the values'.
    tiling = shapes.gradient_tiling(shape, _shared_memory())
    assert tiling is not None
    blocks = max(1, min(most // 2, gradient_kernel.tile_count(tiling, size)))
    write = functools.partial(gradient_kernel.gradient_text, tiling, size, parts)
    return first, _tiled(gradient_kernel.NAME, write, tiling, (blocks, 2, policies))


@functools.cache
def _adam_kernel(rule: AdamRule, policies: int) -> _Kernel:
    """Return the kernel of Adam."""
    wanted = -(-rule.shape.size // (_ELEMENTS * gpu_adam.THREADS))
    blocks = min(_most_blocks(policies), wanted)
    write = functools.partial(gpu_adam.adam_text, rule, blocks)
    grid = blocks, 1, policies
    return _kernel(gpu_adam.NAME, write, grid, gpu_adam.THREADS, gpu_adam.SHARED_MEMORY)


def prepare(
    rule: AdamRule, batch: Minibatch, environments: int, policies: int, *, at_once: bool
) -> None:
    """Divide the work among the blocks, and begin to compile all kernels, as `launch.prepare`."""
    assert not at_once
    _action_kernel(rule.shape, environments, policies)
    _gradient_kernels(rule.shape, batch, policies)
    _adam_kernel(rule, policies)


def launch_actions(shape: UpdateShape, arguments: Sequence[Array]) -> list[Array]:
    """Draw actions, while JAX lowers a program for an NVIDIA GPU.

    Args:
      shape: the networks.
      arguments: those of `launch.actions`, with the policies as their first axis.

    Returns:
      The arrays of `launch.Actions`.
    """
    policies, environments = arguments[3].shape[:2]
    kernel = _action_kernel(shape, environments, policies)
    results = [(policies, *sizes) for sizes in shape.drawn_shapes(environments)]
    return kernel.launch(arguments, *results)


def launch_gradient(shape: UpdateShape, arguments: Sequence[Array]) -> list[Array]:
    """Run both kernels of a minibatch, while JAX lowers a program for an NVIDIA GPU.

    Args:
      shape: the networks.
      arguments: those of `launch.gradient`, with the policies as their first axis.

    Returns:
      The gradients, with the sums of the metrics at their places, as the only array.
    """
    params, mean, scale, rows, last, unrolls, noise, index, terms = arguments
    policies, count, each = unrolls.shape
    size = Minibatch(rows.shape[1], each, rows.shape[2], count)
    first, second = _gradient_kernels(shape, size, policies)
    parts, blocks = first.grid[0], second.grid[0]
    samples = policies, size.samples
    estimates = first.launch(
        [params, mean, scale, rows, last, unrolls, index, terms],
        *(samples, samples, (policies, parts, 2)),
    )
    (vectors,) = second.launch(
        [params, mean, scale, rows, unrolls, noise, index, *estimates, terms],
        (policies, blocks, shape.size),
    )
    return [vectors.sum(1)]


def launch_adam(rule: AdamRule, arguments: Sequence[Array]) -> list[Array]:
    """Make a step of Adam, while JAX lowers a program for an NVIDIA GPU.

    Args:
      rule: what the vectors hold.
      arguments: those of `launch.adam`; the first one has the policies as its first axis.

    Returns:
      Its results, in place of the arguments.
    """
    kernel = _adam_kernel(rule, arguments[0].shape[0])
    results = [arguments[i].shape for i in adam.ALIASES]
    return kernel.launch(arguments, *results, aliases=adam.ALIASES)


def _shared_memory() -> int:
    capability = ptx_backend.compute_capability()
    return _SHARED_MEMORY[max(x for x in _SHARED_MEMORY if x <= capability)]
