"""Find an equal but simpler scalar for an operation, before it is recorded.

Functions such as exp and log become polynomials (`elementary`). GPUs have approximate instructions
for some of them instead; an approximate graph records these (see `_APPROXIMATE`).
"""

import functools
from typing import cast

import numpy as np

from onekernel.lower import elementary
from onekernel.lower.scalar_ir import (
    COMMUTATIVE,
    Constant,
    Expr,
    ExprGraph,
    Scalar,
    Simplify,
    bits_of,
    equals,
    is_constant,
    same_size,
)

_BOOL = np.dtype(bool)


def make_graph(*, finite: bool = True, approximate: bool = False, skips: bool = False) -> ExprGraph:
    """Return an empty graph.

    Args:
      finite: whether all numbers are finite, and angles at most 10⁴.
      approximate: whether to record exp, log and 1/x, which GPUs have approximate instructions for.
      skips: as for `ExprGraph`.
    """
    simplifications = _SIMPLIFY | _APPROXIMATE if approximate else _SIMPLIFY
    return ExprGraph(simplifications, finite=finite, skips=skips)


_NEUTRAL = {"add": 0, "and": True, "mul": 1, "or": False, "xor": False}
"""The constant that leaves the other operand of an operation as it is."""

_ABSORBING = {"and": False, "mul": 0, "or": True}
"""The constant that is the result, whatever the other operand is."""

_INVERTING = {"mul": (-1, "neg"), "xor": (True, "not")}
"""The constant that inverts the other operand, and the operation that does so."""


def _simplify_commutative(
    graph: ExprGraph, dtype: np.dtype, x: Scalar, y: Scalar, *, op: str
) -> Scalar | None:
    # Combining a number with itself changes nothing.
    if x is y and op in ("and", "or", "max", "min"):
        return x
    # NaN wins against every number, as in JAX.
    if op in ("max", "min") and dtype.kind == "f":
        for one in (x, y):
            if is_constant(one) and np.isnan(one):
                return one
    # On bits, the constants of the tables hold for truth values only.
    if op in ("and", "or", "xor") and dtype != _BOOL:
        return None
    # x · 0 = 0 (for finite x), x + 0 = x, x · 1 = x and x · -1 = -x, with the constant on either
    # side; and likewise for truth values.
    for one, other in ((x, y), (y, x)):
        if op in _ABSORBING and equals(one, _ABSORBING[op]) and graph.is_exact(dtype):
            return dtype.type(_ABSORBING[op])
        if op in _NEUTRAL and equals(one, _NEUTRAL[op]):
            return other
        if op in _INVERTING and equals(one, _INVERTING[op][0]):
            return graph.apply(_INVERTING[op][1], other)
    return None


def _simplify_sub(graph: ExprGraph, dtype: np.dtype, x: Scalar, y: Scalar) -> Scalar | None:
    # x - x is NaN for an infinite x.
    if x is y and graph.is_exact(dtype):
        return dtype.type(0)
    if equals(x, 0):
        return graph.apply("neg", y)
    return x if equals(y, 0) else None


def _simplify_div(graph: ExprGraph, dtype: np.dtype, x: Scalar, y: Scalar) -> Scalar | None:
    # Integers whose divisor may be 0 or negative are divided by magnitudes, and the sign is set
    # afterwards.
    if dtype.kind != "f" and not _is_positive(y):
        return _divided(graph, dtype, x, y)[0]
    if equals(x, 0) and graph.is_exact(dtype):
        return dtype.type(0)
    if equals(y, 1):
        return x
    # Multiply by the reciprocal instead, since a division takes several times as long.
    if is_constant(y) and dtype.kind == "f" and y != 0:
        reciprocal = dtype.type(1 / np.float64(y))
        # That of one of the largest numbers may be too small for a processor.
        if not 0 < abs(reciprocal) < np.finfo(dtype).tiny:
            return graph.apply("mul", x, reciprocal)
    return None


def _simplify_rem(graph: ExprGraph, dtype: np.dtype, x: Scalar, y: Scalar) -> Scalar | None:
    if dtype.kind == "f":
        return _float_rest(graph, dtype, x, y)
    return None if _is_positive(y) else _divided(graph, dtype, x, y)[1]


