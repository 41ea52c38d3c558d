"""Expand elementary functions to basic arithmetic on scalars, equal on every machine.

Each is a polynomial in a small interval, to which its argument is reduced, and exact to a few units
in the last place. Every function takes the graph, the dtype of its operands, float32 or float64,
and the operands. What differs between the two dtypes is data: the degrees of the polynomials, and
the constants of `_Format`.
"""

import functools
from collections.abc import Callable
from decimal import Decimal
from typing import NamedTuple

import numpy as np

from onekernel.lower import polynomials
from onekernel.lower.polynomials import Polynomial
from onekernel.lower.scalar_ir import Expr, ExprGraph, Scalar, same_size

_FLOAT, _DOUBLE = np.dtype(np.float32), np.dtype(np.float64)
_LN2 = float(np.log(2.0))


class _Format(NamedTuple):
    """A `_Format` has the constants of the floats of one dtype."""

    digits: int
    """Number of bits of the fraction."""
    bias: int
    """What is added to an exponent to store it."""
    turn: tuple[float, ...]
    """π/2 as a sum of parts (Cody-Waite range reduction). All but the last have so few bits that
    their products with a number of turns are exact, so subtracting these loses no precision."""
    ln2: tuple[float, ...]
    """ln 2 as a sum of two parts. The product of the first with an exponent is exact."""
    exp: tuple[float, float]
    """From where to where exp is a normal number."""
    erf_inv: tuple[tuple[float, int], ...]
    """For erf_inv, the ends of its intervals in -log(1 - x²), each with a degree."""


# π/2 of float32.
_COARSE = np.float64(1.5703125)
_FINE = np.float64((np.float32(np.pi / 2 - _COARSE).view(np.uint32) & 0xFFFFE000).view(np.float32))

_FORMATS = {
    _FLOAT: _Format(
        digits=23,
        bias=127,
        turn=(float(_COARSE), float(_FINE), float(np.pi / 2 - _COARSE - _FINE)),
        ln2=(round(_LN2 * 2**14) / 2**14, _LN2 - round(_LN2 * 2**14) / 2**14),
        exp=(-87.336, 88.722839),
        # Beyond the last one, there is no x below 1.
        erf_inv=((5.0, 8), (16.7, 8)),
    ),
    _DOUBLE: _Format(
        digits=52,
        bias=1023,
        # Up to 2²⁰ turns.
        turn=polynomials.parts(polynomials.half_pi(), 33, 33, 33),
        ln2=polynomials.parts(polynomials.ln2(), 42),
        exp=(-708.3964185, 709.7827128933841),
        erf_inv=((6.25, 22), (16.0, 18), (36.8, 18)),
    ),
}


def _horner(graph: ExprGraph, polynomial: Polynomial, x: Scalar) -> Scalar:
    """Return the value of a polynomial."""
    coefficients = polynomials.coefficients(polynomial, x.dtype)
    total: Scalar = coefficients[-1]
    for coefficient in reversed(coefficients[:-1]):
        # Products and sums of float32 become one instruction, whereas those of float64 are rounded
        # one by one.
        if x.dtype == _DOUBLE:
            total = graph.apply("fma", total, x, coefficient)
        else:
            total = graph.apply("add", graph.apply("mul", total, x), coefficient)
    return total


def subtract_product(graph: ExprGraph, dtype: np.dtype, x: Scalar, y: Scalar, z: Scalar) -> Scalar:
    """Return x - y · z, with a product that is not rounded where the processor can do so."""
    if dtype == _DOUBLE:
        return graph.apply("fma", graph.apply("neg", y), z, x)
    return graph.apply("sub", x, graph.apply("mul", y, z))


# sin(r)/r and cos(r) are polynomials in s = r², for |r| up to π/4. NumPy's sinc(x) is sin(πx)/(πx).
_TURN_END = (np.pi / 4) ** 2
_SINE = Polynomial(
    lambda s: np.sinc(np.sqrt(s) / np.pi), 4, 0.0, _TURN_END, polynomials.sine, 6
)  # sin(r)/r
_COSINE = Polynomial(lambda s: np.cos(np.sqrt(s)), 5, 0.0, _TURN_END, polynomials.cosine, 7)


