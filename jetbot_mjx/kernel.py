"""A step of one robot as one kernel for all of them.

What `jax.vmap` and XLA make of MJX's step is hundreds of kernels, and every number that passes from
one to the next goes through memory. Written out number by number (`scalarize`) the same step is
one kernel that reads a robot's state, makes all physics steps of an environment step, and writes
the state back. In which language, and who launches it, is a back end's affair: `gpu` and `cpu`.
"""

import contextlib
import hashlib
import json
import tempfile
import types
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, PyTree

from jetbot_mjx import moving, scalars
from jetbot_mjx import scalarize as scalarize_module
from jetbot_mjx.scalarize import Program

Step = Callable[[PyTree, PyTree], PyTree]
"""Of (what changes, what is held): what changes, some steps later."""


class Kernel(NamedTuple):
    """What a back end is given to run."""

    name: str
    text: str


class Backend(Protocol):
    """Who runs kernels, and in which language; the modules `gpu` and `cpu` are."""

    @property
    def IMPL(self) -> str:
        """Its name in `physics.impl`."""
        ...

    @property
    def NEEDS(self) -> str:
        """What there must be, in words."""
        ...

    def is_available(self) -> bool:
        """Whether JAX runs where this back end does, and all that it needs is there."""
        ...

    def depends_on(self) -> bytes:
        """All that a kernel's text depends on, beside its program."""
        ...

    def write(self, program: Program, *, carried: int, steps: int) -> Kernel:
        """Writes a kernel that repeats a program, its results becoming its first arguments.

        Args:
          program: a step; its results have the shapes of its first `carried` arguments.
          carried: how many leaves of the arguments are carried from step to step.
          steps: how often it is repeated.

        Returns:
          The kernel.

        Raises:
          UnsupportedError: the program has an operation that the back end does not know.
        """
        ...

    def launch(
        self, kernel: Kernel, leaves: Sequence[Array], results: Sequence[Array]
    ) -> list[Array]:
        """Runs a kernel.

        Args:
          kernel: as `write` wrote it.
          leaves: its arguments, float32 of (robots, ...).
          results: those of them that are carried, for their shapes.

        Returns:
          What became of them.
        """
        ...


def batched(backend: Backend, kernel: Kernel) -> Step:
    """A kernel as a function of one robot, for any batch of them.

    Args:
      backend: who runs it.
      kernel: of a step; what changes are its first arguments, and its results.

    Returns:
      A function of (what changes, what is held), pytrees with the leaves of the kernel's
      arguments, to be batched by `jax.vmap`. It cannot be differentiated.
    """

    @custom_vmap
    def batch(changing: PyTree, held: PyTree) -> PyTree:
        """For leaves with one batch axis."""
        leaves = jax.tree.leaves((changing, held))
        results = backend.launch(kernel, leaves, jax.tree.leaves(changing))
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


def kept(key: bytes, write: Callable[[], Kernel]) -> Kernel:
    """A kernel's text, from the folder of compiled programs if it was written before.

    Args:
      key: all that the text depends on, but for how a step is taken apart into numbers.
      write: writes the kernel.

    Returns:
      The kernel.
    """
    key = key + source_of(scalars, moving, scalarize_module)
    content = kept_bytes("kernel", key, lambda: json.dumps(write()._asdict()).encode())
    return Kernel(**json.loads(content))


def kept_bytes(kind: str, key: bytes, make: Callable[[], bytes]) -> bytes:
    """What was made before, from the folder of compiled programs, or what is made now.

    Args:
      kind: with what its file's name begins.
      key: all that it depends on.
      make: makes it.

    Returns:
      The content.
    """
    cache = jax.config.values["jax_compilation_cache_dir"]
    if not cache or not jax.config.values["jax_enable_compilation_cache"]:
        return make()
    path = Path(cache) / f"{kind}-{hashlib.sha256(key).hexdigest()}"
    with contextlib.suppress(OSError):
        digest, _, content = path.read_bytes().partition(b"\n")
        if digest == _digest(content):
            return content
    content = make()
    # As with compiled programs: a folder that cannot be written costs time, nothing else.
    with contextlib.suppress(OSError), tempfile.TemporaryDirectory(dir=cache) as folder:
        written = Path(folder) / path.name
        written.write_bytes(_digest(content) + b"\n" + content)
        written.replace(path)
    return content


def _digest(content: bytes) -> bytes:
    return hashlib.sha256(content).hexdigest().encode()


def source_of(*modules: types.ModuleType) -> bytes:
    """The source of modules: what they write depends on it."""
    return b"".join(Path(module.__file__ or "").read_bytes() for module in modules)


def _broadcast(size: int, batched: Any, trees: PyTree) -> PyTree:
    """Gives every leaf the batch axis that some have."""
    return jax.tree.map(
        lambda has, x: x if has else jnp.broadcast_to(x, (size, *x.shape)), batched, trees
    )
