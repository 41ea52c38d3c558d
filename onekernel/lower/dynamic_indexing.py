"""Lower reads and writes at indices that are known only when the program runs.

Scalars are in registers, which have no addresses. So a read at an unknown index compares the index
with every place where it may point, and selects among the scalars there. That pays off for arrays
of tens of numbers. An index that is a constant costs nothing, as in `indexing`.

A rule is a function of the graph, the equation and its operands.
"""

import functools
import math
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import JaxprEqn

from onekernel.errors import UnsupportedError
from onekernel.lower.indexing import (
    Rule,
    ScalarArray,
    dtype_of,
    fill_value,
    scalar_array,
    shape_of,
)
from onekernel.lower.random_rules import Key, select
from onekernel.lower.scalar_ir import (
    ExprGraph,
    Scalar,
    bits_of,
    check_scalars,
    is_constant,
    is_same,
)

_INT = np.dtype(np.int32)

MAX_PLACES = 256
"""Largest number of places among which an index may choose; beyond, numbers are read from memory,
and none are written."""


def _check_places(count: int) -> None:
    if count > MAX_PLACES:
        raise UnsupportedError(f"an index that depends on the state, with {count} places")


def read_at(graph: ExprGraph, scalars: Sequence[Scalar], index: Scalar) -> Scalar:
    """Read one of some scalars of one dtype from memory.

    Args:
      graph: the graph.
      scalars: the scalars, at least one.
      index: which of them, int32; the caller makes sure that there is one.
    """
    check_scalars(scalars)
    first, *others = scalars
    if all(is_same(first, x) for x in others):
        return first
    # Memory holds words of 32 and 64 bits: a bool is 0 or 1.
    words = [graph.convert(x, _INT) if x.dtype == bool else x for x in scalars]
    return graph.convert(graph.load(graph.array(words), index), first.dtype)


def _clipped(graph: ExprGraph, start: Scalar, last: int) -> Scalar:
    """Return a start index, moved into 0 ... last."""
    if is_constant(start):
        return np.int32(min(max(int(start), 0), last))
    kind = start.dtype.type
    return graph.apply("min", graph.apply("max", start, kind(0)), kind(last))


def _is_inside(graph: ExprGraph, start: Scalar, last: int) -> Scalar:
    """Return whether a start index is in 0 ... last."""
    if is_constant(start):
        return np.bool_(0 <= int(start) <= last)
    kind = start.dtype.type
    above = graph.apply("ge", start, kind(0))
    return graph.apply("and", above, graph.apply("le", start, kind(last)))


def _select(
    graph: ExprGraph, condition: Scalar, if_false: ScalarArray, if_true: ScalarArray
) -> ScalarArray:
    pairs = zip(if_false.ravel(), if_true.ravel(), strict=True)
    return scalar_array((select(graph, condition, *pair) for pair in pairs), if_true.shape)


def _read_window(
    graph: ExprGraph, x: ScalarArray, starts: Sequence[Scalar], sizes: Sequence[int]
) -> ScalarArray:
    """Return the window of an array that begins at the given index of each axis, moved inside."""
    for axis, (start, size) in enumerate(zip(starts, sizes, strict=True)):
        last = x.shape[axis] - size
        at = _clipped(graph, start, last)
        # The usual case: a constant index only picks scalars.
        if is_constant(at):
            x = np.take(x, range(int(at), int(at) + size), axis)
            continue
        x = _read_along(graph, x, axis, at, last, size)
    return x


def _read_along(
    graph: ExprGraph, x: ScalarArray, axis: int, at: Scalar, last: int, size: int
) -> ScalarArray:
    """Return `size` entries of one axis from an index on, which is in 0 ... last."""
    kind = at.dtype.type
    # Among many places, read each number of the window at an address.
    if last >= MAX_PLACES:
        columns = np.moveaxis(x, axis, 0)
        begin = graph.convert(at, _INT)
        window = np.empty((size, *columns.shape[1:]), object)
        for place in np.ndindex(*window.shape):
            index = graph.apply("add", begin, np.int32(place[0]))
            window[place] = read_at(graph, list(columns[(slice(None), *place[1:])]), index)
        return np.moveaxis(window, 0, axis)
    # All windows that may be meant, in order; one of them remains.
    cases = [np.take(x, range(i, i + size), axis) for i in range(last + 1)]
    # Halve the candidates in each round, like a tournament: of two neighbours, the index keeps the
    # second if it has reached it. The depth grows with the logarithm of the number of places.
    found = list(enumerate(cases))
    while len(found) > 1:
        rounds = []
        for (first, low), (middle, high) in zip(found[::2], found[1::2], strict=False):
            is_high = graph.apply("ge", at, kind(middle))
            rounds.append((first, _select(graph, is_high, low, high)))
        found = rounds + ([found[-1]] if len(found) % 2 else [])
    return found[0][1]


