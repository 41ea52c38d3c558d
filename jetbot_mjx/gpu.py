"""Kernels in PTX on NVIDIA GPUs: a `jetbot_mjx.kernel.Backend`.

XLA launches them by its custom call for PTX, an internal mechanism: `is_available` asks the
installed XLA whether it knows it.
"""

import functools
import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jetbot_mjx import ptx
from jetbot_mjx.kernel import Kernel, source_of
from jetbot_mjx.scalarize import Program, scalarize

IMPL = "ptx"
NEEDS = "an NVIDIA GPU and an XLA that launches PTX"

_TARGET = "__gpu$xla.gpu.ptx"


@functools.cache
def is_available() -> bool:
    """Whether JAX runs on an NVIDIA GPU and its XLA launches kernels in PTX."""
    if jax.default_backend() != "gpu" or "cuda" not in jax.devices()[0].client.platform_version:
        return False
    program = scalarize(lambda x: x + 1.0, jnp.zeros(1))
    probe = ptx.make_kernel(program, carried=1, steps=1, name="probe")
    # Whoever asks may be in the middle of tracing something else.
    with jax.ensure_compile_time_eval():
        zeros = [jnp.zeros((2, 1))]
        try:
            return bool((launch(probe, zeros, zeros)[0] == 1.0).all())
        except jax.errors.JaxRuntimeError:
            return False


def depends_on() -> bytes:
    """All that a kernel's text depends on, beside its program."""
    return source_of(ptx)


def write(program: Program, *, carried: int, steps: int) -> Kernel:
    """Writes a kernel, as `jetbot_mjx.kernel.Backend` has it."""
    return ptx.make_kernel(program, carried=carried, steps=steps, name="physics")


def launch(kernel: Kernel, leaves: Sequence[Array], results: Sequence[Array]) -> list[Array]:
    """Runs a kernel, as `jetbot_mjx.kernel.Backend` has it."""
    robots = leaves[0].shape[0]
    call = jax.ffi.ffi_call(
        _TARGET, [jax.ShapeDtypeStruct(leaf.shape, jnp.float32) for leaf in results]
    )
    return list(
        call(
            *leaves,
            name=kernel.name,
            kernel_type="ptx",
            kernel_data=ptx.source(kernel, robots),
            grid_x=np.int64(math.ceil(robots / ptx.THREADS)),
            grid_y=np.int64(1),
            grid_z=np.int64(1),
            block_x=np.int64(ptx.THREADS),
            block_y=np.int64(1),
            block_z=np.int64(1),
            shared_mem_bytes=np.int64(0),
            output_indices=tuple(range(len(leaves), len(leaves) + len(results))),
        )
    )
