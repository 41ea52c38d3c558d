"""Compute JAX's operations on small matrices in scalar arithmetic, in place of library calls.

JAX passes Cholesky factors and triangular systems to LAPACK, cuSOLVER or cuBLAS, however small the
matrix is. On a GPU each such call ends the CUDA graph that could contain the rest of a program; on
a CPU it stops XLA from fusing the code around it; and no kernel can contain it. Unrolled into
scalar operations they compile like all other arithmetic. Kernels always compute them so;
`unroll_linear_algebra` makes XLA do the same.
"""

import functools
import inspect
from collections.abc import Callable
from typing import TypeVar, cast, overload

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, jaxpr_as_fun
from jaxtyping import Array, Float, PyTree

from onekernel.errors import UnsupportedError

MAX_ROWS = 16
"""Largest number of rows that is unrolled, since the program grows with its cube."""

_F = TypeVar("_F", bound=Callable[..., PyTree])

Expansion = Callable[..., Array | tuple[Array, ...]]
"""A function of the operands of an operation on matrices that returns its result or results."""


def unroll_linear_algebra(function: _F) -> _F:
    """Return a function whose small Cholesky factors and triangular systems are not library calls.

    The function is traced, the operations are replaced wherever they are, also in loops, branches
    and calls, and the new jaxpr is evaluated. The result can be transformed (`jax.jit`, `jax.vmap`,
    `jax.grad`) like the function itself.

    Args:
      function: a function of pytrees of arrays that returns such a pytree.
    """

    @functools.wraps(function)
    def unrolled(*arguments: PyTree) -> PyTree:
        # Trace, replace the operations, and evaluate the new jaxpr, which JAX may be tracing
        # itself.
        closed, shapes = jax.make_jaxpr(function, return_shape=True)(*arguments)
        results = jaxpr_as_fun(_unroll(closed))(*jax.tree.leaves(arguments))
        return jax.tree.unflatten(jax.tree.structure(shapes), results)

    return unrolled  # pyright: ignore[reportReturnType]  # the same signature


def expansion(equation: JaxprEqn) -> Expansion | None:
    """Return a function of an equation's operands that computes it in scalar arithmetic.

    Args:
      equation: an equation of a jaxpr.

    Returns:
      The function. None if the equation is no operation on real matrices of at most `MAX_ROWS`.
    """
    function = _EXPANSIONS.get(equation.primitive.name)
    if function is None:
        return None
    matrix = cast(ShapedArray, equation.invars[0].aval)
    if matrix.shape[-1] > MAX_ROWS or not jnp.issubdtype(matrix.dtype, jnp.floating):
        return None
    # Pass the parameters that the formula has; others do not change the result.
    names = inspect.signature(function).parameters
    return functools.partial(
        function, **{name: x for name, x in equation.params.items() if name in names}
    )


