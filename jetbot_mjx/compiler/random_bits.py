"""Compute JAX's random bits on CPUs by one kernel, with the same result.

Motivation: XLA compiles a draw of random bits for a CPU to a loop of fourteen kernels, however few
bits it draws, and a training draws in a dozen places. Together they took a third of the time in
which XLA compiled a training step.
"""

import contextlib
import functools
import math
from collections.abc import Callable, Iterator, Sequence
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

_MOST_AT_ONCE = 16
"""Largest number of hashes that the kernel of one key computes; more are divided among threads."""


@contextlib.contextmanager
def by_one_kernel() -> Iterator[None]:
    """Lower draws of random bits for CPUs to one kernel each inside the context.

    Where the kernel cannot be had, or JAX keeps its lowering rules elsewhere, they stay as they
    are. Other threads that lower programs meanwhile get the kernel too. One thread at a time.
    """
    rules, defaults = _rules()
    if threefry2x32_p not in rules or llvm_backend.obstacle():
        yield
        return
    ours = {threefry2x32_p: mlir.lower_fun(_threefry, multiple_results=True)}
    for name, function in (("random_bits", _bits), ("random_split", _split)):
        primitive = _primitives()[name]
        if primitive in defaults and primitive not in rules:
            ours[primitive] = _where_possible(function, defaults[primitive])
    before = {primitive: rules[primitive] for primitive in ours if primitive in rules}
    for primitive, rule in ours.items():
        mlir.register_lowering(primitive, rule, platform=llvm_backend.PLATFORM)
    try:
        yield
    finally:
        for primitive in ours:
            del rules[primitive]
        rules |= before


def _rules() -> tuple[dict[Any, Any], dict[Any, Any]]:
    """Return JAX's lowering rules for CPUs and those for all platforms, by primitive.

    They are empty if JAX keeps them elsewhere.
    """
    internals = getattr(jax, "_src", None)
    module: Any = getattr(getattr(internals, "interpreters", None), "mlir", None)
    rules = getattr(module, "_platform_specific_lowerings", {}).get(llvm_backend.PLATFORM, {})
    return rules, getattr(module, "_lowerings", {})


@functools.cache
def _primitives() -> dict[str, Any]:
    """Return JAX's primitives of random numbers by name."""

    def draw(key: Array) -> Any:
        bits = functools.partial(jax.random.bits, shape=(1,))
        return jax.make_jaxpr(lambda key: (bits(key), jax.random.split(key)))(key)

    key = jax.eval_shape(lambda: jax.random.key(0))
    return {equation.primitive.name: equation.primitive for equation in draw(key).jaxpr.eqns}


def _where_possible(function: Callable[..., Array], default: Any) -> Callable[..., Any]:
    """Return a lowering rule that is a function's for 32 bits of Threefry, and JAX's for others."""
    ours = mlir.lower_fun(function, multiple_results=False)
    other = getattr(default, "rule", default)

    def rule(context: Any, *operands: Any, **params: Any) -> Any:
        (keys,) = context.avals_in
        (result,) = context.avals_out
        is_possible = (
            keys.dtype == _key_dtype()
            and params.get("bit_width", 32) == 32
            and jax.config.values.get("jax_threefry_partitionable", False)
            and math.prod(result.shape) > 0
        )
        return (ours if is_possible else other)(context, *operands, **params)

    return rule


@functools.cache
def _key_dtype() -> Any:
    return jax.eval_shape(lambda: jax.random.key(0, impl="threefry2x32")).dtype


def _bits(keys: Array, *, bit_width: int, shape: tuple[int, ...]) -> UInt32[Array, "..."]:
    return _hashes("bits", keys, shape).reshape(*keys.shape, *shape)


def _split(keys: Array, *, shape: tuple[int, ...]) -> Array:
    words = _hashes("split", keys, shape).reshape(*keys.shape, *shape, 2)
    return jax.random.wrap_key_data(words, impl="threefry2x32")


def _hashes(kind: str, keys: Array, shape: tuple[int, ...]) -> UInt32[Array, "..."]:
    """Run the kernel of one kind for all keys, while JAX lowers a program for CPUs."""
    words = jax.random.key_data(keys).reshape(-1, 2)
    count, places = math.prod(shape), []
    if count > _MOST_AT_ONCE:
        # Each key's hashes are divided among the threads, by their places.
        places = [jnp.tile(jnp.arange(count, dtype=np.uint32), len(words))]
        words = jnp.repeat(words, count, axis=0)
        count = 1
    kernel = _kernel(kind, 0 if places else count)
    result = jax.ShapeDtypeStruct((len(words), count * (2 if kind == "split" else 1)), np.uint32)
    return _launch(kernel, [words, *places], [result])[0]


def _threefry(
    key: UInt32[Array, "*k"],
    other: UInt32[Array, "*k"],
    first: UInt32[Array, "*n"],
    second: UInt32[Array, "*n"],
) -> list[Array]:
    """Run the kernel of pairs of counts, while JAX lowers a program for CPUs."""
    arguments = key, other, first, second
    shape = np.broadcast_shapes(*(x.shape for x in arguments))
    size = math.prod(shape)
    if size == 0:
        return [jnp.zeros(shape, np.uint32)] * 2
    flat = [jnp.broadcast_to(x, shape).reshape(size) for x in arguments]
    results = [jax.ShapeDtypeStruct((size,), np.uint32)] * 2
    return [x.reshape(shape) for x in _launch(_kernel("pairs", 0), flat, results)]


def _launch(
    kernel: Kernel, arguments: Sequence[Array], results: Sequence[jax.ShapeDtypeStruct]
) -> list[Array]:
    text = kernel.text(llvm_backend.IMPL, lambda: llvm_backend.kernel_text(kernel))
    return llvm_backend.launch_text(text, arguments, results)


@functools.cache
def _kernel(kind: str, count: int) -> Kernel:
    """Return a kernel, whose arguments and results are the bits of floats.

    Args:
      kind: `pairs`, the hash of two counts under a key; `bits` or `split` of a key.
      count: the number of bits or keys; 0: the one at a given place.
    """

    def function(*words: Array) -> list[Array]:
        numbers = [x.view(jnp.uint32) for x in words]
        if kind == "pairs":
            result = threefry2x32_p.bind(*numbers)
        elif count == 0:
            (key, place), zero = numbers, jnp.uint32(0)
            first, second = threefry2x32_p.bind(key[0], key[1], zero, place)
            result = [first ^ second if kind == "bits" else jnp.stack([first, second])]
        else:
            key = jax.random.wrap_key_data(numbers[0], impl="threefry2x32")
            drawn = jax.random.bits(key, (count,)) if kind == "bits" else None
            result = [jax.random.key_data(jax.random.split(key, count)) if drawn is None else drawn]
        return [x.reshape(-1).view(jnp.float32) for x in result]

    number, pair = (jax.ShapeDtypeStruct(shape, np.float32) for shape in ((), (2,)))
    shapes = [number] * 4 if kind == "pairs" else [pair] if count else [pair, number]
    program = scalarize(function, *shapes)
    return Kernel(program, carried=0, steps=1, fallback=lambda *_: [])
