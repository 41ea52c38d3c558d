"""Arrays of scalars, and the JAX operations that only move them: slices, gathers and the like.

None of it is arithmetic: where a number goes is known before the program runs.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from jetbot_mjx.compiler.scalar_ir import Scalar, UnsupportedError, is_constant

Numbers = np.ndarray
"""An array of `Scalar`, dtype object."""


def filled(shape: Sequence[int], make: Callable[[], Scalar]) -> Numbers:
    """Return an array of this shape, with one call of `make` for each element."""
    numbers = np.empty(shape, object)
    for place in np.ndindex(*shape):
        numbers[place] = make()
    return numbers


def numbers_of(scalars: Iterable[Scalar], shape: Sequence[int]) -> Numbers:
    """Return an array of this shape from its elements in row-major order."""
    numbers = iter(list(scalars))
    return filled(shape, lambda: next(numbers))


def known_array(array: Any) -> Numbers:
    """Return an array of constants as an array of scalars."""
    array = np.asarray(array)
    return numbers_of(array.ravel(), array.shape)


def known_values(numbers: Numbers, dtype: Any) -> np.ndarray:
    """Convert scalars that are all constants to a plain NumPy array.

    Args:
      numbers: the scalars.
      dtype: dtype of the array.

    Returns:
      The array.

    Raises:
      UnsupportedError: they depend on what the program is given.
    """
    if not all(map(is_constant, numbers.ravel())):
        raise UnsupportedError("an index that depends on the state")
    return np.asarray(list(numbers.ravel()), dtype).reshape(numbers.shape)


def shape_of(variable: Any) -> tuple[int, ...]:
    """Return the shape of a jaxpr variable."""
    return tuple(variable.aval.shape)


def windows(
    shape: Sequence[int],
    indices: np.ndarray,
    *,
    offset_dims: Sequence[int],
    collapsed: Sequence[int],
    index_map: Sequence[int],
    batching: Sequence[int],
    indices_batching: Sequence[int],
    sizes: Sequence[int],
    clip: bool,
) -> np.ndarray:
    """Return the flat operand indices that a gather reads or a scatter writes; -1 means none.

    Source: the semantics of gather and scatter in the StableHLO specification.

    Args:
      shape: shape of the operand.
      indices: where windows begin, along the last axis.
      offset_dims: axes of the result, or of the updates, that lie within a window.
      collapsed: axes of the operand that a window has not.
      index_map: the operand's axis for each number of an index.
      batching: axes of the operand that go along with axes of the indices.
      indices_batching: those axes of the indices.
      sizes: size of a window, along each axis of the operand.
      clip: moves windows inside that reach beyond.

    Returns:
      Places, in the shape of the result or of the updates.
    """
    places = np.arange(int(np.prod(shape, dtype=int))).reshape(shape)
    fixed = (*collapsed, *batching)
    window = [size for axis, size in enumerate(sizes) if axis not in fixed]
    rank = indices.ndim - 1 + len(window)
    batch_dims = [axis for axis in range(rank) if axis not in offset_dims]
    result = np.empty((*indices.shape[:-1], *window), np.int64)
    for at in np.ndindex(*indices.shape[:-1]):
        start = np.zeros(len(shape), np.int64)
        start[list(index_map)] = indices[at]
        for axis, source in zip(batching, indices_batching, strict=True):
            start[axis] = at[source]
        most = np.asarray(shape) - np.asarray(sizes)
        if clip:
            start = np.clip(start, 0, most)
        inside = bool(np.all((start >= 0) & (start <= most)))
        cut = tuple(slice(a, a + n) for a, n in zip(start, sizes, strict=True))
        result[at] = places[cut].reshape(window) if inside else -1
    # Batch axes came first; put each axis where it belongs.
    order = np.argsort([*batch_dims, *offset_dims])
    return result.transpose(order)


def _fill_value(equation: Any) -> float:
    given = equation.params.get("fill_value")
    dtype = equation.outvars[0].aval.dtype
    if given is not None:
        return given
    return np.nan if dtype.kind == "f" else np.iinfo(dtype).min if dtype.kind == "i" else True


def _copy(equation: Any, params: Any, x: Numbers) -> Numbers:
    return x


def _reshape(equation: Any, params: Any, x: Numbers) -> Numbers:
    return x.reshape(shape_of(equation.outvars[0]))


def _slice(equation: Any, params: Any, x: Numbers) -> Numbers:
    strides = params["strides"] or [1] * x.ndim
    bounds = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
    return x[tuple(slice(*bound) for bound in bounds)]


def _broadcast_in_dim(equation: Any, params: Any, x: Numbers) -> Numbers:
    shape = [1] * len(params["shape"])
    for axis, size in zip(params["broadcast_dimensions"], x.shape, strict=True):
        shape[axis] = size
    return np.broadcast_to(x.reshape(shape), params["shape"])


def _transpose(equation: Any, params: Any, x: Numbers) -> Numbers:
    return x.transpose(params["permutation"])


def _rev(equation: Any, params: Any, x: Numbers) -> Numbers:
    return np.flip(x, params["dimensions"])


def _tile(equation: Any, params: Any, x: Numbers) -> Numbers:
    return np.tile(x, params["reps"])


def _concatenate(equation: Any, params: Any, *operands: Numbers) -> Numbers:
    return np.concatenate(operands, params["dimension"])


def _stack(equation: Any, params: Any, *operands: Numbers) -> Numbers:
    return np.stack(operands, params["axis"])


def _unstack(equation: Any, params: Any, x: Numbers) -> list[Numbers]:
    parts = np.split(x, x.shape[params["axis"]], params["axis"])
    return [part.reshape(shape_of(equation.outvars[0])) for part in parts]


def _split(equation: Any, params: Any, x: Numbers) -> list[Numbers]:
    return np.split(x, np.cumsum(params["sizes"])[:-1], params["axis"])


def _pad(equation: Any, params: Any, x: Numbers, padding: Numbers) -> Numbers:
    if any(low < 0 or high < 0 or inside for low, high, inside in params["padding_config"]):
        raise UnsupportedError("padding that is negative or between numbers")
    widths = [(low, high) for low, high, _ in params["padding_config"]]
    padded = filled(shape_of(equation.outvars[0]), padding.item)
    padded[tuple(slice(low, low + n) for (low, _), n in zip(widths, x.shape, strict=True))] = x
    return padded


def _iota(equation: Any, params: Any) -> Numbers:
    shape, axis = params["shape"], params["dimension"]
    counts = np.arange(shape[axis]).astype(params["dtype"])
    counts = counts.reshape([-1 if i == axis else 1 for i in range(len(shape))])
    return known_array(np.broadcast_to(counts, shape))


def _empty(equation: Any, params: Any) -> Numbers:
    variable = equation.outvars[0]
    return known_array(np.zeros(shape_of(variable), variable.aval.dtype))


def _gather(equation: Any, params: Any, x: Numbers, indices: Numbers) -> Numbers:
    numbers = params["dimension_numbers"]
    places = windows(
        x.shape,
        known_values(indices, np.int64),
        offset_dims=numbers.offset_dims,
        collapsed=numbers.collapsed_slice_dims,
        index_map=numbers.start_index_map,
        batching=numbers.operand_batching_dims,
        indices_batching=numbers.start_indices_batching_dims,
        sizes=params["slice_sizes"],
        # XLA also clips indices that are promised to be in bounds.
        clip="FILL" not in str(params["mode"]),
    )
    fill = equation.outvars[0].aval.dtype.type(_fill_value(equation))
    flat = x.ravel()
    numbers = (flat[place] if place >= 0 else fill for place in places.ravel())
    return numbers_of(numbers, shape_of(equation.outvars[0]))


def _sort(equation: Any, params: Any, *operands: Numbers) -> list[Numbers]:
    if params["num_keys"] != 1:
        raise UnsupportedError("sorting by more than one key")
    keys = known_values(operands[0], equation.outvars[0].aval.dtype)
    order = np.argsort(keys, params["dimension"], kind="stable")
    return [np.take_along_axis(x, order, params["dimension"]) for x in operands]


RULES: dict[str, Callable[..., Any]] = {
    "broadcast_in_dim": _broadcast_in_dim,
    "concatenate": _concatenate,
    "copy": _copy,
    "empty": _empty,
    "expand_dims": _reshape,
    "gather": _gather,
    "iota": _iota,
    "pad": _pad,
    "reshape": _reshape,
    "rev": _rev,
    "slice": _slice,
    "sort": _sort,
    "split": _split,
    "squeeze": _reshape,
    "stack": _stack,
    "stop_gradient": _copy,
    "tile": _tile,
    "transpose": _transpose,
    "unstack": _unstack,
}
"""What operations do that only move numbers, by their name in JAX: a function of the equation, its
parameters and its operands."""