# With `jax.jit`, the many small operations are traced once for all programs.
@jax.jit
@functools.partial(jnp.vectorize, signature="(n,n)->(n,n)")
def cholesky(a: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Factorise a symmetric positive definite matrix, A = L Lᵀ.

        lⱼⱼ = √(aⱼⱼ - Σₖ lⱼₖ²),  lᵢⱼ = (aᵢⱼ - Σₖ lᵢₖ lⱼₖ) / lⱼⱼ,  k < j < i

    Args:
      a: the matrix, of which the lower triangle is read; if it is not positive definite, the result
        contains NaN.

    Returns:
      L, zero above the diagonal.
    """
    size = len(a)
    if not size:
        return a
    # One column after the other, each from those on its left.
    zero = jnp.zeros((), a.dtype)
    columns: list[list[Array]] = []
    for j in range(size):
        pivot = jnp.sqrt(_subtract_products(a[j, j], [(c[j], c[j]) for c in columns]))
        # One division for a column, and products for its entries.
        inverse = 1.0 / pivot
        below = [
            _subtract_products(a[i, j], [(c[j], c[i]) for c in columns]) * inverse
            for i in range(j + 1, size)
        ]
        columns.append([*[zero] * j, pivot, *below])
    return jnp.stack([jnp.stack(column) for column in columns], axis=1)


@functools.partial(
    jax.jit,
    static_argnames=("left_side", "lower", "transpose_a", "conjugate_a", "unit_diagonal"),
)
def triangular_solve(
    a: Float[Array, "*batch n n"],
    b: Float[Array, "*batch rows columns"],
    *,
    left_side: bool,
    lower: bool,
    transpose_a: bool,
    conjugate_a: bool,
    unit_diagonal: bool,
) -> Float[Array, "*batch rows columns"]:
    """Solve T X = B or X T = B, where T is A or Aᵀ.

        xᵢ = (bᵢ - Σₖ tᵢₖ xₖ) / tᵢᵢ,  with all k that come before i

    Args:
      a: A, of which one triangle is read.
      b: B.
      left_side: whether T is on the left of X.
      lower: whether the lower triangle of A is read; otherwise the upper one.
      transpose_a: whether T is Aᵀ.
      conjugate_a: whether A is conjugated, which changes no real matrix.
      unit_diagonal: whether the diagonal of T is 1, whatever is in A.

    Returns:
      X.
    """
    # X T = B is Tᵀ Xᵀ = Bᵀ.
    if transpose_a == left_side:
        a, lower = a.mT, not lower

    @functools.partial(jnp.vectorize, signature="(n,n),(n,m)->(n,m)")
    def solve(t: Float[Array, "n n"], b: Float[Array, "n m"]) -> Float[Array, "n m"]:
        size = len(t)
        if not size:
            return b
        # Forwards through a lower triangle, backwards through an upper one.
        x: list[Array] = [jnp.zeros_like(b[0])] * size
        for i in range(size) if lower else reversed(range(size)):
            before = range(i) if lower else range(i + 1, size)
            x[i] = _subtract_products(b[i], [(t[i, k], x[k]) for k in before])
            if not unit_diagonal:
                x[i] = x[i] * (1.0 / t[i, i])
        return jnp.stack(x)

    return solve(a, b) if left_side else solve(a, b.mT).mT


@jax.jit
@functools.partial(jnp.vectorize, signature="(m,n)->(m,n),(k),(m)")
def lu(a: Float[Array, "m n"]) -> tuple[Array, Array, Array]:
    """Factorise a matrix with row exchanges, P A = L U.

    Args:
      a: A.

    Returns:
      U and, below its diagonal, L without its diagonal of ones; the row that each row was exchanged
      with; and the rows of A in their new order.
    """
    # A row is an array, and which row it is in A is kept beside it.
    rows, order = list(a), [jnp.int32(i) for i in range(len(a))]
    pivots = []
    for k in range(min(a.shape)):
        # Find the largest number of the column, and exchange its row with this one.
        column = jnp.stack([jnp.abs(row[k]) for row in rows[k:]])
        pivot = jnp.argmax(column).astype(jnp.int32) + k
        pivots.append(pivot)
        # Which row is the pivot is known only when the program runs: each row may take part in the
        # exchange.
        for each in (rows, order):
            first, found = each[k], each[k]
            for i in range(k + 1, len(a)):
                found = jnp.where(pivot == i, each[i], found)
                each[i] = jnp.where(pivot == i, first, each[i])
            each[k] = found
        # Subtract its multiples from the rows below; LAPACK leaves a column of zeros as it is.
        diagonal = jnp.where(rows[k][k] == 0, 1, rows[k][k])
        for i in range(k + 1, len(a)):
            factor = rows[i][k] / diagonal
            below = rows[i][k + 1 :] - factor * rows[k][k + 1 :]
            rows[i] = jnp.concatenate([rows[i][:k], factor[None], below])
    return jnp.stack(rows), jnp.stack(pivots), jnp.stack(order)


def qr(
    a: Float[Array, "*batch m n"], *, full_matrices: bool, pivoting: bool
) -> tuple[Array, Array]:
    """Factorise a matrix by Householder's reflections, A = Q R, with LAPACK's signs.

    Args:
      a: A.
      full_matrices: whether Q is square.
      pivoting: must be False.

    Raises:
      UnsupportedError: columns would be exchanged.
    """
    if pivoting:
        raise UnsupportedError("a QR factorisation with pivoting")
    rows, columns = a.shape[-2:]
    # Columns of Q that are returned.
    kept = rows if full_matrices else min(rows, columns)

    @functools.partial(jnp.vectorize, signature="(m,n)->(m,k),(k,n)")
    def factorise(r: Array) -> tuple[Array, Array]:
        reflections = []
        for k in range(min(rows - 1, columns)):
            # Reflect the rest of the column onto its first entry.
            first, rest = r[k, k], r[k + 1 :, k]
            # The reflection I - factor · v vᵀ maps the column to (wanted, 0, ..., 0). `wanted` has
            # the sign that avoids cancellation. A column that is zero below the diagonal needs
            # none.
            square = jnp.sum(rest * rest)
            norm = jnp.sqrt(first * first + square)
            wanted = jnp.where(first < 0, norm, -norm)
            is_done = square == 0
            vector = jnp.where(is_done, 0.0, rest / jnp.where(is_done, 1.0, first - wanted))
            factor = jnp.where(is_done, 0.0, (wanted - first) / jnp.where(is_done, 1.0, wanted))
            vector = jnp.concatenate([jnp.zeros(k, a.dtype), jnp.ones(1, a.dtype), vector])
            r = r - factor * jnp.outer(vector, vector @ r)
            reflections.append((factor, vector))
        # Q is the product of all reflections, applied from the last to the first.
        q = jnp.eye(rows, kept, dtype=a.dtype)
        for factor, vector in reversed(reflections):
            q = q - factor * jnp.outer(vector, vector @ q)
        return q, jnp.triu(r)[:kept]

    return factorise(a)


def _subtract_products(start: Array, pairs: list[tuple[Array, Array]]) -> Array:
    """Return start - Σ one · other, in the order of the pairs."""
    for one, other in pairs:
        start = start - one * other
    return start


_EXPANSIONS: dict[str, Expansion] = {
    "cholesky": cholesky,
    "lu": lu,
    "qr": qr,
    "triangular_solve": triangular_solve,
}
"""Functions that compute the JAX primitive of a name, with its parameters as keywords."""


@overload
def _unroll(jaxpr: ClosedJaxpr) -> ClosedJaxpr: ...


@overload
def _unroll(jaxpr: object) -> object: ...


def _unroll(jaxpr: object) -> object:
    """Return a jaxpr with a call of its expansion in place of each operation that has one.

    Anything but a jaxpr is returned as it is.
    """
    # Since JAX 0.12 a `Jaxpr` is a `ClosedJaxpr` too.
    if isinstance(jaxpr, Jaxpr):
        return jaxpr.replace(eqns=[_unroll_equation(equation) for equation in jaxpr.eqns])
    if isinstance(jaxpr, ClosedJaxpr):
        return jaxpr.replace(jaxpr=_unroll(jaxpr.jaxpr))
    return jaxpr


def _unroll_equation(equation: JaxprEqn) -> JaxprEqn:
    function = expansion(equation)
    if function is None:
        # The bodies of loops, branches and calls are parameters, some of them in tuples.
        return equation.replace(params=jax.tree.map(_unroll, equation.params))
    operands = [x.aval for x in equation.invars]
    # Trace a call of the expansion as one equation, whose primitive and parameters replace the
    # operation's.
    with jax.disable_jit(False):
        (call,) = jax.make_jaxpr(jax.jit(function))(*operands).jaxpr.eqns
    return equation.replace(primitive=call.primitive, params=call.params)
