"""Launch the kernels of PPO on NVIDIA GPUs.

All policies of a batch share the launches: the policies are the third axis of the
grid, and each gets its share of the GPU's multiprocessors. The blocks of a policy write a vector
each, which XLA adds up in a fixed order.
"""

import functools
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Future
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from jetbot_mjx.agents.fused import gpu_advantages, gpu_gradient, gpu_tiling
from jetbot_mjx.agents.fused.adam import AdamRule
from jetbot_mjx.agents.fused.arrays import ACTIONS, ADAM, Arrays, Signature, Spec
from jetbot_mjx.agents.fused.gpu_actions import ActionKernel
from jetbot_mjx.agents.fused.gpu_adam import BLOCK_ELEMENTS, AdamKernel
from jetbot_mjx.agents.fused.gpu_advantages import AdvantageKernel
from jetbot_mjx.agents.fused.gpu_gradient import GradientKernel
from jetbot_mjx.agents.fused.shapes import Minibatch, UpdateShape
from jetbot_mjx.agents.fused.tensor_core import GpuKernel
from onekernel.build import Backend, gpu, in_background

BACKEND: Backend = gpu
"""The back end that compiles the kernels."""

_LEAST_CAPABILITY = 80
"""Ten times the compute capability of the first GPUs with products of float16."""

PTX_VERSION = 81
"""Ten times the first version of PTX whose conversions to float16 saturate."""

_SHARED_MEMORY = {80: 163, 86: 99, 87: 163, 89: 99, 90: 227, 110: 227, 120: 99}
"""Shared memory that a block may have [KiB], by the least compute capability. It is that of a
multiprocessor but for 1 KiB, by NVIDIA's programming guide."""


def refusal(shape: UpdateShape, batch: Minibatch) -> str | None:
    """Return why the GPUs of this process cannot run the kernels, or None.

    Args:
      shape: the networks.
      batch: the minibatch.
    """
    # Sizes that no GPU takes.
    outputs = max(shape.outputs)
    if shape.observations > gpu_tiling.MOST_OBSERVATIONS:
        return f"it takes at most {gpu_tiling.MOST_OBSERVATIONS} numbers, not {shape.observations}"
    if outputs > gpu_tiling.MOST_OUTPUTS:
        return f"it takes at most {gpu_tiling.MOST_OUTPUTS} outputs, not {outputs}"
    if shape.width % 16 or shape.width > gpu_tiling.MOST_WIDTH:
        return f"it takes layers of 16, 32, ... {gpu_tiling.MOST_WIDTH} units, not {shape.width}"
    if gpu_tiling.sums_of(shape) > gpu_tiling.MOST_SUMS:
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


class _Launch(NamedTuple):
    """A `_Launch` is a kernel that is being compiled, with its grid."""

    kernel: GpuKernel
    ptx: Future[str]
    blocks: int
    """Blocks of a policy, or of one of its networks."""
    grid: tuple[int, int, int]

    def __call__(
        self,
        arguments: Sequence[Array],
        *results: tuple[int, ...],
        aliases: Mapping[int, int] | None = None,
    ) -> list[Float[Array, "..."]]:
        """Run the kernel, and return float32 arrays of the given shapes."""
        like = [jax.ShapeDtypeStruct(shape, np.float32) for shape in results]
        kernel, ptx = self.kernel, self.ptx.result()
        sizes = self.grid, kernel.threads, kernel.shared_memory
        return gpu.launch_ptx(kernel.name, ptx, arguments, like, *sizes, aliases)


def _begin(kernel: GpuKernel, blocks: int, policies: int, networks: int = 1) -> _Launch:
    """Begin to compile a kernel to PTX, and that to machine code."""
    architecture = gpu.target_architecture()

    def compiled() -> str:
        ptx = gpu.assembled(kernel.text(), architecture, PTX_VERSION)
        gpu.assemble_ahead(ptx)
        return ptx

    return _Launch(kernel, in_background(compiled), blocks, (blocks, networks, policies))


# The kernels by name. What describes a kernel comes first, then its data and how many policies
# share the GPU's multiprocessors.


