"""Lower operations with arithmetic: those on each element, reductions, products of matrices.

A rule is a function of the graph, the equation and its operands, one array of scalars each.
"""

import functools
import itertools
import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np
from jax.extend.core import JaxprEqn

from onekernel.errors import UnsupportedError
from onekernel.lower.indexing import (
    Rule,
    ScalarArray,
    constant_array,
    dtype_of,
    full_array,
    scalar_array,
    shape_of,
)
from onekernel.lower.random_rules import select
from onekernel.lower.scalar_ir import (
    DTYPES,
    Expr,
    ExprGraph,
    Scalar,
    bits_of,
    equals,
    is_constant,
    same_size,
)

MIN_BRANCH_PRODUCTS = 9
"""Fewest products of a matrix product that a branch skips."""

_WORD, _LONG = np.dtype(np.uint32), np.dtype(np.uint64)

# Functions that other modules use, too.


def elementwise(graph: ExprGraph, op: str, *operands: ScalarArray) -> ScalarArray:
    """Apply an operation of the graph to each element; the operands broadcast."""
    arrays = np.broadcast_arrays(*operands)
    rows = zip(*(array.ravel() for array in arrays), strict=True)
    return scalar_array((graph.apply(op, *row) for row in rows), arrays[0].shape)


def where(
    graph: ExprGraph, condition: Scalar | ScalarArray, if_false: ScalarArray, if_true: ScalarArray
) -> ScalarArray:
    """Select between two arrays by one condition, or one for each index of leading axes."""
    if not isinstance(condition, np.ndarray):
        condition = scalar_array([condition], ())
    # Give the condition axes of length 1 behind its own, so that it broadcasts along the
    # others.
    trailing = [1] * (if_false.ndim - condition.ndim)
    arrays = np.broadcast_arrays(
        condition.reshape((*condition.shape, *trailing)), if_false, if_true
    )
    rows = zip(*(array.ravel() for array in arrays), strict=True)
    return scalar_array((select(graph, *row) for row in rows), if_false.shape)


def fold(graph: ExprGraph, op: str, initial: Scalar, scalars: Iterable[Scalar]) -> Scalar:
    """Combine scalars by an operation, one after the other."""
    return functools.reduce(functools.partial(graph.apply, op), scalars, initial)


def at(array: ScalarArray, i: int) -> ScalarArray:
    """Return one entry along the leading axis, as an array even if it is a single scalar."""
    return array[i : i + 1].reshape(array.shape[1:])


def bitcast(graph: ExprGraph, x: ScalarArray, source: np.dtype, to: np.dtype) -> ScalarArray:
    """Return the same bits as another dtype; a bool is 0 or 1.

    A number of 64 bits is two of 32 bits along a last axis, the lower bits first.

    Args:
      graph: the graph.
      x: the scalars.
      source: their dtype.
      to: the dtype of the result.
    """
    if source == to:
        return x
    if not {source, to} <= {*DTYPES}:
        raise UnsupportedError(f"the bits of {source} as {to}")
    if bits_of(source) > bits_of(to):
        halves = [half for one in x.ravel() for half in graph.halves(_cast(graph, one, _LONG))]
        return bitcast(graph, scalar_array(halves, (*x.shape, 2)), _WORD, to)
    if bits_of(source) < bits_of(to):
        words = bitcast(graph, x, source, _WORD).reshape(-1, 2)
        joined = (_cast(graph, graph.joined(*pair), to) for pair in words)
        return scalar_array(joined, x.shape[:-1])
    return scalar_array((_cast(graph, one, to) for one in x.ravel()), x.shape)


def _cast(graph: ExprGraph, x: Scalar, to: np.dtype) -> Scalar:
    """Return a scalar's bits as another dtype of their number; a bool is 0 or 1."""
    # Between a float and an integer, take the bits as they are. Between integers of one size, a
    # conversion keeps them.
    if {x.dtype.kind, to.kind} in ({"f", "i"}, {"f", "u"}):
        # The graph's `bitcast` is between floats and integers with a sign only.
        whole = x if x.dtype.kind == "f" else graph.convert(x, same_size("i", x.dtype))
        x = graph.apply("bitcast", whole)
    return graph.convert(x, to)