def _dynamic_slice(
    graph: ExprGraph, equation: JaxprEqn, x: ScalarArray, *starts: ScalarArray
) -> ScalarArray:
    # JAX moves a window that would reach beyond the array back inside.
    sizes = equation.params["slice_sizes"]
    return _read_window(graph, x, [start.item() for start in starts], sizes)


def _dynamic_update_slice(
    graph: ExprGraph, equation: JaxprEqn, x: ScalarArray, update: ScalarArray, *starts: ScalarArray
) -> ScalarArray:
    lasts = [n - size for n, size in zip(x.shape, update.shape, strict=True)]
    places = [
        _clipped(graph, start.item(), last) for start, last in zip(starts, lasts, strict=True)
    ]
    return _write_window(graph, x, places, update, np.bool_(True), lambda old, new: new)


def _write_window(
    graph: ExprGraph,
    x: ScalarArray,
    starts: Sequence[Scalar],
    update: ScalarArray,
    is_written: Scalar,
    combine: Callable[[Scalar, Scalar], Scalar],
) -> ScalarArray:
    """Return an array with a window of it combined with an update.

    Args:
      graph: the graph.
      x: the array.
      starts: the index of each axis where the window begins, inside of the array.
      update: the update, of the window's shape.
      is_written: whether the window is written at all.
      combine: a function of an old number and its update that returns the new number.
    """
    lasts = [n - size for n, size in zip(x.shape, update.shape, strict=True)]
    ranges = [
        [int(start)] if is_constant(start) else range(last + 1)
        for start, last in zip(starts, lasts, strict=True)
    ]
    _check_places(math.prod(map(len, ranges)))
    result = x.copy()
    # Go through all places where the window may lie, and write the update at each of them if the
    # window lies there. At most one place passes.
    for place in np.ndindex(*map(len, ranges)):
        offset = [each[i] for each, i in zip(ranges, place, strict=True)]
        # Compare the start of every axis with this place.
        is_here = is_written
        for start, i in zip(starts, offset, strict=True):
            if not is_constant(start):
                is_here = graph.apply("and", is_here, graph.apply("eq", start, start.dtype.type(i)))
        # Each number under the window is chosen between old and new.
        for index, number in zip(np.ndindex(*update.shape), update.ravel(), strict=True):
            at: tuple[int, ...] = tuple(a + b for a, b in zip(offset, index, strict=True))
            new = combine(x[at], number)
            result[at] = select(graph, is_here, result[at], new)
    return result


def _windows(
    indices: ScalarArray, dims: jax.lax.GatherDimensionNumbers, rank: int
) -> list[tuple[tuple[int, ...], list[Scalar]]]:
    """Return a pair for each window of a gather: its index in the result, and its start.

    A start has one scalar for each axis of the operand, of which there are `rank`.
    """
    batching = list(zip(dims.operand_batching_dims, dims.start_indices_batching_dims, strict=True))
    found = []
    for at in np.ndindex(*indices.shape[:-1]):
        # The index vector gives the start of some axes; that of a batching axis is the window's own
        # place along it; all other axes start at 0.
        starts: list[Scalar] = [np.int32(0)] * rank
        for axis, start in zip(dims.start_index_map, indices[at], strict=True):
            starts[axis] = start
        for axis, source in batching:
            starts[axis] = np.int32(at[source])
        found.append((at, starts))
    return found


def gather(
    graph: ExprGraph, equation: JaxprEqn, x: ScalarArray, indices: ScalarArray
) -> ScalarArray:
    """Read windows at indices that may depend on the program's inputs.

    Source: the semantics of gather and scatter in the StableHLO specification.
    """
    dims, sizes = equation.params["dimension_numbers"], equation.params["slice_sizes"]
    # In the mode FILL, a window that reaches beyond the array is read as the fill value; otherwise
    # it is moved inside.
    is_filled = "FILL" in str(equation.params["mode"])
    fill = _fill(equation) if is_filled else None
    fixed = (*dims.collapsed_slice_dims, *dims.operand_batching_dims)
    window_shape = [size for axis, size in enumerate(sizes) if axis not in fixed]
    result = np.empty((*indices.shape[:-1], *window_shape), object)
    for at, starts in _windows(indices, dims, x.ndim):
        window = _read_window(graph, x, starts, sizes)
        if is_filled:
            inside = _all_inside(graph, starts, x.shape, sizes)
            outside = scalar_array([fill] * window.size, window.shape)
            window = _select(graph, inside, outside, window)
        result[at] = window.reshape(window_shape)[()]
    return _with_offsets(result, dims.offset_dims, len(window_shape)).reshape(
        shape_of(equation.outvars[0])
    )