def expand_sine(graph: ExprGraph, dtype: np.dtype, x: Scalar, ahead: int = 0) -> Scalar:
    """Expand sin(x + ahead π/2) to basic arithmetic, equal on every machine.

    If the graph's numbers are finite, |x| is at most 10⁴; otherwise any number. The result is NaN
    for a float32 from 2⁵⁰ on.
    """
    # Reduce the angle to r = x - turns π/2, with |r| at most π/4.
    do, number = graph.apply, dtype.type
    if graph.finite:
        turns, r = _near_angle(graph, dtype, x)
    elif dtype == _DOUBLE:
        assert isinstance(x, Expr)
        turns, r = graph.once("angle", x, functools.partial(_any_angle, graph, x))
    else:
        # From 2⁵⁰ on, the remainder would be wrong; a branch for those would slow all others down.
        is_angle = do("lt", do("abs", x), np.float32(2**50))
        x = graph.select(is_angle, np.float32(np.nan), x)
        turns, r = do("quarter_turns", x), do("angle_rest", x)
    s = do("mul", r, r)

    def modulo(count: Scalar, of: float) -> Scalar:
        whole = do("floor", do("mul", count, number(1 / of)))
        return do("sub", count, do("mul", whole, number(of)))

    # Evaluate both polynomials, and select value and sign by the quadrant.
    sine, cosine = do("mul", r, _horner(graph, _SINE, s)), _horner(graph, _COSINE, s)
    # sin(r + k π/2) is sin r, cos r, -sin r, -cos r for k = 0, 1, 2, 3.
    quarter = modulo(do("add", turns, number(ahead)), 4.0)
    odd = do("ge", modulo(quarter, 2.0), number(1))
    value = graph.select(odd, sine, cosine)
    return graph.select(do("ge", quarter, number(2)), value, do("neg", value))


def _near_angle(graph: ExprGraph, dtype: np.dtype, x: Scalar) -> tuple[Scalar, Scalar]:
    """Return an angle's nearest number of quarter turns, and the angle that is left."""
    do, number = graph.apply, dtype.type
    turns = do("floor", do("add", do("mul", x, number(2 / np.pi)), number(0.5)))
    # r = x - turns · (coarse + fine + finest): the products with the first two parts are exact.
    r = x
    for part in _FORMATS[dtype].turn:
        r = do("sub", r, do("mul", turns, number(part)))
    return turns, r


_FAR = 2.0**20
"""From here on, an angle in float64 is reduced with as many digits of π as it takes."""


def _any_angle(graph: ExprGraph, x: Scalar) -> list[Scalar]:
    """Return what `_near_angle` does, of any float64; the number of turns is modulo 4."""
    do = graph.apply
    is_far = do("ge", do("abs", x), np.float64(_FAR))
    # A branch costs nothing where all angles are small.
    far = do("quarter_turns", x), do("angle_rest", x)
    return graph.branch(is_far, _near_angle(graph, _DOUBLE, x), far)


