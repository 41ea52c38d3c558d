"""Reduce angles of float64 that are far from 0, with as many digits of π as it takes.

A program needs this rarely, and then for many angles: so it is a program of its own, which a module
has once, and calls.

Source: M. Payne and R. Hanek, Radian reduction for trigonometric functions, ACM SIGNUM Newsletter
18 (1983).
"""

import functools
import itertools

import numpy as np

from onekernel.lower import polynomials
from onekernel.lower.indexing import scalar_array
from onekernel.lower.jaxpr import ScalarProgram
from onekernel.lower.scalar_ir import ExprGraph, Scalar
from onekernel.lower.schedule import schedule
from onekernel.lower.simplify import make_graph

_FLOAT, _WORD = np.dtype(np.float64), np.dtype(np.uint64)
_INT, _LONG = np.dtype(np.int32), np.dtype(np.int64)

_WORDS = 37
"""Number of words of 2/π that the largest angle needs."""


@functools.cache
def far_angle(op: str) -> ScalarProgram:
    """Return the program of `quarter_turns` or `angle_rest` (see `EVALUATE`) of a float64.

    The angle is at least 1/4, and may be infinite or NaN: then its rest is NaN.
    """
    graph = make_graph(finite=False)
    do, x = graph.apply, graph.input(_FLOAT)
    top, rest = _fraction_of_circle(graph, x)
    is_below = do("lt", x, np.float64(0))
    # Two bits are whole quarter turns. What is left is between -½ and ½, by its sign.
    left = do("or", do("shift_left", top, np.uint64(2)), _shifted(graph, rest, 62))
    if op == "quarter_turns":
        turns = do("add", _shifted(graph, top, 62), _shifted(graph, left, 63))
        turns = graph.convert(turns, _FLOAT)
        result = graph.select(is_below, turns, do("neg", turns))
    else:
        part = graph.convert(graph.convert(left, _LONG), _FLOAT)
        small = graph.convert(do("shift_left", rest, np.uint64(2)), _FLOAT)
        total = do("add", part, do("mul", small, np.float64(2.0**-64)))
        angle = do("mul", total, np.float64(np.pi / 2 * 2.0**-64))
        angle = graph.select(is_below, angle, do("neg", angle))
        result = graph.select(do("is_finite", x), np.float64(np.nan), angle)
    inputs, outputs = scalar_array([x], ()), scalar_array([result], ())
    return ScalarProgram([inputs], [outputs], schedule([result]))


def _fraction_of_circle(graph: ExprGraph, x: Scalar) -> tuple[Scalar, Scalar]:
    """Return |x| / 2π modulo 1, as the upper and the lower 64 of its binary digits."""
    do = graph.apply
    # |x| = m 2ᵉ with a whole m of 53 bits. The bits of 2/π that are worth 4 quarter turns and more
    # in the product with 2ᵉ are left out; `first` is the first word that is not.
    bits = graph.convert(do("bitcast", do("abs", x)), _WORD)
    m = do("or", do("and", bits, np.uint64(2**52 - 1)), np.uint64(2**52))
    exponent = graph.convert(_shifted(graph, bits, 52), _INT)
    place = do("add", exponent, np.int32(62 - 1075))
    # Lanes whose angle is small have any exponent, but must not read beside the table.
    place = do("min", do("max", place, np.int32(0)), np.int32(1034))
    first = do("shift_right_logical", place, np.int32(5))
    by = graph.convert(do("and", place, np.int32(31)), _WORD)
    scale = do("shift_left", np.uint64(1), by)
    table = graph.array(_digits_of_turns())
    found = [graph.load(table, do("add", first, np.int32(i))) for i in range(7)]
    scaled = [do("mul", graph.convert(each, _WORD), scale) for each in found]
    # f = 2ᵉ⁻² · 2/π modulo 1, in words of 32 bits, and then m · f modulo 1: the product of two
    # words has a high and a low word.
    low, high = functools.partial(_low, graph), functools.partial(_shifted, graph, by=32)
    f = [do("add", low(a), high(b)) for a, b in itertools.pairwise(scaled)]
    smaller = [do("mul", low(m), each) for each in f]
    larger = [do("mul", high(m), each) for each in f[1:]]
    columns = []
    for i in range(5):
        total = do("add", do("add", low(smaller[i]), high(smaller[i + 1])), low(larger[i]))
        columns.append(do("add", total, high(larger[i + 1])) if i < 4 else total)
    for i in reversed(range(4)):
        columns[i] = do("add", columns[i], high(columns[i + 1]))
    top, rest = (
        do("or", do("shift_left", columns[i], np.uint64(32)), low(columns[i + 1])) for i in (0, 2)
    )
    return top, rest


def _low(graph: ExprGraph, x: Scalar) -> Scalar:
    return graph.apply("and", x, np.uint64(2**32 - 1))


def _shifted(graph: ExprGraph, x: Scalar, by: int) -> Scalar:
    return graph.apply("shift_right_logical", x, np.uint64(by))


def _digits_of_turns() -> list[np.uint32]:
    """Return the binary digits of 2/π in words of 32 bits, after two words of zeros."""
    digits = polynomials.binary_digits_of_turn(32 * _WORDS)
    words = (np.uint32(digits >> (32 * i) & 0xFFFFFFFF) for i in reversed(range(_WORDS)))
    return [np.uint32(0), np.uint32(0), *words]