def _fill(equation: JaxprEqn) -> Scalar | Key:
    """Return what a gather reads outside of its operand: of a key, words of all bits."""
    dtype = dtype_of(equation.outvars[0])
    if jnp.issubdtype(dtype, jax.dtypes.prng_key):
        return Key(np.uint32(2**32 - 1), np.uint32(2**32 - 1))
    return dtype.type(fill_value(equation))


def _with_offsets(result: ScalarArray, offsets: Sequence[int], count: int) -> ScalarArray:
    """Move the last `count` axes, those of the windows, to `offsets`."""
    batch = [axis for axis in range(result.ndim) if axis not in offsets]
    return result.transpose(np.argsort([*batch, *offsets])) if count else result


def _all_inside(
    graph: ExprGraph, starts: Sequence[Scalar], shape: Sequence[int], sizes: Sequence[int]
) -> Scalar:
    inside: Scalar = np.bool_(True)
    for start, n, size in zip(starts, shape, sizes, strict=True):
        inside = graph.apply("and", inside, _is_inside(graph, start, n - size))
    return inside


def scatter(
    graph: ExprGraph,
    equation: JaxprEqn,
    x: ScalarArray,
    indices: ScalarArray,
    updates: ScalarArray,
    combine: Callable[[Scalar, Scalar], Scalar],
) -> ScalarArray:
    """Write windows at indices that may depend on the program's inputs.

    Args:
      graph: the graph.
      equation: the equation.
      x: the array.
      indices: the index of each window.
      updates: the windows.
      combine: a function of an old number and its update that returns the new number.
    """
    # The dimension numbers of a scatter are those of the gather that reads the same windows.
    dims = jax.lax.GatherDimensionNumbers(*equation.params["dimension_numbers"])
    fixed = (*dims.collapsed_slice_dims, *dims.operand_batching_dims)
    window = iter(updates.shape[axis] for axis in dims.offset_dims)
    sizes = [1 if axis in fixed else next(window) for axis in range(x.ndim)]
    # A scatter leaves out windows that reach beyond the array, unless it is to move them inside.
    is_clipped = "CLIP" in str(equation.params["mode"])

    # Bring the axes of the windows to the end, as `_with_offsets` moves them away.
    batch = [axis for axis in range(updates.ndim) if axis not in dims.offset_dims]
    ordered = updates.transpose([*batch, *dims.offset_dims])
    lasts = [n - size for n, size in zip(x.shape, sizes, strict=True)]
    for at, starts in _windows(indices, dims, x.ndim):
        update = scalar_array(np.asarray(ordered[at], object).ravel(), sizes)
        inside: Scalar = np.bool_(True)
        if not is_clipped:
            inside = _all_inside(graph, starts, x.shape, sizes)
        if is_constant(inside) and not inside:
            continue
        places = [_clipped(graph, start, last) for start, last in zip(starts, lasts, strict=True)]
        x = _write_window(graph, x, places, update, inside, combine)
    return x


def _scatter_by(
    op: str,
    graph: ExprGraph,
    equation: JaxprEqn,
    x: ScalarArray,
    indices: ScalarArray,
    updates: ScalarArray,
) -> ScalarArray:
    return scatter(graph, equation, x, indices, updates, functools.partial(graph.apply, op))


def _sort(graph: ExprGraph, equation: JaxprEqn, *operands: ScalarArray) -> list[ScalarArray]:
    """Sort with a sorting network, which exchanges neighbours.

    The sort is stable: rows with equal keys keep their order. Keys are compared as in
    `jax.lax.sort`: -0 equals 0, and NaN comes last.
    """
    axis, keys = equation.params["dimension"], equation.params["num_keys"]
    # Bring the axis to the front and merge all others: each lane is sorted on its own, by the same
    # comparisons for all operands.
    shape = np.moveaxis(operands[0], axis, 0).shape
    count, lanes = shape[0], math.prod(shape[1:])
    columns = [np.moveaxis(x, axis, 0).reshape(count, lanes).copy() for x in operands]
    for lane in range(lanes if count else 0):
        rows = [[column[i, lane] for column in columns] for i in range(count)]
        # Constant keys are sorted now; no comparison is left for the program.
        if all(is_constant(x) for row in rows for x in row[:keys]):
            rows.sort(key=functools.cmp_to_key(lambda a, b: _order(graph, a[:keys], b[:keys])))
        else:
            rows = _in_order(graph, rows, lambda a, b: _is_before(graph, b[:keys], a[:keys]))
        for i, row in enumerate(rows):
            for column, x in zip(columns, row, strict=True):
                column[i, lane] = x
    return [np.moveaxis(x.reshape(shape), 0, axis) for x in columns]