# The rules.


def _convert_element_type(graph: ExprGraph, equation: JaxprEqn, x: ScalarArray) -> ScalarArray:
    dtype = np.dtype(equation.params["new_dtype"])
    return scalar_array((graph.convert(one, dtype) for one in x.ravel()), x.shape)


def _bitcast_convert_type(graph: ExprGraph, equation: JaxprEqn, x: ScalarArray) -> ScalarArray:
    source, to = dtype_of(equation.invars[0]), equation.params["new_dtype"]
    if bool in (source, to):
        raise UnsupportedError("a bitcast of truth values")
    return bitcast(graph, x, np.dtype(source), np.dtype(to))


def _select_n(
    graph: ExprGraph, equation: JaxprEqn, which: ScalarArray, *cases: ScalarArray
) -> ScalarArray:
    result = cases[-1]
    for i in reversed(range(len(cases) - 1)):
        # The index of a case is a bool or an integer.
        later = [
            x if x.dtype == bool else graph.apply("gt", x, x.dtype.type(i)) for x in which.ravel()
        ]
        result = where(graph, scalar_array(later, which.shape), cases[i], result)
    return result


def _clamp(
    graph: ExprGraph, equation: JaxprEqn, low: ScalarArray, x: ScalarArray, high: ScalarArray
) -> ScalarArray:
    return elementwise(graph, "min", elementwise(graph, "max", x, low), high)


def _square(graph: ExprGraph, equation: JaxprEqn, x: ScalarArray) -> ScalarArray:
    return elementwise(graph, "mul", x, x)


def _integer_pow(graph: ExprGraph, equation: JaxprEqn, x: ScalarArray) -> ScalarArray:
    one = constant_array(np.ones(x.shape, dtype_of(equation.outvars[0])))
    # x⁻ⁿ is (1/x)ⁿ. Where a derivative needs it, the function mostly has 1/x already.
    base = x if equation.params["y"] >= 0 else elementwise(graph, "div", one, x)
    result = one
    for _ in range(abs(equation.params["y"])):
        result = elementwise(graph, "mul", result, base)
    return result


def _logistic(graph: ExprGraph, equation: JaxprEqn, x: ScalarArray) -> ScalarArray:
    one = _one(equation)
    exp = elementwise(graph, "exp", elementwise(graph, "neg", x))
    return elementwise(graph, "div", one, elementwise(graph, "add", one, exp))


def _rsqrt(graph: ExprGraph, equation: JaxprEqn, x: ScalarArray) -> ScalarArray:
    return elementwise(graph, "div", _one(equation), elementwise(graph, "sqrt", x))


def _one(equation: JaxprEqn) -> ScalarArray:
    """Return 1 in the dtype of an equation's result."""
    return constant_array(np.ones((), dtype_of(equation.outvars[0])))


def _reduce(
    op: str,
    initial: Callable[[np.dtype], Scalar],
    graph: ExprGraph,
    equation: JaxprEqn,
    x: ScalarArray,
) -> ScalarArray:
    # Each group holds the scalars of one result, which are combined in their order.
    (groups,) = _group_axes(x, (), equation.params["axes"])
    first = initial(np.dtype(dtype_of(equation.outvars[0])))
    scalars = (fold(graph, op, first, group) for group in groups)
    return scalar_array(scalars, shape_of(equation.outvars[0]))