@functools.cache
def _action_kernel(shape: UpdateShape, batch: Minibatch, policies: int) -> _Launch:
    # The larger the tile, the fewer the blocks: choose both by the multiprocessors of a policy.
    most, environments = _most_blocks(policies), batch.environments
    tiling = gpu_tiling.action_tiling(shape, environments, most, _shared_memory())
    assert tiling is not None
    kernel = ActionKernel(tiling, environments)
    return _begin(kernel, min(most, kernel.tiles), policies)


@functools.cache
def _gradient_kernels(
    shape: UpdateShape, batch: Minibatch, policies: int
) -> tuple[_Launch, _Launch]:
    # Advantages: a tile holds whole unrolls.
    most = _most_blocks(policies)
    tiling = gpu_tiling.advantage_tiling(shape, batch, most, _shared_memory())
    assert tiling is not None
    first = AdvantageKernel(tiling, batch)
    advantage_blocks = min(most, first.tiles)
    # Gradient: half of the blocks compute the policy's gradient, and half the values'.
    tiling = gpu_tiling.gradient_tiling(shape, _shared_memory())
    assert tiling is not None
    second = GradientKernel(tiling, batch, advantage_blocks)
    blocks = max(1, min(most // 2, second.tiles))
    first_launch = _begin(first, advantage_blocks, policies)
    return first_launch, _begin(second, blocks, policies, networks=2)


@functools.cache
def _adam_kernel(rule: AdamRule, batch: Minibatch, policies: int) -> _Launch:
    blocks = min(_most_blocks(policies), -(-rule.shape.size // BLOCK_ELEMENTS))
    return _begin(AdamKernel(rule, blocks), blocks, policies)


_KERNELS: Mapping[str, Callable[..., object]] = {
    "actions": _action_kernel,
    "gradient": _gradient_kernels,
    "adam": _adam_kernel,
}

NAMES: Collection[str] = frozenset(_KERNELS)
"""Names of the kernels, as in `launch.Launcher`."""


def prepare(kernel: Signature, spec: Spec, batch: Minibatch, policies: int) -> None:
    """Divide the work among the blocks, and begin to compile, as `launch.prepare`."""
    _KERNELS[kernel.name](spec, batch, policies)


def launch(kernel: Signature, spec: Spec, batch: Minibatch, arrays: Arrays) -> list[Array]:
    """Launch a kernel while JAX lowers a program for GPUs, as `launch.Launcher` specifies."""
    policies, given = len(next(iter(arrays.values()))), list(arrays.values())
    if isinstance(spec, AdamRule):
        results = [arrays[name].shape for name in kernel.returns]
        return _adam_kernel(spec, batch, policies)(given, *results, aliases=ADAM.aliases)
    assert isinstance(spec, UpdateShape)
    if kernel is ACTIONS:
        shapes = ACTIONS.shapes(spec, batch)
        results = [(policies, *shapes[name]) for name in ACTIONS.returns]
        return _action_kernel(spec, batch, policies)(given, *results)
    # The kernel of the advantages, which also returns the sums of each block, and that of the
    # gradient. Its blocks write a gradient each; they are added up in a fixed order.
    first, second = _gradient_kernels(spec, batch, policies)
    samples = policies, batch.samples
    estimates = first(
        [arrays[name] for name in gpu_advantages.ARGUMENTS],
        *(samples, samples, (policies, first.blocks, 2)),
    )
    all_arrays = {**arrays, **dict(zip(gpu_advantages.RESULTS, estimates, strict=True))}
    given = [all_arrays[name] for name in gpu_gradient.ARGUMENTS]
    (vectors,) = second(given, (policies, second.blocks, spec.size))
    return [vectors.sum(1)]


def _most_blocks(policies: int) -> int:
    """Return the multiprocessors for each of the policies that share the GPU."""
    return max(1, gpu.processor_count() // policies)


def _shared_memory() -> int:
    capability = gpu.compute_capability()
    return _SHARED_MEMORY[max(x for x in _SHARED_MEMORY if x <= capability)] << 10