def _order(graph: ExprGraph, a: Sequence[Scalar], b: Sequence[Scalar]) -> int:
    """Return how constant keys compare: below, at or above 0."""
    return int(bool(_is_before(graph, b, a))) - int(bool(_is_before(graph, a, b)))


def _in_order(
    graph: ExprGraph,
    rows: list[list[Scalar]],
    is_wrong: Callable[[list[Scalar], list[Scalar]], Scalar],
) -> list[list[Scalar]]:
    """Return the rows in an order in which `is_wrong` holds for no two neighbours.

    The sort is stable: rows that may stay in their order do.
    """
    # Odd-even transposition sort: n rounds order n rows, and each compares fixed neighbours, so
    # that no index depends on the numbers.
    rows = list(rows)
    for turn in range(len(rows)):
        for i in range(turn % 2, len(rows) - 1, 2):
            swap = is_wrong(rows[i], rows[i + 1])
            pairs = list(zip(rows[i], rows[i + 1], strict=True))
            rows[i] = [graph.select(swap, x, y) for x, y in pairs]
            rows[i + 1] = [graph.select(swap, y, x) for x, y in pairs]
    return rows


def _is_before(graph: ExprGraph, a: Sequence[Scalar], b: Sequence[Scalar]) -> Scalar:
    """Return whether a row is before another one by its first key that differs."""
    result: Scalar = np.bool_(False)
    # From the last key to the first: an earlier key decides, unless it is the same in both rows.
    for x, y in zip(reversed(a), reversed(b), strict=True):
        before, same = graph.apply("lt", x, y), graph.apply("eq", x, y)
        # NaN is behind all numbers, and the same as NaN.
        if x.dtype.kind == "f":
            x_is, y_is = graph.apply("eq", x, x), graph.apply("eq", y, y)
            last = graph.apply("and", x_is, graph.apply("not", y_is))
            before = graph.apply("or", before, last)
            both = graph.apply("not", graph.apply("or", x_is, y_is))
            same = graph.apply("or", same, both)
        result = graph.apply("or", before, graph.apply("and", same, result))
    return result


def _top_k(graph: ExprGraph, equation: JaxprEqn, x: ScalarArray) -> list[ScalarArray]:
    """Sort an axis from the largest number to the smallest, and keep the first ones.

    As in XLA, -0 is below 0, and NaN is above or below all numbers, by its sign.
    """
    count, axis = equation.params["k"], equation.params["axis"]
    x = np.moveaxis(x, axis, -1)
    kind = dtype_of(equation.outvars[1]).type
    found = []
    for numbers in x.reshape(math.prod(x.shape[:-1]), x.shape[-1]):
        # Sort the numbers together with their places, which are the second result.
        rows = [[_rank(graph, number), number, kind(i)] for i, number in enumerate(numbers)]
        rows = _in_order(graph, rows, lambda a, b: graph.apply("lt", a[0], b[0]))
        found += rows[:count]
    shape = (*x.shape[:-1], count)
    return [np.moveaxis(scalar_array((row[i] for row in found), shape), -1, axis) for i in (1, 2)]


def _rank(graph: ExprGraph, x: Scalar) -> Scalar:
    """Return a whole number that orders floats by their bits."""
    if x.dtype.kind != "f":
        return x
    word = graph.apply("bitcast", x)
    # Of negative floats, the larger ones have the smaller bits beside the sign.
    inverted = graph.apply("xor", word, word.dtype.type(2 ** (bits_of(x.dtype) - 1) - 1))
    return graph.select(graph.apply("lt", word, word.dtype.type(0)), word, inverted)


DYNAMIC_RULES: dict[str, Rule] = {
    "dynamic_slice": _dynamic_slice,
    "dynamic_update_slice": _dynamic_update_slice,
    "gather": gather,
    "scatter": functools.partial(scatter, combine=lambda old, new: new),
    "scatter-add": functools.partial(_scatter_by, "add"),
    "scatter-max": functools.partial(_scatter_by, "max"),
    "scatter-min": functools.partial(_scatter_by, "min"),
    "scatter-mul": functools.partial(_scatter_by, "mul"),
    "scatter-sub": functools.partial(_scatter_by, "sub"),
    "sort": _sort,
    "top_k": _top_k,
}
"""Lowering rules by the name of the JAX primitive."""
