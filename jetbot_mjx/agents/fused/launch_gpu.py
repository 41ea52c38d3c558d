"""Launch the kernels of PPO on NVIDIA GPUs.

All policies of a batch share the launches: the policies are the third axis of the
grid, and each gets its share of the GPU's multiprocessors. The blocks of a policy write a vector
each, which XLA adds up in a fixed order.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from jetbot_mjx.agents.fused import actions, adam, advantages, gpu_adam, gpu_tiling
from jetbot_mjx.agents.fused import gradient as gradient_kernel
from jetbot_mjx.agents.fused.adam import AdamRule
from jetbot_mjx.agents.fused.arrays import Arrays, minibatch_of
from jetbot_mjx.agents.fused.gpu_tiling import (
    MOST_OBSERVATIONS,
    MOST_OUTPUTS,
    MOST_SUMS,
    MOST_WIDTH,
    Tiling,
)
from jetbot_mjx.agents.fused.shapes import Minibatch, UpdateShape
from onekernel.build import Backend, gpu, in_background

BACKEND: Backend = gpu
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
    # Sizes that no GPU takes.
    outputs = max(shape.outputs)
    if shape.observations > MOST_OBSERVATIONS:
        return f"it takes at most {MOST_OBSERVATIONS} numbers, not {shape.observations}"
    if outputs > MOST_OUTPUTS:
        return f"it takes at most {MOST_OUTPUTS} outputs, not {outputs}"
    if shape.width % 16 or shape.width > MOST_WIDTH:
        return f"it takes layers of 16, 32, ... {MOST_WIDTH} units, not {shape.width}"
    if gpu_tiling.sums_of(shape) > MOST_SUMS:
        return "the gradient of these networks does not fit in the registers of a block"
    # What this GPU takes.
    try:
        capability = gpu.compute_capability()
    except RuntimeError:
        return "there is no NVIDIA GPU"
    if capability < _LEAST_CAPABILITY:
        return f"it needs compute capability 8.0, and this GPU has {capability / 10:.1f}"
    # Whether the tiles fit in a block's memory.
    memory = _shared_memory()
    if gpu_tiling.gradient_tiling(shape, memory) is None:
        return f"the networks do not fit in the {memory // 1024} KiB of shared memory of this GPU"
    if gpu_tiling.advantage_tiling(shape, batch, 1, memory) is None:
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
        return gpu.launch_ptx(
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
    architecture = gpu.target_architecture()

    def compiled() -> str:
        text = gpu.assembled(write(), architecture, PTX_VERSION)
        gpu.assemble_ahead(text)
        return text

    return _Kernel(name, in_background(compiled), grid, threads, shared_memory)


def _tiled(
    name: str, write: Callable[[], str], tiling: Tiling, grid: tuple[int, int, int]
) -> _Kernel:
    """Begin to compile a kernel whose blocks loop over tiles."""
    return _kernel(name, write, grid, tiling.threads, tiling.layout["size"])


def _most_blocks(policies: int) -> int:
    """Return the multiprocessors for each of the policies that share the GPU."""
    return max(1, gpu.processor_count() // policies)


@functools.cache
def _action_kernel(shape: UpdateShape, environments: int, policies: int) -> _Kernel:
    """Return the kernel of the actions."""
    # The larger the tile, the fewer the blocks: choose both by the multiprocessors of a policy.
    most = _most_blocks(policies)
    tiling = gpu_tiling.action_tiling(shape, environments, most, _shared_memory())
    assert tiling is not None
    blocks = min(most, actions.tile_count(tiling, environments))
    write = functools.partial(actions.actions_text, tiling, environments)
    return _tiled(actions.NAME, write, tiling, (blocks, 1, policies))


@functools.cache
def _gradient_kernels(
    shape: UpdateShape, size: Minibatch, policies: int
) -> tuple[_Kernel, _Kernel]:
    """Return the kernels of the advantages and of the gradient."""
    # Advantages: a tile holds whole unrolls.
    most = _most_blocks(policies)
    tiling = gpu_tiling.advantage_tiling(shape, size, most, _shared_memory())
    assert tiling is not None
    parts = min(most, advantages.tile_count(tiling, size))
    write = functools.partial(advantages.advantages_text, tiling, size)
    first = _tiled(advantages.NAME, write, tiling, (parts, 1, policies))
    # Gradient: half of the blocks compute the policy's gradient, and half the values'.
    tiling = gpu_tiling.gradient_tiling(shape, _shared_memory())
    assert tiling is not None
    blocks = max(1, min(most // 2, gradient_kernel.tile_count(tiling, size)))
    write = functools.partial(gradient_kernel.gradient_text, tiling, size, parts)
    return first, _tiled(gradient_kernel.NAME, write, tiling, (blocks, 2, policies))


@functools.cache
def _adam_kernel(rule: AdamRule, policies: int) -> _Kernel:
    """Return the kernel of Adam."""
    # As many blocks as there are elements for their threads, and no more than multiprocessors.
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


# The kernels by name. What describes a kernel comes first, then its arguments.


def _launch_actions(shape: UpdateShape, arrays: Arrays) -> list[Array]:
    policies, environments, _ = arrays["observations"].shape
    kernel = _action_kernel(shape, environments, policies)
    results = [(policies, *sizes) for sizes in shape.drawn_shapes(environments)]
    return kernel.launch(list(arrays.values()), *results)


def _launch_gradient(shape: UpdateShape, arrays: Arrays) -> list[Array]:
    """Launch the kernel of the advantages, and that of the gradient, whose blocks XLA adds up."""
    params, mean, scale, rows, last, unrolls, noise, index, terms = arrays.values()
    policies, size = len(rows), minibatch_of(arrays)
    first, second = _gradient_kernels(shape, size, policies)
    parts, blocks = first.grid[0], second.grid[0]
    samples = policies, size.samples
    # Advantages, value targets, and the sums of each block.
    estimates = first.launch(
        [params, mean, scale, rows, last, unrolls, index, terms],
        *(samples, samples, (policies, parts, 2)),
    )
    # A gradient of each block; they are added up in a fixed order.
    (vectors,) = second.launch(
        [params, mean, scale, rows, unrolls, noise, index, *estimates, terms],
        (policies, blocks, shape.size),
    )
    return [vectors.sum(1)]


def _launch_adam(rule: AdamRule, arrays: Arrays) -> list[Array]:
    kernel = _adam_kernel(rule, len(arrays["gradient"]))
    results = [arrays[name].shape for name in adam.UPDATED]
    return kernel.launch(list(arrays.values()), *results, aliases=adam.ALIASES)


LAUNCHES: Mapping[str, Callable[[Any, Arrays], list[Array]]] = {
    "actions": _launch_actions,
    "gradient": _launch_gradient,
    "adam": _launch_adam,
}
"""The kernels, as in `launch.Launcher`."""


def _shared_memory() -> int:
    capability = gpu.compute_capability()
    return _SHARED_MEMORY[max(x for x in _SHARED_MEMORY if x <= capability)]
