"""A step of one robot as one GPU kernel for all of them.

What `jax.vmap` and XLA make of MJX's step is some 150 kernels, and every number that passes from
one to the next goes through memory. Written out number by number (`scalarize`) the same step is
one kernel (`ptx`) that reads a robot's state, makes all physics steps of an environment
step, and writes the state back.

XLA launches it by its custom call for PTX, an internal mechanism: `is_available` asks the installed
XLA whether it knows it.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap
from jaxtyping import Array, PyTree

from jetbot_mjx import ptx
from jetbot_mjx.scalarize import Program, scalarize

_TARGET = "__gpu$xla.gpu.ptx"
_THREADS = 64
"""In a block: so few that even some thousand robots keep all of a GPU's multiprocessors busy."""

Step = Callable[[PyTree, PyTree], PyTree]
"""Of (what changes, what is held): what changes, some steps later."""


@functools.cache
def is_available() -> bool:
    """Whether JAX runs on an NVIDIA GPU and its XLA launches kernels in PTX."""
    if jax.default_backend() != "gpu" or "cuda" not in jax.devices()[0].client.platform_version:
        return False
    program = scalarize(lambda x: x + 1.0, jnp.zeros(1))
    probe = ptx.make_kernel(program, carried=1, steps=1, robots=2, threads=2, name="probe")
    # Whoever asks may be in the middle of tracing something else.
    with jax.ensure_compile_time_eval():
        zeros = [jnp.zeros((2, 1))]
        try:
            return bool((_launch(probe, zeros, zeros)[0] == 1.0).all())
        except jax.errors.JaxRuntimeError:
            return False


def as_kernel(program: Program, *, carried: int, steps: int, name: str) -> Step:
    """A program repeated in one kernel, for any batch of robots.

    Args:
      program: a step of one robot, float32; its results have the shapes of its first arguments.
      carried: how many leaves of the arguments that are: what changes.
      steps: how often it is repeated.
      name: of the kernel, a C identifier.

    Returns:
      A function of (what changes, what is held), pytrees with the leaves of the program's
      arguments, to be batched by `jax.vmap`. It cannot be differentiated.

    Raises:
      UnsupportedError: the program has an operation that is not written in PTX here.
    """
    write = functools.partial(ptx.make_kernel, program, carried=carried, steps=steps, name=name)
    write(robots=1, threads=1)

    @custom_vmap
    def batch(changing: PyTree, held: PyTree) -> PyTree:
        """For leaves with one batch axis."""
        leaves = jax.tree.leaves((changing, held))
        kernel = write(robots=leaves[0].shape[0], threads=_THREADS)
        results = _launch(kernel, leaves, leaves[:carried])
        return jax.tree.unflatten(jax.tree.structure(changing), results)

    @batch.def_vmap
    def batch_of_batches(
        size: int, batched: Any, changing: PyTree, held: PyTree
    ) -> tuple[PyTree, PyTree]:
        trees = _broadcast(size, tuple(batched), (changing, held))
        flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), trees)
        result = jax.tree.map(lambda x: x.reshape(size, -1, *x.shape[1:]), batch(*flat))
        return result, jax.tree.map(lambda _: True, result)

    @custom_vmap
    def one(changing: PyTree, held: PyTree) -> PyTree:
        """For a single robot."""
        return jax.tree.map(
            lambda x: x[0], batch(*jax.tree.map(lambda x: x[None], (changing, held)))
        )

    @one.def_vmap
    def batch_of_robots(
        size: int, batched: Any, changing: PyTree, held: PyTree
    ) -> tuple[PyTree, PyTree]:
        result = batch(*_broadcast(size, tuple(batched), (changing, held)))
        return result, jax.tree.map(lambda _: True, result)

    return one


def _broadcast(size: int, batched: Any, trees: PyTree) -> PyTree:
    """Gives every leaf the batch axis that some have."""
    return jax.tree.map(
        lambda has, x: x if has else jnp.broadcast_to(x, (size, *x.shape)), batched, trees
    )


def _launch(kernel: ptx.Kernel, leaves: Sequence[Array], results: Sequence[Array]) -> list[Array]:
    """Runs a kernel on leaves of (robots, ...), for results shaped as some of them are."""
    call = jax.ffi.ffi_call(
        _TARGET, [jax.ShapeDtypeStruct(leaf.shape, jnp.float32) for leaf in results]
    )
    return list(
        call(
            *leaves,
            name=kernel.name,
            kernel_type="ptx",
            kernel_data=kernel.source,
            grid_x=np.int64(math.ceil(leaves[0].shape[0] / kernel.threads)),
            grid_y=np.int64(1),
            grid_z=np.int64(1),
            block_x=np.int64(kernel.threads),
            block_y=np.int64(1),
            block_z=np.int64(1),
            shared_mem_bytes=np.int64(0),
            output_indices=tuple(range(len(leaves), len(leaves) + len(results))),
        )
    )