def _cumulate(op: str, graph: ExprGraph, equation: JaxprEqn, x: ScalarArray) -> ScalarArray:
    # Go along the axis, and combine each entry with the one before it (behind it, if reversed).
    result = np.moveaxis(x.copy(), equation.params["axis"], 0)
    order = range(1, len(result))
    for i in [len(result) - 1 - i for i in order] if equation.params["reverse"] else order:
        previous = at(result, i + 1 if equation.params["reverse"] else i - 1)
        # Assign to a slice: assigned to an element, the array would become a nested object.
        result[i : i + 1] = elementwise(graph, op, previous, at(result, i))[None]
    return np.moveaxis(result, 0, equation.params["axis"])


def _arg_extreme(better: str, graph: ExprGraph, equation: JaxprEqn, x: ScalarArray) -> ScalarArray:
    (axis,) = equation.params["axes"]
    kind = dtype_of(equation.outvars[0]).type
    x = np.moveaxis(x, axis, -1)
    places = full_array(x.shape[:-1], lambda: kind(0))
    # Keep the best scalar so far and its place; a later one must be better, so the first of
    # equals wins.
    for row in np.ndindex(*x.shape[:-1]):
        best = x[row][0]
        for i, scalar in enumerate(x[row][1:], start=1):
            wins = graph.apply(better, scalar, best)
            if not graph.finite and scalar.dtype.kind == "f":
                # The first NaN wins.
                is_nan = graph.apply("ne", scalar, scalar)
                is_first = graph.apply("eq", best, best)
                wins = graph.apply("or", wins, graph.apply("and", is_nan, is_first))
            best = graph.select(wins, best, scalar)
            places[row] = graph.select(wins, places.item(*row), kind(i))
    return places


def _dot_general(
    graph: ExprGraph, equation: JaxprEqn, a: ScalarArray, b: ScalarArray
) -> ScalarArray:
    # Group the axes of both operands as (batch, free, summed); the result has (batch, free a,
    # free b).
    (sum_a, sum_b), (batch_a, batch_b) = equation.params["dimension_numbers"]
    rows = _group_axes(a, batch_a, sum_a)
    columns = _group_axes(b, batch_b, sum_b)
    dtype = np.dtype(dtype_of(equation.outvars[0]))
    sums: list[Scalar] = []
    for row_group, column_group in zip(rows, columns, strict=True):
        # The operands may have different dtypes, such as int32 and float32.
        left, right = (
            [[graph.convert(x, dtype) for x in vector] for vector in group]
            for group in (row_group, column_group)
        )
        multiply = _sums_by_truth if graph.skips and graph.finite else _sums
        sums += multiply(graph, left, right, dtype.type(0))
    return scalar_array(sums, shape_of(equation.outvars[0]))


_Vectors = Sequence[Sequence[Scalar]]


def _sums(graph: ExprGraph, rows: _Vectors, columns: _Vectors, zero: Scalar) -> list[Scalar]:
    """Return the sum of products of each row and each column, one sum after the other."""
    sums = []
    for row, column in itertools.product(rows, columns):
        total = zero
        for x, y in zip(row, column, strict=True):
            total = graph.apply("add", total, graph.apply("mul", x, y))
        sums.append(total)
    return sums


def _sums_by_truth(
    graph: ExprGraph, rows: _Vectors, columns: _Vectors, zero: Scalar
) -> list[Scalar]:
    """Return the same sums; branches skip what is 0 because a truth value in it is false."""
    # Rows with the same truth value are summed together, such as those of a contact.
    groups: dict[Expr | None, list[int]] = {}
    for i, row in enumerate(rows):
        groups.setdefault(_condition_of(row), []).append(i)
    sums = {}
    for places in groups.values():
        found = iter(_sums_of_terms(graph, [rows[i] for i in places], columns, zero))
        sums |= {i: [next(found) for _ in columns] for i in places}
    return [total for i in range(len(rows)) for total in sums[i]]


