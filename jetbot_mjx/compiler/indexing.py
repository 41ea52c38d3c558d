"""Lower the JAX operations that only rearrange scalars: slices, gathers, transposes and the like.

They cost nothing in the program, because every index is a constant when the function is lowered.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import numpy as np

from jetbot_mjx.compiler.scalar_ir import Scalar, UnsupportedError, is_constant

ScalarArray = np.ndarray
"""An array of `Scalar`, dtype object."""


def full_array(shape: Sequence[int], make: Callable[[], Scalar]) -> ScalarArray:
    """Return an array of the given shape whose elements are results of `make`."""
    return scalar_array((make() for _ in range(math.prod(shape))), shape)


def scalar_array(scalars: Iterable[Scalar], shape: Sequence[int]) -> ScalarArray:
    """Return an array of the given shape from its elements in row-major order."""
    elements = list(scalars)
    array = np.empty(len(elements), object)
    array[:] = elements
    return array.reshape(shape)


def constant_array(array: Any) -> ScalarArray:
    """Convert an array of constants to an array of scalars."""
    array = np.asarray(array)
    return scalar_array(array.ravel(), array.shape)


def constant_values(array: ScalarArray, dtype: Any) -> np.ndarray:
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


def shape_of(variable: Any) -> tuple[int, ...]:
    """Return the shape of a jaxpr variable."""
    return tuple(variable.aval.shape)


def windows(
    shape: Sequence[int],
    indices: ScalarArray,
    dims: jax.lax.GatherDimensionNumbers,
    sizes: Sequence[int],
    *,
    clip: bool,
) -> np.ndarray:
    """Return the flat operand indices that a gather reads or a scatter writes; -1 means none.

    Source: the semantics of gather and scatter in the StableHLO specification.

    Args:
      shape: the shape of the operand.
      indices: the start indices of the windows, whose components lie along the last axis.
      dims: the roles of the axes; `offset_dims` are axes of the result, or of the updates.
      sizes: the size of a window along each axis of the operand.
      clip: whether windows that reach beyond the operand are moved inside it; otherwise they are
        dropped.

    Returns:
      Flat indices in the shape of the result or of the updates.

    Raises:
      UnsupportedError: a start index depends on an input of the program.
    """
    # Cut the window of every start index out of the flat indices of the operand.
    places = np.arange(int(np.prod(shape, dtype=int))).reshape(shape)
    starts = constant_values(indices, np.int64)
    fixed = (*dims.collapsed_slice_dims, *dims.operand_batching_dims)
    window = [size for axis, size in enumerate(sizes) if axis not in fixed]
    rank = indices.ndim - 1 + len(window)
    batch_dims = [axis for axis in range(rank) if axis not in dims.offset_dims]
    batching = dims.operand_batching_dims, dims.start_indices_batching_dims
    result = np.empty((*indices.shape[:-1], *window), np.int64)
    for at in np.ndindex(*indices.shape[:-1]):
        start = np.zeros(len(shape), np.int64)
        start[list(dims.start_index_map)] = starts[at]
        for axis, source in zip(*batching, strict=True):
            start[axis] = at[source]
        most = np.asarray(shape) - np.asarray(sizes)
        if clip:
            start = np.clip(start, 0, most)
        inside = bool(np.all((start >= 0) & (start <= most)))
        cut = tuple(slice(a, a + n) for a, n in zip(start, sizes, strict=True))
        result[at] = places[cut].reshape(window) if inside else -1
    # Move the window axes from the end to `offset_dims`.
    order = np.argsort([*batch_dims, *dims.offset_dims])
    return result.transpose(order)


def _fill_value(equation: Any) -> float:
    given = equation.params.get("fill_value")
    dtype = equation.outvars[0].aval.dtype
    if given is not None:
        return given
    return np.nan if dtype.kind == "f" else np.iinfo(dtype).min if dtype.kind == "i" else True


def _reshape(equation: Any, x: ScalarArray) -> ScalarArray:
    return x.reshape(shape_of(equation.outvars[0]))


def _slice(equation: Any, x: ScalarArray) -> ScalarArray:
    params = equation.params
    strides = params["strides"] or [1] * x.ndim
    bounds = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
    return x[tuple(slice(*bound) for bound in bounds)]


def _broadcast_in_dim(equation: Any, x: ScalarArray) -> ScalarArray:
    shape = [1] * len(equation.params["shape"])
    for axis, size in zip(equation.params["broadcast_dimensions"], x.shape, strict=True):
        shape[axis] = size
    return np.broadcast_to(x.reshape(shape), equation.params["shape"])


def _unstack(equation: Any, x: ScalarArray) -> list[ScalarArray]:
    parts = np.split(x, x.shape[equation.params["axis"]], equation.params["axis"])
    return [part.reshape(shape_of(equation.outvars[0])) for part in parts]


def _pad(equation: Any, x: ScalarArray, padding: ScalarArray) -> ScalarArray:
    widths = equation.params["padding_config"]
    if any(low < 0 or high < 0 or inside for low, high, inside in widths):
        raise UnsupportedError("padding that is negative or between numbers")
    padded = full_array(shape_of(equation.outvars[0]), padding.item)
    padded[tuple(slice(low, low + n) for (low, *_), n in zip(widths, x.shape, strict=True))] = x
    return padded


def _iota(equation: Any) -> ScalarArray:
    params = equation.params
    return constant_array(np.indices(params["shape"], params["dtype"])[params["dimension"]])


def _empty(equation: Any) -> ScalarArray:
    variable = equation.outvars[0]
    return constant_array(np.zeros(shape_of(variable), variable.aval.dtype))


def _gather(equation: Any, x: ScalarArray, indices: ScalarArray) -> ScalarArray:
    dims, sizes = equation.params["dimension_numbers"], equation.params["slice_sizes"]
    # XLA also clips indices that are promised to be in bounds.
    clip = "FILL" not in str(equation.params["mode"])
    places = windows(x.shape, indices, dims, sizes, clip=clip)
    fill = equation.outvars[0].aval.dtype.type(_fill_value(equation))
    flat = x.ravel()
    scalars = (flat[place] if place >= 0 else fill for place in places.ravel())
    return scalar_array(scalars, shape_of(equation.outvars[0]))


def _sort(equation: Any, *operands: ScalarArray) -> list[ScalarArray]:
    if equation.params["num_keys"] != 1:
        raise UnsupportedError("sorting by more than one key")
    if not all(map(is_constant, operands[0].ravel())):
        raise UnsupportedError("a sort of values that depend on the state")
    keys = constant_values(operands[0], equation.outvars[0].aval.dtype)
    order = np.argsort(keys, equation.params["dimension"], kind="stable")
    return [np.take_along_axis(x, order, equation.params["dimension"]) for x in operands]


RULES: dict[str, Callable[..., Any]] = {
    "broadcast_in_dim": _broadcast_in_dim,
    "concatenate": lambda equation, *xs: np.concatenate(xs, equation.params["dimension"]),
    "copy": lambda equation, x: x,
    "empty": _empty,
    "expand_dims": _reshape,
    "gather": _gather,
    "iota": _iota,
    "pad": _pad,
    # Arrays are on devices; the scalars of one instance are where it is computed.
    "pvary": lambda equation, *xs: list(xs),
    "reshape": _reshape,
    "reshard": lambda equation, x: x,
    "rev": lambda equation, x: np.flip(x, equation.params["dimensions"]),
    "slice": _slice,
    "sort": _sort,
    "split": lambda equation, x: np.split(
        x, np.cumsum(equation.params["sizes"])[:-1], equation.params["axis"]
    ),
    "squeeze": _reshape,
    "stack": lambda equation, *xs: np.stack(xs, equation.params["axis"]),
    "stop_gradient": lambda equation, x: x,
    "tile": lambda equation, x: np.tile(x, equation.params["reps"]),
    "transpose": lambda equation, x: x.transpose(equation.params["permutation"]),
    "unstack": _unstack,
}
"""Lowering rules of operations that only rearrange scalars, by the name of the JAX primitive.

A rule is a function of the equation and its operands."""
