"""Run a step of one robot as one kernel for all robots.

Motivation: `jax.vmap` and XLA compile MJX's step to hundreds of kernels, and every value that
passes from one kernel to the next goes through memory. Lowered to scalars (`scalarize`), the same
step is one kernel that reads a robot's state, runs all physics steps of an environment step, and
writes the state back.

Protocol: for JAX the kernel is a primitive.

1. `as_step` binds the primitive to the leaves of (carry, consts) of one robot, all float32.
2. The batching rule of `jax.vmap` puts any number of batch axes into one launch.
3. The primitive is lowered for the platform that a program is compiled for, whatever the
   process's default is, so that programs for CPUs and GPUs can exist side by side. The back end
   (`ptx_backend` or `llvm_backend`) compiles and launches the kernel; without one, `auto` runs the
   fallback in JAX, and any other `physics.impl` raises a `UserError`.
4. Differentiation raises a `UserError`.
"""

import contextlib
import functools
import hashlib
import math
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, PyTree

from jetbot_mjx.compiler.lower_jaxpr import ScalarProgram
from jetbot_mjx.compiler.trusted_files import read_trusted, write_private
from jetbot_mjx.errors import UserError

Step = Callable[[PyTree, PyTree], PyTree]
"""A function of (carry, consts) that returns the carry some steps later."""


class Kernel:
    """A step of one robot that a back end can run for many; kernels are compared by identity."""

    def __init__(
        self,
        program: ScalarProgram,
        *,
        carried: int,
        steps: int,
        fallback: Callable[..., list[Array]],
        impl: str = "auto",
    ) -> None:
        """Describe a kernel that repeats a program, its results becoming its first arguments.

        Args:
          program: a step; its results have the shapes of its first `carried` arguments.
          carried: how many leaves of the arguments are carried from step to step.
          steps: how often it is repeated.
          fallback: the same in JAX, of one robot and a flat list of all leaves, for platforms
            without a back end.
          impl: the back end that must run it; `auto`: the one of the platform, or the fallback.
        """
        self.program = program
        self.carried = carried
        self.steps = steps
        self.fallback = fallback
        self.impl = impl
        self._texts: dict[str, str] = {}
        # ProgramCache are lowered in several threads.
        self._lock = threading.Lock()

    def text(self, name: str, write: Callable[[], str]) -> str:
        """Return the text under a name, written when it is first asked for."""
        with self._lock:
            if name not in self._texts:
                self._texts[name] = write()
            return self._texts[name]


class Backend(Protocol):
    """The interface of a back end, which compiles and launches kernels."""

    @property
    def IMPL(self) -> str:
        """Return the back end's name in `physics.impl`."""
        ...

    @property
    def PLATFORM(self) -> str:
        """Return the JAX platform that the back end serves."""
        ...

    @property
    def NEEDS(self) -> str:
        """Return a description of what must be installed or present."""
        ...

    def is_available(self) -> bool:
        """Return whether JAX knows the platform and all requirements of the back end are met."""
        ...

    def launch(self, kernel: Kernel, leaves: Sequence[Array]) -> list[Array]:
        """Run a kernel; called while a program for the platform is lowered.

        Args:
          kernel: the kernel.
          leaves: its arguments, float32 of (robots, ...).

        Returns:
          The new values of the carried arguments.
        """
        ...


def as_step(kernel: Kernel) -> Step:
    """Return a kernel as a JAX function of one robot, which `jax.vmap` can batch.

    Args:
      kernel: the kernel of a step.

    Returns:
      A function of (carry, consts), pytrees with the leaves of the kernel's arguments, which must
      be float32. It cannot be differentiated.
    """

    def step(carry: PyTree, consts: PyTree) -> PyTree:
        results = _kernel_p.bind(*jax.tree.leaves((carry, consts)), kernel=kernel)
        return jax.tree.unflatten(jax.tree.structure(carry), results)

    return step


_kernel_p = Primitive("robot_kernel")
_kernel_p.multiple_results = True


def _batch_shape(kernel: Kernel, leaves: Sequence[Any]) -> tuple[int, ...]:
    """Return the batch axes that all arguments have in front of the axes of one robot.

    Raises:
      UserError: an argument is not float32.
      ValueError: an argument has another shape.
    """
    shapes = [numbers.shape for numbers in kernel.program.inputs]
    batch = leaves[0].shape[: leaves[0].ndim - len(shapes[0])]
    for leaf, shape in zip(leaves, shapes, strict=True):
        if leaf.dtype != np.float32:
            raise UserError(
                f"one kernel steps float32 only, not {leaf.dtype}: cast it, or choose"
                " physics.impl = xla"
            )
        if leaf.shape != (*batch, *shape):
            raise ValueError(f"an argument of shape {leaf.shape}, not {(*batch, *shape)}")
    return batch