_EXP = Polynomial(np.exp, 6, -_LN2 / 2, _LN2 / 2, Decimal.exp, 12)
_ROOT = float(np.sqrt(2.0))
_LOG_END = ((_ROOT - 1.0) / (_ROOT + 1.0)) ** 2
# atanh(t)/t in s = t², and tanh(x)/x in s = x².
_ARTANH = Polynomial(
    lambda s: np.arctanh(np.sqrt(s)) / np.sqrt(s),
    3,
    1e-12 * _LOG_END,
    _LOG_END,
    polynomials.atanh,
    8,
)
# expm1(x)/x
_EXPM1_END = 0.5
_EXPM1 = Polynomial(
    lambda x: np.expm1(x) / x, 7, -_EXPM1_END, _EXPM1_END + 1e-9, polynomials.expm1, 12
)
_TANH_END = 0.6
_TANH = Polynomial(
    lambda s: np.tanh(np.sqrt(s)) / np.sqrt(s), 5, 1e-12, _TANH_END**2, polynomials.tanh, 12
)
# atan(t)/t in s = t², for t up to tan(π/8).
_ATAN_END = float(np.tan(np.pi / 8))
_ATAN = Polynomial(
    lambda s: np.arctan(np.sqrt(s)) / np.sqrt(s),
    5,
    1e-12,
    _ATAN_END**2,
    lambda s: polynomials.atanh(-s),
    12,
)


def expand_exp(graph: ExprGraph, dtype: np.dtype, x: Scalar) -> Scalar:
    """Expand exp(x) to basic arithmetic; where the result is subnormal, it is 0."""
    # exp(x) = 2^n exp(r) with |r| at most ln(2)/2, where n is x / ln(2) rounded. Near 1.5 · 2^23,
    # neighbouring float32 differ by 1: so the sum is rounded to a whole number, and its last bits
    # are those of n. So it is of float64, near 1.5 · 2^52.
    do, number, form = graph.apply, dtype.type, _FORMATS[dtype]
    coarse, fine = map(number, form.ln2)
    rounding = number(1.5 * 2**form.digits)
    rounded = do("add", do("mul", x, number(1 / _LN2)), rounding)
    n = do("sub", rounded, rounding)
    r = do("sub", do("sub", x, do("mul", n, coarse)), do("mul", n, fine))
    # Multiply by 2^n: add n to the exponent, which begins at bit 23 of a float32.
    whole = same_size("i", dtype).type
    shifted = do("shift_left", do("bitcast", rounded), whole(form.digits))
    result = do("bitcast", do("add", do("bitcast", _horner(graph, _EXP, r)), shifted))
    lowest, highest = form.exp
    result = graph.select(do("lt", x, number(lowest)), result, number(0))
    # Infinity where the result is too large for the dtype, and NaN of NaN: both are x · ∞.
    beyond = do("mul", x, number(np.inf))
    return graph.select(do("lt", x, number(highest)), beyond, result)


def expand_expm1(graph: ExprGraph, dtype: np.dtype, x: Scalar) -> Scalar:
    """Expand exp(x) - 1 to basic arithmetic."""
    do, number = graph.apply, dtype.type
    # exp(x) - 1 would lose all digits near 0; there, x times a polynomial keeps them.
    near = do("mul", x, _horner(graph, _EXPM1, x))
    far = do("sub", do("exp", x), number(1))
    return graph.select(do("lt", do("abs", x), number(_EXPM1_END)), far, near)


def expand_log(graph: ExprGraph, dtype: np.dtype, x: Scalar) -> Scalar:
    """Expand log(x) to basic arithmetic; subnormal numbers are taken for 0."""
    # x = 2^n m with m from √½ to √2, and log(m) = 2 artanh((m - 1) / (m + 1)).
    do, number = graph.apply, dtype.type
    form, whole = _FORMATS[dtype], same_size("i", dtype).type
    coarse, fine = map(number, form.ln2)
    bits = do("bitcast", x)
    # The bits of a positive float32 are 8 bits e and 23 bits f, and its value is 2^(e - 127) · 1.f.
    # So n is e - 127, and m has the bits of x with the exponent 127 in place of e. A float64 has 11
    # and 52 bits, and e - 1023.
    exponent = do("shift_right_logical", bits, whole(form.digits))
    n = graph.convert(graph.convert(exponent, np.dtype(np.int32)), dtype)
    n = do("sub", n, number(form.bias))
    fraction = do("and", bits, whole((1 << form.digits) - 1))
    m = do("bitcast", do("or", fraction, whole(form.bias << form.digits)))
    # If m is above √2, take m/2 and n + 1: so m is near 1, and a short polynomial is enough.
    is_high = do("gt", m, number(_ROOT))
    m = graph.select(is_high, m, do("mul", m, number(0.5)))
    n = graph.select(is_high, n, do("add", n, number(1)))
    series = _log_near_one(graph, dtype, do("sub", m, number(1)))
    result = do("add", do("mul", n, coarse), do("add", do("mul", n, fine), series))
    # log 0 is -∞, and that of a negative number NaN.
    smallest = np.finfo(dtype).tiny
    result = graph.select(do("lt", x, smallest), result, number(-np.inf))
    result = graph.select(do("lt", x, number(0)), result, number(np.nan))
    # Infinity and NaN are their own logarithms.
    return graph.select(do("lt", x, number(np.inf)), x, result)


