"""A step of one robot as one GPU kernel for all of them.

What `jax.vmap` and XLA make of MJX's step is hundreds of kernels, and every number that passes from
one to the next goes through memory. Written out number by number (`scalarize`) the same step is
one kernel (`ptx`) that reads a robot's state, makes all physics steps of an environment
step, and writes the state back.

XLA launches it by its custom call for PTX, an internal mechanism: `is_available` asks the installed
XLA whether it knows it.
"""

import contextlib
import functools
import hashlib
import json
import math
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap
from jaxtyping import Array, PyTree

from jetbot_mjx import ptx, scalars
from jetbot_mjx import scalarize as scalarize_module
from jetbot_mjx.scalarize import scalarize

_TARGET = "__gpu$xla.gpu.ptx"
Step = Callable[[PyTree, PyTree], PyTree]
"""Of (what changes, what is held): what changes, some steps later."""


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
            return bool((_launch(probe, zeros, zeros)[0] == 1.0).all())
        except jax.errors.JaxRuntimeError:
            return False


def batched(kernel: ptx.Kernel) -> Step:
    """A kernel as a function of one robot, for any batch of them.

    Args:
      kernel: of a step; what changes are its first arguments, and its results.

    Returns:
      A function of (what changes, what is held), pytrees with the leaves of the kernel's
      arguments, to be batched by `jax.vmap`. It cannot be differentiated.
    """

    @custom_vmap
    def batch(changing: PyTree, held: PyTree) -> PyTree:
        """For leaves with one batch axis."""
        leaves = jax.tree.leaves((changing, held))
        results = _launch(kernel, leaves, jax.tree.leaves(changing))
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


def kept(key: bytes, write: Callable[[], ptx.Kernel]) -> ptx.Kernel:
    """A kernel's text, from the folder of compiled programs if it was written before.

    Args:
      key: all that the text depends on.
      write: writes the kernel.

    Returns:
      The kernel.
    """
    cache = jax.config.values["jax_compilation_cache_dir"]
    if cache is None:
        return write()
    path = Path(cache) / f"kernel-{hashlib.sha256(key + _own_source()).hexdigest()}.json"
    try:
        return ptx.Kernel(**json.loads(path.read_text()))
    except (OSError, ValueError, TypeError):
        kernel = write()
    # As with compiled programs: a folder that cannot be written costs time, nothing else.
    with contextlib.suppress(OSError), tempfile.TemporaryDirectory(dir=cache) as folder:
        written = Path(folder) / path.name
        written.write_text(json.dumps(kernel._asdict()))
        written.replace(path)
    return kernel


@functools.cache
def _own_source() -> bytes:
    """What turns a step into a kernel."""
    files = [Path(module.__file__ or "") for module in (scalars, scalarize_module, ptx)]
    return b"".join(file.read_bytes() for file in files)


def _broadcast(size: int, batched: Any, trees: PyTree) -> PyTree:
    """Gives every leaf the batch axis that some have."""
    return jax.tree.map(
        lambda has, x: x if has else jnp.broadcast_to(x, (size, *x.shape)), batched, trees
    )


def _launch(kernel: ptx.Kernel, leaves: Sequence[Array], results: Sequence[Array]) -> list[Array]:
    """Runs a kernel on leaves of (robots, ...), for results shaped as some of them are."""
    robots = leaves[0].shape[0]
    call = jax.ffi.ffi_call(
        _TARGET, [jax.ShapeDtypeStruct(leaf.shape, jnp.float32) for leaf in results]
    )
    return list(
        call(
            *leaves,
            name=kernel.name,
            kernel_type="ptx",
            kernel_data=kernel.source(robots),
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