def _float_rest(graph: ExprGraph, dtype: np.dtype, x: Scalar, y: Scalar) -> Scalar:
    """Return the remainder of x / y as C's fmod does, with the sign of x.

    It is exact where the quotient has fewer digits than the numbers.
    """
    do, zero, infinity = graph.apply, dtype.type(0), dtype.type(np.inf)
    size, rest = do("abs", y), do("abs", x)
    # A float32 quotient has 24 bits. If the whole quotient needs more, the first round leaves a
    # rest that is still larger than y, and the second round divides that.
    for _ in range(2):
        whole = do("floor", do("div", rest, size))
        rest = elementary.subtract_product(graph, dtype, rest, whole, size)
        # The quotient may be rounded to the next whole number: bring the rest into 0 ... |y|.
        rest = graph.select(do("lt", rest, zero), rest, do("add", rest, size))
        rest = graph.select(do("ge", rest, size), rest, do("sub", rest, size))
    # If y is infinite, the remainder is x. If x is infinite or NaN, or y is 0 or NaN, it is NaN.
    rest = graph.select(do("eq", size, infinity), rest, do("abs", x))
    is_number = do("and", do("lt", do("abs", x), infinity), do("gt", size, zero))
    rest = graph.select(is_number, dtype.type(np.nan), rest)
    # The rest has the sign of the dividend.
    return graph.select(do("lt", x, zero), rest, do("neg", rest))


def _is_positive(y: Scalar) -> bool:
    """Return whether an integer is known to be positive.

    Processors divide by such an integer without trouble; division by 0 stops a program on x86.
    """
    if is_constant(y):
        return bool(y > 0)
    return (
        y.op == "max" and y.dtype.kind == "u" and any(is_constant(x) and x > 0 for x in y.operands)
    )


def _divided(graph: ExprGraph, dtype: np.dtype, x: Scalar, y: Scalar) -> tuple[Scalar, Scalar]:
    """Return quotient and remainder of integers as JAX computes them, also of a division by 0.

    The magnitudes are divided, as integers without a sign, where -2³¹ has a magnitude, too.
    """
    do, zero, unsigned = graph.apply, dtype.type(0), same_size("u", dtype)
    size_x, size_y = (graph.convert(_magnitude(graph, dtype, each), unsigned) for each in (x, y))
    # Divide by 1 in place of 0, which would stop the program on x86, and replace the result below.
    divisor = do("max", size_y, unsigned.type(1))
    quotient = graph.convert(do("div", size_x, divisor), dtype)
    rest = graph.convert(do("rem", size_x, divisor), dtype)
    # The quotient is negative if the signs differ, and the remainder has the sign of the dividend.
    if dtype.kind == "i":
        is_below = do("lt", x, zero)
        differ = do("xor", is_below, do("lt", y, zero))
        quotient = graph.select(differ, quotient, do("neg", quotient))
        rest = graph.select(is_below, rest, do("neg", rest))
    # JAX divides n by 0 to a quotient with all bits set and the remainder n.
    is_zero = do("eq", y, zero)
    return graph.select(is_zero, quotient, ~zero), graph.select(is_zero, rest, x)


def _magnitude(graph: ExprGraph, dtype: np.dtype, x: Scalar) -> Scalar:
    return graph.apply("abs", x) if dtype.kind == "i" else x


def _simplify_shift(
    graph: ExprGraph, dtype: np.dtype, x: Scalar, by: Scalar, *, op: str
) -> Scalar | None:
    """Expand a shift by an unknown number of bits into shifts by constants.

    Processors differ in what they do for all bits and more, and LLVM leaves it undefined.
    """
    do, bits = graph.apply, bits_of(dtype)
    # In JAX, the result of a shift by as many bits as there are, or more, is 0.
    if is_constant(by):
        return None if 0 <= by < bits else dtype.type(0)
    # Shift by each bit of the number that is set; beyond the last one, nothing is left.
    for bit in range(bits.bit_length() - 1):
        is_set = do("ne", do("and", by, dtype.type(1 << bit)), dtype.type(0))
        x = graph.select(is_set, x, do(op, x, dtype.type(1 << bit)))
    unsigned = same_size("u", dtype)
    count = graph.convert(by, unsigned)
    return graph.select(do("lt", count, unsigned.type(bits)), dtype.type(0), x)


def _simplify_inverse(op: str) -> Simplify:
    """Return the simplification of an operation that is its own inverse."""
    return lambda graph, dtype, x: x.operands[0] if x.op == op else None


def _simplify_not(graph: ExprGraph, dtype: np.dtype, x: Expr) -> Scalar | None:
    if dtype == _BOOL:
        return x.operands[0] if x.op == "not" else None
    return graph.apply("xor", x, cast(Constant, np.array(-1).astype(dtype)[()]))


SIMPLE_POWERS = {1.0, 2.0, 0.5, 1.5}
"""Exponents for which no logarithm is needed."""


