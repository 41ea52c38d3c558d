"""Compute Cholesky factors of small matrices in scalar arithmetic, without a library call.

MJX passes its 8x8 matrices to LAPACK or cuSOLVER. On a GPU each such call ends the CUDA graph that
could contain the rest of a physics step; on a CPU it stops XLA from fusing the code around it. As
unrolled scalar operations the factorisation compiles like all other arithmetic.
"""

import contextlib
import threading
from collections.abc import Iterator
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_MAX_ROWS = 16
"""Largest number of rows that is unrolled, since the program grows with its cube."""

_library = jax.scipy.linalg.cho_factor, jax.scipy.linalg.cho_solve
_lock = threading.RLock()


@contextlib.contextmanager
def unrolled() -> Iterator[None]:
    """Replace the Cholesky functions of `jax.scipy.linalg` by this module's in a context."""
    # One thread at a time: otherwise a second thread would restore the first one's replacement.
    with (
        _lock,
        mock.patch.object(jax.scipy.linalg, "cho_factor", cho_factor),
        mock.patch.object(jax.scipy.linalg, "cho_solve", cho_solve),
    ):
        yield


def cho_factor(
    a: Float[Array, "n n"], lower: bool = False, **options: Any
) -> tuple[Float[Array, "n n"], bool]:
    """Factorise a symmetric positive definite matrix, A = RᵀR.

        rᵢᵢ = √(aᵢᵢ - Σₖ rₖᵢ²),  rᵢⱼ = (aᵢⱼ - Σₖ rₖᵢ rₖⱼ) / rᵢᵢ,  k < i < j

    Args:
      a: the matrix; if it is not positive definite, the result contains NaN.
      lower: whether to return L = Rᵀ. Lower factors, large matrices and batches are passed to the
        library.
      **options: options of `jax.scipy.linalg.cho_factor`, for the library.

    Returns:
      R, zero below the diagonal, and `lower`.
    """
    if lower or a.ndim != 2 or a.shape[0] > _MAX_ROWS:
        return _library[0](a, lower, **options)
    return _factor(a), False


def cho_solve(
    c_and_lower: tuple[Float[Array, "n n"], bool], b: Float[Array, "n *k"], **options: Any
) -> Float[Array, "n *k"]:
    """Solve A x = b with the factor of A: first Rᵀy = b, then R x = y.

    Args:
      c_and_lower: the result of `cho_factor`.
      b: the right-hand side, or one right-hand side per column.
      **options: options of `jax.scipy.linalg.cho_solve`, for the library.

    Returns:
      The solution x, in the shape of `b`.
    """
    r, lower = c_and_lower
    if lower or r.ndim != 2 or r.shape[0] > _MAX_ROWS:
        return _library[1](c_and_lower, b, **options)
    return _solve(r, b)


# With `jax.jit`, the many small operations are traced once for all programs.
@jax.jit
def _factor(a: Float[Array, "n n"]) -> Float[Array, "n n"]:
    size = a.shape[0]
    zero = jnp.zeros((), a.dtype)
    rows: list[list[Array]] = []
    for i in range(size):
        pivot = jnp.sqrt(_subtract_products(a[i, i], [(row[i], row[i]) for row in rows]))
        inverse = 1.0 / pivot
        right = [
            _subtract_products(a[i, j], [(row[i], row[j]) for row in rows]) * inverse
            for j in range(i + 1, size)
        ]
        rows.append([*[zero] * i, pivot, *right])
    return jnp.stack([jnp.stack(row) for row in rows])


@jax.jit
def _solve(r: Float[Array, "n n"], b: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
    size = r.shape[0]
    inverse = [1.0 / r[i, i] for i in range(size)]
    y: list[Array] = []
    for i in range(size):
        y.append(_subtract_products(b[i], [(r[k, i], y[k]) for k in range(i)]) * inverse[i])
    x: list[Array] = [jnp.zeros_like(b[0])] * size
    for i in reversed(range(size)):
        above = [(r[i, k], x[k]) for k in range(i + 1, size)]
        x[i] = _subtract_products(y[i], above) * inverse[i]
    return jnp.stack(x)


def _subtract_products(start: Array, pairs: list[tuple[Array, Array]]) -> Array:
    """Return start - Σ one · other, in the order of the pairs."""
    for one, other in pairs:
        start = start - one * other
    return start
