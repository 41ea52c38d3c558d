"""Cholesky factors of small matrices in scalar arithmetic, in the place of the library's.

MJX hands its 8x8 matrices to LAPACK or cuSOLVER. On a GPU each such call ends the CUDA graph that
the rest of a physics step would fit into; on a CPU it stops XLA from fusing what surrounds
it. Written out, the factor is arithmetic like any other, batched by `jax.vmap` as it stands.
"""

import contextlib
import threading
from collections.abc import Iterator
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_LARGEST = 16
"""Rows beyond which the library is the better choice: the program grows with their cube."""

_library = jax.scipy.linalg.cho_factor, jax.scipy.linalg.cho_solve
_lock = threading.RLock()


@contextlib.contextmanager
def unrolled() -> Iterator[None]:
    """Let what is traced inside factorise by this module instead of `jax.scipy.linalg`."""
    # One thread at a time: of two that replace and restore, the second would keep the first's.
    with (
        _lock,
        mock.patch.object(jax.scipy.linalg, "cho_factor", cho_factor),
        mock.patch.object(jax.scipy.linalg, "cho_solve", cho_solve),
    ):
        yield


def cho_factor(
    a: Float[Array, "n n"], lower: bool = False, **options: Any
) -> tuple[Float[Array, "n n"], bool]:
    """Factor of a symmetric positive definite matrix, A = RᵀR.

        rᵢᵢ = √(aᵢᵢ - Σₖ rₖᵢ²),  rᵢⱼ = (aᵢⱼ - Σₖ rₖᵢ rₖⱼ) / rᵢᵢ,  k < i < j

    Args:
      a: the matrix; NaN comes out where it is not positive definite.
      lower: whether L = Rᵀ is wanted; as all that is not small and upper, the library's part.
      **options: of `jax.scipy.linalg.cho_factor`.

    Returns:
      R, zero below the diagonal, and `lower`.
    """
    if lower or a.ndim != 2 or a.shape[0] > _LARGEST:
        return _library[0](a, lower, **options)
    return _factor(a), False


def cho_solve(
    c_and_lower: tuple[Float[Array, "n n"], bool], b: Float[Array, "n *k"], **options: Any
) -> Float[Array, "n *k"]:
    """Solve A x = b from the factor of A: Rᵀy = b, then R x = y.

    Args:
      c_and_lower: as `cho_factor` gives it.
      b: right-hand side, or one in each column.
      **options: of `jax.scipy.linalg.cho_solve`.

    Returns:
      x.
    """
    r, lower = c_and_lower
    if lower or r.ndim != 2 or r.shape[0] > _LARGEST:
        return _library[1](c_and_lower, b, **options)
    return _solve(r, b)


# Under `jax.jit`, so that the many small steps are traced once, however many programs they are in.
@jax.jit
def _factor(a: Float[Array, "n n"]) -> Float[Array, "n n"]:
    size = a.shape[0]
    zero = jnp.zeros((), a.dtype)
    rows: list[list[Array]] = []
    for i in range(size):
        pivot = jnp.sqrt(_less_products(a[i, i], [(row[i], row[i]) for row in rows]))
        inverse = 1.0 / pivot
        right = [
            _less_products(a[i, j], [(row[i], row[j]) for row in rows]) * inverse
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
        y.append(_less_products(b[i], [(r[k, i], y[k]) for k in range(i)]) * inverse[i])
    x: list[Array] = [jnp.zeros_like(b[0])] * size
    for i in reversed(range(size)):
        above = [(r[i, k], x[k]) for k in range(i + 1, size)]
        x[i] = _less_products(y[i], above) * inverse[i]
    return jnp.stack(x)


def _less_products(start: Array, pairs: list[tuple[Array, Array]]) -> Array:
    for one, other in pairs:
        start = start - one * other
    return start
