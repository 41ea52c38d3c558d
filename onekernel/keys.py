"""Random keys as the words that they consist of, which is how they pass to a kernel and from it."""

import functools
from collections.abc import Hashable

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jaxtyping import Array


def is_key(x: Array | ShapedArray) -> bool:
    """Return whether an array is one of random keys."""
    return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def without_key(x: Array) -> Array:
    """Return an array, or the words of an array of random keys."""
    return jax.random.key_data(x) if is_key(x) else x


def with_key(kind: ShapedArray, x: Array) -> Array:
    """Return an array as it is of a kind; the inverse of `without_key`."""
    return jax.random.wrap_key_data(x, impl=_kind(kind.dtype)) if is_key(kind) else x


def words_of(x: ShapedArray) -> ShapedArray:
    """Return the shape and dtype of an array `without_key`."""
    return jax.eval_shape(without_key, x) if is_key(x) else x


@functools.cache
def _kind(dtype: np.dtype) -> Hashable:
    """Return the kind of the random keys of a dtype, such as "threefry2x32"."""
    found: list[Hashable] = []
    # Only a key can be asked for its kind, and a traced one will do.
    jax.eval_shape(
        lambda key: found.append(jax.random.key_impl(key)), jax.ShapeDtypeStruct((), dtype)
    )
    return found[0]