def _sums_of_terms(
    graph: ExprGraph, rows: _Vectors, columns: _Vectors, zero: Scalar
) -> list[Scalar]:
    totals = [zero] * (len(rows) * len(columns))
    # The i-th numbers of all rows, and of all columns; there may be no columns.
    terms = list(zip(zip(*rows, strict=True), zip(*columns, strict=True), strict=False))
    conditions = [_condition_of(left) or _condition_of(right) for left, right in terms]
    # One branch is around successive terms with the same truth value.
    for condition, places in itertools.groupby(range(len(terms)), conditions.__getitem__):
        added, count = totals, 0
        for i in places:
            products = [graph.apply("mul", x, y) for x, y in itertools.product(*terms[i])]
            added = [graph.apply("add", *pair) for pair in zip(added, products, strict=True)]
            count += math.prod(sum(not equals(x, 0) for x in side) for side in terms[i])
        if condition is not None and count >= MIN_BRANCH_PRODUCTS:
            added = graph.branch(condition, totals, added)
        totals = added
    return totals


def _condition_of(vector: Sequence[Scalar]) -> Expr | None:
    """Return a truth value that is a factor of all numbers of a vector; None: there is none."""
    conditions = {_truth_in(x) for x in vector if not equals(x, 0)}
    return conditions.pop() if len(conditions) == 1 else None


def _truth_in(x: Scalar) -> Expr | None:
    """Return the truth value with which a number is multiplied last; None: it is with none."""
    if is_constant(x):
        return None
    for factor in [x, *(x.operands if x.op == "mul" else ())]:
        if not is_constant(factor) and factor.op == "convert":
            (source,) = factor.operands
            if not is_constant(source) and source.dtype.kind == "b":
                return source
    return None


def _lowest(dtype: np.dtype) -> Scalar:
    """Return the number that changes no maximum: max(-inf, x) is x."""
    if dtype.kind == "b":
        return np.bool_(False)
    return dtype.type(-np.inf if dtype.kind == "f" else np.iinfo(dtype).min)


def _highest(dtype: np.dtype) -> Scalar:
    """Return the number that changes no minimum."""
    if dtype.kind == "b":
        return np.bool_(True)
    return dtype.type(np.inf if dtype.kind == "f" else np.iinfo(dtype).max)


def _group_axes(x: ScalarArray, batch: Sequence[int], summed: Sequence[int]) -> ScalarArray:
    """Return an array with its axes grouped as (batch, free, summed)."""
    free = [axis for axis in range(x.ndim) if axis not in batch and axis not in summed]
    sizes = [
        int(np.prod([x.shape[axis] for axis in axes], dtype=int)) for axes in (batch, free, summed)
    ]
    return x.transpose(*batch, *free, *summed).reshape(sizes)


ARITHMETIC_RULES: dict[str, Rule] = {
    "convert_element_type": _convert_element_type,
    "bitcast_convert_type": _bitcast_convert_type,
    "select_n": _select_n,
    "clamp": _clamp,
    "square": _square,
    "integer_pow": _integer_pow,
    "logistic": _logistic,
    "rsqrt": _rsqrt,
    "reduce_sum": functools.partial(_reduce, "add", lambda dtype: dtype.type(0)),
    "reduce_prod": functools.partial(_reduce, "mul", lambda dtype: dtype.type(1)),
    "reduce_and": functools.partial(_reduce, "and", lambda dtype: ~dtype.type(0)),
    "reduce_or": functools.partial(_reduce, "or", lambda dtype: dtype.type(0)),
    "reduce_max": functools.partial(_reduce, "max", _lowest),
    "reduce_min": functools.partial(_reduce, "min", _highest),
    "cummax": functools.partial(_cumulate, "max"),
    "cummin": functools.partial(_cumulate, "min"),
    "cumprod": functools.partial(_cumulate, "mul"),
    "cumsum": functools.partial(_cumulate, "add"),
    "argmin": functools.partial(_arg_extreme, "lt"),
    "argmax": functools.partial(_arg_extreme, "gt"),
    "dot_general": _dot_general,
}
"""The rules by the names of JAX's primitives."""
