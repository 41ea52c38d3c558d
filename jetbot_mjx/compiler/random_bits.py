"""Compute JAX's random bits on CPUs by one kernel, with the same result.

Motivation: XLA compiles a draw of random bits for a CPU to a loop of fourteen kernels, however few
bits it draws, and a training draws in a dozen places. Together they took a third of the time in
which XLA compiled a training step.
"""

import contextlib
import functools
import math
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.random import threefry2x32_p
from jax.interpreters import mlir
from jaxtyping import Array, UInt32

from jetbot_mjx.compiler import llvm_backend
from jetbot_mjx.compiler.kernel import Kernel
from jetbot_mjx.compiler.lower_jaxpr import scalarize


@contextlib.contextmanager
def by_one_kernel() -> Iterator[None]:
    """Lower draws of random bits for CPUs to one kernel each inside the context.

    Where the kernel cannot be had, or JAX keeps its lowering rules elsewhere, they stay as they
    are. Other threads that lower programs meanwhile get the kernel too. One thread at a time.
    """
    rules = _rules()
    if threefry2x32_p not in rules or not llvm_backend.is_available():
        yield
        return
    before = rules[threefry2x32_p]
    mlir.register_lowering(threefry2x32_p, _rule, platform=llvm_backend.PLATFORM)
    try:
        yield
    finally:
        rules[threefry2x32_p] = before


def _rules() -> dict[Any, Any]:
    """Return JAX's lowering rules for CPUs by primitive; empty if it keeps them elsewhere."""
    internals = getattr(jax, "_src", None)
    module: Any = getattr(getattr(internals, "interpreters", None), "mlir", None)
    return getattr(module, "_platform_specific_lowerings", {}).get(llvm_backend.PLATFORM, {})


@functools.cache
def _kernel() -> Kernel:
    """Return the kernel of one pair of counts (bits of floats, as are the keys)."""

    def step(*words: Array) -> list[Array]:
        first, second, key, other = (x.view(jnp.uint32) for x in words)
        return [x.view(jnp.float32) for x in threefry2x32_p.bind(key, other, first, second)]

    number = jax.ShapeDtypeStruct((), np.float32)
    program = scalarize(step, *[number] * 4)
    return Kernel(program, carried=2, steps=1, fallback=lambda *_: [])


def _lowered(
    key: UInt32[Array, "*k"],
    other: UInt32[Array, "*k"],
    first: UInt32[Array, "*n"],
    second: UInt32[Array, "*n"],
) -> list[Array]:
    """Run the kernel, while JAX lowers a program for CPUs."""
    arguments = first, second, key, other
    shape = np.broadcast_shapes(*(x.shape for x in arguments))
    size = math.prod(shape)
    if size == 0:
        return [jnp.zeros(shape, np.uint32)] * 2
    flat = [jnp.broadcast_to(x, shape).reshape(size) for x in arguments]
    results = [jax.ShapeDtypeStruct((size,), np.uint32)] * 2
    text = _kernel().text(llvm_backend.IMPL, lambda: llvm_backend.kernel_text(_kernel()))
    return [x.reshape(shape) for x in llvm_backend.launch_text(text, flat, results)]


_rule = mlir.lower_fun(_lowered, multiple_results=True)