def _log_near_one(graph: ExprGraph, dtype: np.dtype, x: Scalar) -> Scalar:
    """Expand log(1 + x) to basic arithmetic, for 1 + x from √½ to √2."""
    do, number = graph.apply, dtype.type
    # log(1 + x) = 2 artanh(t), t = x / (x + 2); 2 t is not smaller than the smallest x.
    double = do("div", do("add", x, x), do("add", x, number(2)))
    t = do("mul", double, number(0.5))
    return do("mul", double, _horner(graph, _ARTANH, do("mul", t, t)))


def expand_log1p(graph: ExprGraph, dtype: np.dtype, x: Scalar) -> Scalar:
    """Expand log(1 + x) to basic arithmetic."""
    do, number = graph.apply, dtype.type
    # The sum 1 + x would lose the last digits of a small x, and the series in x does not. It holds
    # for 1 + x from √½ to √2, that is for x between -0.29 and 0.41.
    far = do("log", do("add", x, number(1)))
    is_near = do("lt", do("abs", do("sub", x, number(0.06))), number(0.35))
    return graph.select(is_near, far, _log_near_one(graph, dtype, x))


def expand_tanh(graph: ExprGraph, dtype: np.dtype, x: Scalar) -> Scalar:
    """Expand tanh(x) to basic arithmetic."""
    do, number = graph.apply, dtype.type
    # Near 0, x times a polynomial; beyond, tanh|x| = 1 - 2 / (exp(2|x|) + 1), which is 1 when exp
    # is infinite.
    near = do("mul", x, _horner(graph, _TANH, do("mul", x, x)))
    size = do("abs", x)
    grown = do("add", do("exp", do("add", size, size)), number(1))
    far = do("sub", number(1), do("div", number(2), grown))
    far = graph.select(do("lt", x, number(0)), far, do("neg", far))
    return graph.select(do("lt", size, number(_TANH_END)), far, near)


def expand_atan2(graph: ExprGraph, dtype: np.dtype, y: Scalar, x: Scalar) -> Scalar:
    """Expand atan2(y, x) to basic arithmetic, with the sign of y even if it is zero."""
    do, number = graph.apply, dtype.type
    # The angle from the nearest axis is atan(t) with t up to 1, or π/4 + atan((t - 1) / (t + 1)).
    across, along = do("abs", y), do("abs", x)
    small, large = do("min", across, along), do("max", across, along)
    t = do("div", small, large)
    # 0 / 0: the angle of the origin is 0.
    t = graph.select(do("eq", large, number(0)), t, number(0))
    # Infinity in both directions is halfway between them.
    t = graph.select(do("eq", small, number(np.inf)), t, number(1))
    beyond = do("gt", t, number(_ATAN_END))
    turned = do("div", do("sub", t, number(1)), do("add", t, number(1)))
    # In both cases |u| is at most tan(π/8), so one polynomial serves both.
    u = graph.select(beyond, t, turned)
    angle = do("mul", u, _horner(graph, _ATAN, do("mul", u, u)))
    angle = graph.select(beyond, angle, do("add", angle, number(np.pi / 4)))
    # This is the angle from the nearest axis: reflect it at the diagonal if that is the axis of y,
    # and at the axis of y if x is negative.
    steep = do("gt", across, along)
    angle = graph.select(steep, angle, do("sub", number(np.pi / 2), angle))
    # Test the sign bit, because -0 is not less than 0 but counts as negative here.
    zero = same_size("i", dtype).type(0)
    backwards = do("lt", do("bitcast", x), zero)
    angle = graph.select(backwards, angle, do("sub", number(np.pi), angle))
    return graph.select(do("lt", do("bitcast", y), zero), angle, do("neg", angle))


