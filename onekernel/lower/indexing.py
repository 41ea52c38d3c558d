"""Lower the JAX operations that only rearrange scalars: slices, gathers, transposes and the like.

They cost nothing in the program, because every index is a constant when the function is lowered.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import cast

import numpy as np
from jax.core import ShapedArray
from jax.extend.core import JaxprEqn, Literal, Var
from numpy.typing import ArrayLike, DTypeLike

from onekernel.errors import UnsupportedError
from onekernel.lower.scalar_ir import Scalar, is_constant

ScalarArray = np.ndarray
"""An array of `Scalar`, dtype object."""

Rule = Callable[..., ScalarArray | list[ScalarArray]]
"""A function that lowers an equation: of the equation and its operands, one array of scalars each.
It returns the result, or a list of them. Some rules take the graph before the equation."""


def full_array(shape: Sequence[int], make: Callable[[], Scalar]) -> ScalarArray:
    """Return an array of the given shape whose elements are results of `make`."""
    return scalar_array((make() for _ in range(math.prod(shape))), shape)


def scalar_array(scalars: Iterable[object], shape: Sequence[int]) -> ScalarArray:
    """Return an array of the given shape from its elements, scalars or random keys, row by row."""
    elements = list(scalars)
    array = np.empty(len(elements), object)
    # Assigned to a slice, the elements stay objects; `np.array` would look into them.
    array[:] = elements
    return array.reshape(shape)


def constant_array(array: ArrayLike) -> ScalarArray:
    """Convert an array of constants to an array of scalars."""
    array = np.asarray(array)
    return scalar_array(array.ravel(), array.shape)


def constant_values(array: ScalarArray, dtype: DTypeLike) -> np.ndarray:
    """Convert scalars that are all constants to a plain NumPy array.

    Args:
      array: the scalars.
      dtype: the dtype of the result.

    Returns:
      The array.

    Raises:
      UnsupportedError: a scalar depends on an input of the program.
    """
    if not all(map(is_constant, array.ravel())):
        raise UnsupportedError("an index that depends on the state")
    return np.asarray(list(array.ravel()), dtype).reshape(array.shape)


def shape_of(variable: Var | Literal) -> tuple[int, ...]:
    """Return the shape of a variable or literal of a jaxpr."""
    return tuple(cast(ShapedArray, variable.aval).shape)


def dtype_of(variable: Var | Literal) -> np.dtype:
    """Return the dtype of a variable or literal of a jaxpr."""
    return cast(ShapedArray, variable.aval).dtype


def fill_value(equation: JaxprEqn) -> float:
    """Return the value that a gather returns for a window outside of its operand."""
    given = equation.params.get("fill_value")
    dtype = dtype_of(equation.outvars[0])
    if given is not None:
        return given
    # JAX's defaults: NaN, the smallest integer with a sign, or all bits set.
    return np.nan if dtype.kind == "f" else np.iinfo(dtype).min if dtype.kind == "i" else True


def _with_shape(equation: JaxprEqn, x: ScalarArray) -> ScalarArray:
    return x.reshape(shape_of(equation.outvars[0]))


def _reshape(equation: JaxprEqn, x: ScalarArray) -> ScalarArray:
    # It may read the axes in another order: `vmap` makes such ones.
    order = equation.params["dimensions"]
    return _with_shape(equation, x if order is None else x.transpose(order))


def _slice(equation: JaxprEqn, x: ScalarArray) -> ScalarArray:
    params = equation.params
    # No strides stand for strides of 1.
    strides = params["strides"] or [1] * x.ndim
    bounds = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
    return x[tuple(slice(*bound) for bound in bounds)]


def _broadcast_in_dim(equation: JaxprEqn, x: ScalarArray) -> ScalarArray:
    # Put the operand's axes where they belong, with axes of length 1 between them.
    shape = [1] * len(equation.params["shape"])
    for axis, size in zip(equation.params["broadcast_dimensions"], x.shape, strict=True):
        shape[axis] = size
    return np.broadcast_to(x.reshape(shape), equation.params["shape"])


def _unstack(equation: JaxprEqn, x: ScalarArray) -> list[ScalarArray]:
    parts = np.split(x, x.shape[equation.params["axis"]], equation.params["axis"])
    return [part.reshape(shape_of(equation.outvars[0])) for part in parts]


def _pad(equation: JaxprEqn, x: ScalarArray, padding: ScalarArray) -> ScalarArray:
    widths = equation.params["padding_config"]
    # Pad between and around the numbers, and then cut off where a width is negative.
    spread = [
        max(n - 1, 0) * (inside + 1) + min(n, 1)
        for n, (*_, inside) in zip(x.shape, widths, strict=True)
    ]
    around = [(max(low, 0), max(high, 0)) for low, high, _ in widths]
    shape = [low + n + high for n, (low, high) in zip(spread, around, strict=True)]
    padded = full_array(shape, padding.item)
    padded[
        tuple(
            slice(low, low + n, inside + 1)
            for n, (low, _), (*_, inside) in zip(spread, around, widths, strict=True)
        )
    ] = x
    return padded[
        tuple(
            slice(max(-low, 0), n - max(-high, 0))
            for n, (low, high, _) in zip(shape, widths, strict=True)
        )
    ]


def _iota(equation: JaxprEqn) -> ScalarArray:
    params = equation.params
    return constant_array(np.indices(params["shape"], params["dtype"])[params["dimension"]])


def _empty(equation: JaxprEqn) -> ScalarArray:
    variable = equation.outvars[0]
    return constant_array(np.zeros(shape_of(variable), dtype_of(variable)))


RULES: dict[str, Rule] = {
    "broadcast_in_dim": _broadcast_in_dim,
    "concatenate": lambda equation, *xs: np.concatenate(xs, equation.params["dimension"]),
    "copy": lambda equation, x: x,
    # The scalars of an instance are where it is computed.
    "device_put": lambda equation, *xs: list(xs),
    "empty": _empty,
    "empty2": _empty,
    "expand_dims": _with_shape,
    "iota": _iota,
    # What `jax.checkpoint` may store has a name.
    "name": lambda equation, x: x,
    "optimization_barrier": lambda equation, *xs: list(xs),
    "pad": _pad,
    "pvary": lambda equation, *xs: list(xs),
    "reshape": _reshape,
    "reshard": lambda equation, x: x,
    "rev": lambda equation, x: np.flip(x, equation.params["dimensions"]),
    "slice": _slice,
    "split": lambda equation, x: np.split(
        x, np.cumsum(equation.params["sizes"])[:-1], equation.params["axis"]
    ),
    "squeeze": _with_shape,
    "stack": lambda equation, *xs: np.stack(xs, equation.params["axis"]),
    "stop_gradient": lambda equation, x: x,
    "tile": lambda equation, x: np.tile(x, equation.params["reps"]),
    "transpose": lambda equation, x: x.transpose(equation.params["permutation"]),
    "unstack": _unstack,
}
"""Lowering rules of operations that only rearrange scalars, by the name of the JAX primitive.

A rule is a function of the equation and its operands."""