def _simplify_pow(graph: ExprGraph, dtype: np.dtype, x: Scalar, y: Scalar) -> Scalar | None:
    if equals(y, 1):
        return x
    if equals(y, 2):
        return graph.apply("mul", x, x)
    if not any(equals(y, power) for power in (0.5, -0.5, 1.5)):
        return None
    root, factor = graph.apply("sqrt", x), x
    if not graph.finite:
        # By convention, powers of -inf that are no whole numbers are those of inf.
        is_lowest = graph.apply("eq", x, dtype.type(-np.inf))
        root = graph.select(is_lowest, root, dtype.type(np.inf))
        factor = graph.apply("abs", x)
    if equals(y, -0.5):
        # The derivative of a root.
        return graph.apply("div", dtype.type(1), root)
    # To the power of 1.5: of the square of a distance, its third power.
    return root if equals(y, 0.5) else graph.apply("mul", factor, root)


def _simplify_sign(graph: ExprGraph, dtype: np.dtype, x: Scalar) -> Scalar:
    zero, one = dtype.type(0), dtype.type(1)
    if dtype.kind == "u":
        return graph.select(graph.apply("gt", x, zero), zero, one)
    # sign(x) is x itself where it is neither positive nor negative: 0, -0 or NaN.
    below = graph.select(graph.apply("lt", x, zero), x, -one)
    return graph.select(graph.apply("gt", x, zero), below, one)


_SIMPLIFY: dict[str, Simplify] = {
    **{op: functools.partial(_simplify_commutative, op=op) for op in COMMUTATIVE},
    # A sum of derivatives.
    "add_any": lambda graph, dtype, x, y: graph.apply("add", x, y),
    "atan2": elementary.expand_atan2,
    "cos": functools.partial(elementary.expand_sine, ahead=1),
    "div": _simplify_div,
    "erf_inv": elementary.expand_erf_inv,
    "exp": elementary.expand_exp,
    "expm1": elementary.expand_expm1,
    "log": elementary.expand_log,
    "log1p": elementary.expand_log1p,
    "neg": _simplify_inverse("neg"),
    "not": _simplify_not,
    "pow": _simplify_pow,
    "rem": _simplify_rem,
    **{
        op: functools.partial(_simplify_shift, op=op)
        for op in ("shift_left", "shift_right_logical")
    },
    "sign": _simplify_sign,
    "sin": elementary.expand_sine,
    "sub": _simplify_sub,
    "tanh": elementary.expand_tanh,
}
"""Functions that return an equal but simpler scalar; None: there is none."""


def _approximate_div(graph: ExprGraph, dtype: np.dtype, x: Scalar, y: Scalar) -> Scalar | None:
    """Divide by a product with the reciprocal, which all quotients of one divisor share."""
    # Some quotients need no reciprocal at all, such as those by a constant.
    simplified = _simplify_div(graph, dtype, x, y)
    if simplified is not None or dtype.kind != "f":
        return simplified
    return graph.apply("mul", x, graph.apply("reciprocal", y))


def _approximate_tanh(graph: ExprGraph, dtype: np.dtype, x: Scalar) -> Scalar:
    """Expand tanh(x) = 2 / (1 + exp(-2x)) - 1."""
    do = graph.apply
    grown = do("add", do("exp", do("mul", x, np.float32(-2))), np.float32(1))
    return do("sub", do("mul", do("reciprocal", grown), np.float32(2)), np.float32(1))


def _only_float32(op: str, approximate: Simplify) -> Simplify:
    """Return what replaces an operation of float32, where those of float64 stay exact."""

    def simplify(graph: ExprGraph, dtype: np.dtype, *operands: Scalar) -> Scalar | None:
        chosen = _SIMPLIFY[op] if dtype == np.float64 else approximate
        return chosen(graph, dtype, *operands)

    return simplify


_APPROXIMATIONS: dict[str, Simplify] = {
    # Instructions of their own.
    **dict.fromkeys(("exp", "log"), lambda graph, dtype, x: None),
    # Functions of these.
    "div": _approximate_div,
    "expm1": lambda graph, dtype, x: graph.apply("sub", graph.apply("exp", x), np.float32(1)),
    "log1p": lambda graph, dtype, x: graph.apply("log", graph.apply("add", x, np.float32(1))),
    "tanh": _approximate_tanh,
}
_APPROXIMATE = {op: _only_float32(op, how) for op, how in _APPROXIMATIONS.items()}
"""Functions that replace those of `_SIMPLIFY` in an approximate graph, whose `exp`, `log` and
`reciprocal` are instructions of a GPU with a relative error of about 2⁻²². For x near 0, expm1,
log1p and tanh have that as an absolute error, and so lose digits. Of float64, there are none."""
