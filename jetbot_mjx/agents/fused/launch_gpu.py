"""Launch the kernels of PPO on NVIDIA GPUs.

All replicas share the launches: they are the third axis of the grid, and each gets its share of the
GPU's multiprocessors. A gradient has a row for each block of a network: in row b, block b of the
policy network writes the policy's part, and block b of the value network the other one. XLA adds up
the rows in a fixed order.
"""

import functools
from collections.abc import Collection
from concurrent.futures import Future

import jax
import numpy as np
from jaxtyping import Array

from jetbot_mjx.agents.fused import gpu_tiling
from jetbot_mjx.agents.fused.adam import AdamRule
from jetbot_mjx.agents.fused.arrays import ACTIONS, ADAM, GRADIENT, Arrays, Signature, Spec
from jetbot_mjx.agents.fused.gpu_actions import ActionKernel
from jetbot_mjx.agents.fused.gpu_adam import BLOCK_ELEMENTS, AdamKernel
from jetbot_mjx.agents.fused.gpu_advantages import AdvantageKernel
from jetbot_mjx.agents.fused.gpu_gradient import GradientKernel
from jetbot_mjx.agents.fused.gpu_tiling import Tiling
from jetbot_mjx.agents.fused.shapes import DataSizes, UpdateShape
from jetbot_mjx.agents.fused.tensor_core import GpuKernel
from onekernel.build import Backend, gpu, in_background

BACKEND: Backend = gpu
"""The back end that compiles the kernels."""

_LEAST_CAPABILITY = 80
"""Ten times the compute capability of the first GPUs with the instruction `mma.m16n8k16`."""

PTX_VERSION = 81
"""Ten times the first version of PTX whose conversions to float16 saturate."""

_SHARED_KIB = {80: 163, 86: 99, 87: 163, 89: 99, 90: 227, 110: 227, 120: 99}
"""Shared memory that a block may have [KiB], by the least compute capability. It is that of a
multiprocessor but for 1 KiB, by NVIDIA's programming guide."""


def refusal(shape: UpdateShape, batch: DataSizes) -> str | None:
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
    if gpu_tiling.best_tiling("gradient", shape, batch, 1, memory) is None:
        return f"the networks do not fit in the {memory // 1024} KiB of shared memory of this GPU"
    if gpu_tiling.best_tiling("advantages", shape, batch, 1, memory) is None:
        return f"unrolls of {batch.time} steps do not fit in the {memory // 1024} KiB of this GPU"
    return None


def _run(kernel: GpuKernel, ptx: str, replicas: int, arrays: Arrays) -> dict[str, Array]:
    """Launch a kernel with some of the arrays, and return its results by name."""
    arguments, names = list(kernel.arguments), kernel.returns
    # What it changes in place has the shape that the argument has.
    shapes = [arrays[x].shape if x in arguments else (replicas, *kernel.shapes[x]) for x in names]
    results = gpu.launch_ptx(
        kernel.name,
        ptx,
        [arrays[name] for name in arguments],
        [jax.ShapeDtypeStruct(shape, np.float32) for shape in shapes],
        (kernel.blocks, kernel.networks, replicas),
        kernel.threads,
        kernel.shared_memory,
        {arguments.index(name): i for i, name in enumerate(names) if name in arguments},
    )
    return dict(zip(names, results, strict=True))


@functools.cache
def _kernels(
    kernel: Signature, spec: Spec, batch: DataSizes, replicas: int
) -> list[tuple[GpuKernel, Future[str]]]:
    """Divide the work among the blocks, and begin to compile the kernels, in their order."""
    # The replicas share the GPU's multiprocessors.
    most = max(1, gpu.processor_count() // replicas)
    if isinstance(spec, AdamRule):
        blocks = min(most, -(-spec.shape.size // BLOCK_ELEMENTS))
        return [_begin(AdamKernel(spec, blocks))]
    assert isinstance(spec, UpdateShape)
    if kernel is ACTIONS:
        tiling, blocks = _division("actions", spec, batch, most)
        return [_begin(ActionKernel(tiling, batch, blocks))]
    # Half of the blocks compute the policy's gradient, and half the values'.
    tiling, advantage_blocks = _division("advantages", spec, batch, most)
    first = AdvantageKernel(tiling, batch, advantage_blocks)
    tiling, blocks = _division("gradient", spec, batch, max(1, most // 2))
    second = GradientKernel(tiling, batch, blocks, advantage_blocks)
    return [_begin(first), _begin(second)]


def _division(purpose: str, shape: UpdateShape, batch: DataSizes, most: int) -> tuple[Tiling, int]:
    """Return the tiling for a purpose, and the number of blocks: no more than the most."""
    tiling = gpu_tiling.best_tiling(purpose, shape, batch, most, _shared_memory())
    assert tiling is not None
    return tiling, min(most, tiling.tiles(batch))


def _begin(kernel: GpuKernel) -> tuple[GpuKernel, Future[str]]:
    """Begin to compile a kernel to PTX, and that to machine code."""
    architecture = gpu.target_architecture()

    def compiled() -> str:
        ptx = gpu.assembled(kernel.text(), architecture, PTX_VERSION)
        gpu.assemble_ahead(ptx)
        return ptx

    return kernel, in_background(compiled)


NAMES: Collection[str] = frozenset(kernel.name for kernel in (ACTIONS, GRADIENT, ADAM))
"""Names of the kernels, as in `launch.Launcher`."""


def prepare(kernel: Signature, spec: Spec, batch: DataSizes, replicas: int) -> None:
    """Begin to compile a kernel, as `launch.prepare`."""
    _kernels(kernel, spec, batch, replicas)


def launch(kernel: Signature, spec: Spec, batch: DataSizes, arrays: Arrays) -> list[Array]:
    """Launch a kernel while JAX lowers a program for GPUs, as `launch.Launcher` specifies."""
    found, replicas = dict(arrays), len(next(iter(arrays.values())))
    for written, ptx in _kernels(kernel, spec, batch, replicas):
        found |= _run(written, ptx.result(), replicas, found)
    # Add up the rows of the blocks.
    if kernel is GRADIENT:
        found["gradient"] = found["gradients"].sum(1)
    return [found[name] for name in kernel.returns]


def _shared_memory() -> int:
    """Return the shared memory that a block may have on this GPU [bytes]."""
    capability = gpu.compute_capability()
    return _SHARED_KIB[max(x for x in _SHARED_KIB if x <= capability)] << 10