def expand_erf_inv(graph: ExprGraph, dtype: np.dtype, x: Scalar) -> Scalar:
    """Expand the inverse of the error function to basic arithmetic.

    Source: M. Giles, Approximating the erfinv function, GPU Computing Gems 2 (2010), for the form
    x p(w) with w = -log(1 - x²); the polynomials are interpolated here.
    """
    do, number = graph.apply, dtype.type
    # Compute 1 - x² as (1 - x)(1 + x). Near ±1, where it is small, this loses no digits: the small
    # factor is exact.
    w = do("neg", do("log", do("mul", do("sub", number(1), x), do("add", x, number(1)))))
    # Evaluate all polynomials, around the centres of their intervals, where powers stay small.
    (near, middle), *others = _inverse_error_polynomials(dtype)
    factor = _horner(graph, near, do("sub", w, number(middle)))
    for (end, _), (polynomial, centre) in zip(_FORMATS[dtype].erf_inv, others, strict=False):
        from_centre = do("sub", do("sqrt", w), number(centre))
        is_before = do("lt", w, number(end))
        factor = graph.select(is_before, _horner(graph, polynomial, from_centre), factor)
    result = do("mul", x, factor)
    # erf⁻¹(±1) is ±∞.
    is_end = do("eq", do("abs", x), number(1))
    return graph.select(is_end, result, do("mul", x, number(np.inf)))


@functools.cache
def _inverse_error_polynomials(dtype: np.dtype) -> list[tuple[Polynomial, float]]:
    """Return polynomials of erf⁻¹(x)/x around the centres of their intervals, and these centres.

    For w = -log(1 - x²), the first one is in w, and the others are in √w.
    """
    # Imported late, because few programs draw normal numbers.
    from scipy import special

    def factor(w: np.ndarray) -> np.ndarray:
        # 1 - x = 1 - √(1 - e^-w), without cancellation.
        x = np.sqrt(-np.expm1(-w))
        return special.erfcinv(np.exp(-w) / (1 + x)) / x

    def precise(w: Decimal) -> Decimal:
        x = (1 - (-w).exp()).sqrt()
        y = (-w).exp() / (1 + x)
        return polynomials.erfc_inv(y, float(special.erfcinv(float(y)))) / x

    (near, degree), *others = _FORMATS[dtype].erf_inv
    middle = near / 2
    found = [
        (
            Polynomial(
                lambda d: factor(d + middle),
                degree,
                1e-9 - middle,
                middle,
                lambda d: precise(d + Decimal(middle)),
                degree,
            ),
            middle,
        )
    ]
    for low, (high, degree) in zip((near, *(end for end, _ in others)), others, strict=False):
        found.append(_in_root(factor, precise, degree, low, high))
    return found


def _in_root(
    function: Callable[[np.ndarray], np.ndarray],
    precise: Callable[[Decimal], Decimal],
    degree: int,
    low: float,
    high: float,
) -> tuple[Polynomial, float]:
    """Return a polynomial in the root of a number from the centre of an interval, and that."""
    centre = float((np.sqrt(low) + np.sqrt(high)) / 2)
    half = (np.sqrt(high) - np.sqrt(low)) / 2
    polynomial = Polynomial(
        lambda d: function((d + centre) ** 2),
        degree,
        -half,
        half,
        lambda d: precise((d + Decimal(centre)) ** 2),
        degree,
    )
    return polynomial, centre