@_kernel_p.def_abstract_eval
def _abstract(*leaves: Any, kernel: Kernel) -> list[ShapedArray]:
    _batch_shape(kernel, leaves)
    return [ShapedArray(leaf.shape, leaf.dtype) for leaf in leaves[: kernel.carried]]


@_kernel_p.def_impl
def _run(*leaves: Any, kernel: Kernel) -> list[Array]:
    # Also within `jax.disable_jit`, where this would otherwise call itself.
    with jax.disable_jit(False):
        return _compiled(*leaves, kernel=kernel)


@functools.partial(jax.jit, static_argnames="kernel")
def _compiled(*leaves: Array, kernel: Kernel) -> list[Array]:
    return _kernel_p.bind(*leaves, kernel=kernel)


def _batch(
    leaves: Sequence[Array], axes: Sequence[int | None], *, kernel: Kernel
) -> tuple[list[Array], list[int]]:
    (size,) = {x.shape[axis] for x, axis in zip(leaves, axes, strict=True) if axis is not None}
    leaves = [
        jnp.broadcast_to(x, (size, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(leaves, axes, strict=True)
    ]
    results = _kernel_p.bind(*leaves, kernel=kernel)
    return results, [0] * len(results)


batching.primitive_batchers[_kernel_p] = _batch


def _differentiate(primals: Any, tangents: Any, *, kernel: Kernel) -> Any:
    raise UserError(
        "physics as one kernel cannot be differentiated: choose physics.impl = xla; for jax.grad"
        " and other reverse modes also physics.iterations = 1, for MJX's solver is a loop"
    )


ad.primitive_jvps[_kernel_p] = _differentiate


def _lowered(backend: Backend | None) -> Callable[..., list[Array]]:
    """Return the function that is lowered for a platform; None stands for any other platform."""

    def lowered(*leaves: Array, kernel: Kernel) -> list[Array]:
        batch = _batch_shape(kernel, leaves)
        robots = math.prod(batch)
        flat = [
            x.reshape(robots, *numbers.shape)
            for x, numbers in zip(leaves, kernel.program.inputs, strict=True)
        ]
        if backend and kernel.impl in ("auto", backend.IMPL) and backend.is_available():
            results = backend.launch(kernel, flat)
        elif kernel.impl == "auto":
            results = jax.vmap(lambda *leaves: kernel.fallback(*leaves))(*flat)
        else:
            raise UserError(
                f"physics.impl = {kernel.impl}: this program is for"
                f" {backend.PLATFORM if backend else 'another platform'}: choose xla or auto"
            )
        return [x.reshape(leaf.shape) for x, leaf in zip(results, leaves, strict=False)]

    return lowered


def register(*backends: Backend) -> None:
    """Make back ends known to JAX."""
    mlir.register_lowering(_kernel_p, mlir.lower_fun(_lowered(None), multiple_results=True))
    for backend in backends:
        mlir.register_lowering(
            _kernel_p,
            mlir.lower_fun(_lowered(backend), multiple_results=True),
            platform=backend.PLATFORM,
        )


def kept_bytes(kind: str, key: bytes, make: Callable[[], bytes]) -> bytes:
    """Return cached bytes from the folder of compiled programs, or make and cache them.

    Args:
      kind: the prefix of the file's name.
      key: everything that the content depends on.
      make: returns the content when it is not cached.

    Returns:
      The content.
    """
    cache = jax.config.values["jax_compilation_cache_dir"]
    if not cache or not jax.config.values["jax_enable_compilation_cache"]:
        return make()
    path = Path(cache) / f"{kind}-{hashlib.sha256(key).hexdigest()}"
    digest, _, content = (read_trusted(path) or b"").partition(b"\n")
    if digest == _digest(content):
        return content
    content = make()
    # As with compiled programs, a folder that cannot be written only costs time.
    with contextlib.suppress(OSError):
        write_private(path, _digest(content) + b"\n" + content)
    return content


def _digest(content: bytes) -> bytes:
    return hashlib.sha256(content).hexdigest().encode()
