"""Draw random numbers on CPUs by one kernel each, with the same result as JAX.

Motivation: XLA compiles a draw of random bits for a CPU to a loop of fourteen kernels, however few
bits it draws, and a training draws in a dozen places. Together they take a third of the time in
which XLA compiles a training step.

A key from `kernel_key` belongs to a generator of random numbers of its own (JAX's
`define_prng_impl`), whose numbers are Threefry's. Functions of `jax.random` take such a key; what
is stored is `raw_key`.
"""

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.random import define_prng_impl, threefry2x32_p
from jaxtyping import Array, Key, PRNGKeyArray, UInt32

from onekernel import default_backend, fuse

Keys = Key[Array, " keys"] | UInt32[Array, "keys 2"]
"""Several keys, as `PRNGKeyArray` is one."""

_MOST_AT_ONCE = 16
"""Largest number of hashes that one kernel computes of a key; more are divided among threads."""


def kernel_key(key: UInt32[Array, "2"]) -> PRNGKeyArray:
    """Return the key that draws the same numbers by kernels; the key itself without kernels.

    A GPU's programs draw as JAX does it, and so do those of a CPU for which there are no kernels.

    Args:
      key: a key as `jax.random.PRNGKey` returns it.
    """
    # Only where there are kernels, and as long as JAX draws as they do.
    backend = default_backend()
    if jax.default_backend() != "cpu" or backend is None or backend.obstacle():
        return key
    if not jax.config.values.get("jax_threefry_partitionable", False):
        return key
    return jax.random.wrap_key_data(key, impl=_generator())


def raw_key(key: Array) -> UInt32[Array, "..."]:
    """Return the words of keys, as `jax.random.PRNGKey` returns them."""
    return jax.random.key_data(key) if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) else key


@functools.cache
def _generator() -> Any:
    """Return JAX's default generator with kernels in the place of what XLA would compile."""
    return define_prng_impl(
        key_shape=(2,),
        seed=lambda seed: jax.random.key_data(jax.random.key(seed, impl="threefry2x32")),
        split=functools.partial(_hashes, is_split=True),
        random_bits=_bits,
        fold_in=_kernel(jax.random.fold_in),
        name="threefry2x32_by_kernel",
        tag="kernel",
    )


def _bits(key: UInt32[Array, "2"], bit_width: int, shape: tuple[int, ...]) -> Array:
    """Return random bits, those of 32 by kernels."""
    if bit_width != 32:
        dtype = np.dtype(f"uint{bit_width}")
        return jax.random.bits(_threefry(key), shape, dtype)
    return _hashes(key, shape, is_split=False)


def _hashes(
    key: UInt32[Array, "2"], shape: tuple[int, ...], *, is_split: bool
) -> UInt32[Array, "..."]:
    """Return the bits of a key, or the keys into which it is split."""
    # Few numbers are drawn by one instance of a kernel, many by an instance for each of them.
    count = math.prod(shape)
    if 0 < count <= _MOST_AT_ONCE:
        return _few(count, is_split)(key).reshape(*shape, *([2] if is_split else []))
    places = jnp.arange(count, dtype=np.uint32)
    words = jax.vmap(_one(is_split), in_axes=(None, 0))(key, places)
    return words.reshape(*shape, *words.shape[1:])


@functools.cache
def _few(count: int, is_split: bool) -> Callable[[Array], Array]:
    """Return the kernel that draws that many numbers or keys."""
    draw = jax.random.split if is_split else jax.random.bits
    return _kernel(lambda key: draw(key, (count,)))


@functools.cache
def _one(is_split: bool) -> Callable[[Array, Array], Array]:
    """Return the kernel of the number or key at one place of many."""

    def hash_of(key: Array, place: Array) -> Array:
        # JAX hashes the place in 64 bits, of which the upper half is zero below 2^32 numbers.
        words = threefry2x32_p.bind(key[0], key[1], jnp.uint32(0), place)
        return jnp.stack(words) if is_split else words[0] ^ words[1]

    return fuse(hash_of, on_unsupported="xla")


def _kernel(function: Callable[..., Array]) -> Callable[..., Array]:
    """Return a function of a key's words and others as a kernel; a resulting key is words, too."""

    def draw(key: Array, *others: Array) -> Array:
        return raw_key(function(_threefry(key), *others))

    return fuse(draw, on_unsupported="xla")


def _threefry(key: UInt32[Array, "2"]) -> PRNGKeyArray:
    return jax.random.wrap_key_data(key, impl="threefry2x32")
