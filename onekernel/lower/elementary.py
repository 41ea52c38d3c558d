"""Expand elementary functions to basic arithmetic on scalars, equal on every machine.

Each is a polynomial in a small interval, to which its argument is reduced, and exact to a few units
in the last place. Every function takes the graph, the dtype of its operands and the operands.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from onekernel.lower.scalar_ir import ExprGraph, Scalar

_FLOAT = np.dtype(np.float32)

# π/2 as a sum of three parts (Cody-Waite range reduction). The first two have so few bits that
# their products with a whole number are exact, so subtracting quarter turns loses no precision.
_COARSE = np.float64(1.5703125)
_FINE = np.float64((np.float32(np.pi / 2 - _COARSE).view(np.uint32) & 0xFFFFE000).view(np.float32))
_QUARTER_TURN = [np.float32(part) for part in (_COARSE, _FINE, np.pi / 2 - _COARSE - _FINE)]


class _Polynomial(NamedTuple):
    """A `_Polynomial` interpolates a function in an interval, once a program needs it."""

    function: Callable[[np.ndarray], np.ndarray]
    degree: int
    low: float
    high: float


@functools.cache
def _coefficients(polynomial: _Polynomial) -> list[np.float32]:
    """Return the coefficients of a polynomial, lowest first."""
    function, degree, *domain = polynomial
    # Interpolation at Chebyshev's points is close to the best polynomial of its degree, with almost
    # the same error everywhere in the interval. Horner's scheme needs the coefficients of powers.
    fit = np.polynomial.Chebyshev.interpolate(function, degree, domain=domain)
    power = fit.convert(kind=np.polynomial.Polynomial, domain=[-1, 1], window=[-1, 1])
    return [np.float32(c) for c in power.coef]


def _horner(graph: ExprGraph, polynomial: _Polynomial, x: Scalar) -> Scalar:
    """Return the value of a polynomial."""
    coefficients = _coefficients(polynomial)
    total: Scalar = coefficients[-1]
    for coefficient in reversed(coefficients[:-1]):
        total = graph.apply("add", graph.apply("mul", total, x), coefficient)
    return total


# sin(r)/r and cos(r) are polynomials in s = r², for |r| up to π/4. NumPy's sinc(x) is sin(πx)/(πx).
_SINE = _Polynomial(lambda s: np.sinc(np.sqrt(s) / np.pi), 4, 0.0, (np.pi / 4) ** 2)  # sin(r)/r
_COSINE = _Polynomial(lambda s: np.cos(np.sqrt(s)), 5, 0.0, (np.pi / 4) ** 2)


def expand_sine(graph: ExprGraph, dtype: np.dtype, x: Scalar, ahead: int = 0) -> Scalar:
    """Expand sin(x + ahead π/2) to basic arithmetic, equal on every machine.

    If the graph's numbers are finite, |x| is at most 10⁴; otherwise any number.
    """
    # Reduce the angle to r = x - turns π/2, with |r| at most π/4.
    do = graph.apply
    if graph.finite:
        turns = do("floor", do("add", do("mul", x, np.float32(2 / np.pi)), np.float32(0.5)))
        # r = x - turns · (coarse + fine + finest): the products with the first two parts are exact.
        r = x
        for part in _QUARTER_TURN:
            r = do("sub", r, do("mul", turns, part))
    else:
        # Beyond, neighbouring numbers are thousands of turns apart; infinity becomes NaN.
        is_angle = do("lt", do("abs", x), np.float32(2**50))
        x = graph.select(is_angle, do("mul", x, np.float32(0)), x)
        turns, r = do("quarter_turns", x), do("angle_rest", x)
    s = do("mul", r, r)

    def modulo(count: Scalar, of: float) -> Scalar:
        whole = do("floor", do("mul", count, np.float32(1 / of)))
        return do("sub", count, do("mul", whole, np.float32(of)))

    # Evaluate both polynomials, and select value and sign by the quadrant.
    sine, cosine = do("mul", r, _horner(graph, _SINE, s)), _horner(graph, _COSINE, s)
    # sin(r + k π/2) is sin r, cos r, -sin r, -cos r for k = 0, 1, 2, 3.
    quarter = modulo(do("add", turns, np.float32(ahead)), 4.0)
    odd = do("ge", modulo(quarter, 2.0), np.float32(1))
    value = graph.select(odd, sine, cosine)
    return graph.select(do("ge", quarter, np.float32(2)), value, do("neg", value))


_LN2 = float(np.log(2.0))
# ln 2 as a sum of two parts. The first has so few bits that its product with an exponent is exact.
_LN2_COARSE = np.float32(round(_LN2 * 2**14) / 2**14)
_LN2_FINE = np.float32(_LN2 - float(_LN2_COARSE))
_EXP = _Polynomial(np.exp, 6, -_LN2 / 2, _LN2 / 2)
_ROOT = float(np.sqrt(2.0))
_LOG_END = ((_ROOT - 1.0) / (_ROOT + 1.0)) ** 2
# atanh(t)/t in s = t², and tanh(x)/x in s = x².
_ARTANH = _Polynomial(lambda s: np.arctanh(np.sqrt(s)) / np.sqrt(s), 3, 1e-12 * _LOG_END, _LOG_END)
# expm1(x)/x
_EXPM1_END = 0.5
_EXPM1 = _Polynomial(lambda x: np.expm1(x) / x, 7, -_EXPM1_END, _EXPM1_END + 1e-9)
_TANH_END = 0.6
_TANH = _Polynomial(lambda s: np.tanh(np.sqrt(s)) / np.sqrt(s), 5, 1e-12, _TANH_END**2)
# atan(t)/t in s = t², for t up to tan(π/8).
_ATAN_END = float(np.tan(np.pi / 8))
_ATAN = _Polynomial(lambda s: np.arctan(np.sqrt(s)) / np.sqrt(s), 5, 1e-12, _ATAN_END**2)
# For w = -log(1 - x²), erf⁻¹(x)/x is a polynomial in w up to `_ERF_INV_NEAR`, and one in √w up to
# `_ERF_INV_FAR`; beyond, float32 has no x below 1.
_ERF_INV_NEAR = 5.0
_ERF_INV_FAR = 16.7
_ERF_INV_CENTRE = float((np.sqrt(_ERF_INV_NEAR) + np.sqrt(_ERF_INV_FAR)) / 2)


def expand_exp(graph: ExprGraph, dtype: np.dtype, x: Scalar) -> Scalar:
    """Expand exp(x) to basic arithmetic; where the result is subnormal, it is 0."""
    # exp(x) = 2^n exp(r) with |r| at most ln(2)/2, where n is x / ln(2) rounded. Near 1.5 · 2^23,
    # neighbouring float32 differ by 1: so the sum is rounded to a whole number, and its last bits
    # are those of n.
    do = graph.apply
    rounding = np.float32(1.5 * 2**23)
    rounded = do("add", do("mul", x, np.float32(1 / _LN2)), rounding)
    n = do("sub", rounded, rounding)
    r = do("sub", do("sub", x, do("mul", n, _LN2_COARSE)), do("mul", n, _LN2_FINE))
    # Multiply by 2^n: add n to the exponent, which begins at bit 23 of a float32.
    shifted = do("shift_left", do("bitcast", rounded), np.int32(23))
    result = do("bitcast", do("add", do("bitcast", _horner(graph, _EXP, r)), shifted))
    result = graph.select(do("lt", x, np.float32(-87.336)), result, np.float32(0))
    # Infinity where the result is too large for float32, and NaN of NaN: both are x · ∞.
    beyond = do("mul", x, np.float32(np.inf))
    return graph.select(do("lt", x, np.float32(88.722839)), beyond, result)


def expand_expm1(graph: ExprGraph, dtype: np.dtype, x: Scalar) -> Scalar:
    """Expand exp(x) - 1 to basic arithmetic."""
    do = graph.apply
    # exp(x) - 1 would lose all digits near 0; there, x times a polynomial keeps them.
    near = do("mul", x, _horner(graph, _EXPM1, x))
    far = do("sub", do("exp", x), np.float32(1))
    return graph.select(do("lt", do("abs", x), np.float32(_EXPM1_END)), far, near)


def expand_log(graph: ExprGraph, dtype: np.dtype, x: Scalar) -> Scalar:
    """Expand log(x) to basic arithmetic; subnormal numbers are taken for 0."""
    # x = 2^n m with m from √½ to √2, and log(m) = 2 artanh((m - 1) / (m + 1)).
    do = graph.apply
    bits = do("bitcast", x)
    # The bits of a positive float32 are 8 bits e and 23 bits f, and its value is 2^(e - 127) · 1.f.
    # So n is e - 127, and m has the bits of x with the exponent 127 in place of e.
    n = graph.convert(do("shift_right_logical", bits, np.int32(23)), _FLOAT)
    n = do("sub", n, np.float32(127))
    m = do("bitcast", do("or", do("and", bits, np.int32((1 << 23) - 1)), np.int32(127 << 23)))
    # If m is above √2, take m/2 and n + 1: so m is near 1, and a short polynomial is enough.
    is_high = do("gt", m, np.float32(_ROOT))
    m = graph.select(is_high, m, do("mul", m, np.float32(0.5)))
    n = graph.select(is_high, n, do("add", n, np.float32(1)))
    series = _log_near_one(graph, do("sub", m, np.float32(1)))
    result = do("add", do("mul", n, _LN2_COARSE), do("add", do("mul", n, _LN2_FINE), series))
    # log 0 is -∞, and that of a negative number NaN.
    smallest = np.finfo(np.float32).tiny
    result = graph.select(do("lt", x, smallest), result, np.float32(-np.inf))
    result = graph.select(do("lt", x, np.float32(0)), result, np.float32(np.nan))
    # Infinity and NaN are their own logarithms.
    return graph.select(do("lt", x, np.float32(np.inf)), x, result)


def _log_near_one(graph: ExprGraph, x: Scalar) -> Scalar:
    """Expand log(1 + x) to basic arithmetic, for 1 + x from √½ to √2."""
    do = graph.apply
    # log(1 + x) = 2 artanh(t), t = x / (x + 2); 2 t is not smaller than the smallest x.
    double = do("div", do("add", x, x), do("add", x, np.float32(2)))
    t = do("mul", double, np.float32(0.5))
    return do("mul", double, _horner(graph, _ARTANH, do("mul", t, t)))


def expand_log1p(graph: ExprGraph, dtype: np.dtype, x: Scalar) -> Scalar:
    """Expand log(1 + x) to basic arithmetic."""
    do = graph.apply
    # The sum 1 + x would lose the last digits of a small x, and the series in x does not. It holds
    # for 1 + x from √½ to √2, that is for x between -0.29 and 0.41.
    far = do("log", do("add", x, np.float32(1)))
    is_near = do("lt", do("abs", do("sub", x, np.float32(0.06))), np.float32(0.35))
    return graph.select(is_near, far, _log_near_one(graph, x))


def expand_tanh(graph: ExprGraph, dtype: np.dtype, x: Scalar) -> Scalar:
    """Expand tanh(x) to basic arithmetic."""
    do = graph.apply
    # Near 0, x times a polynomial; beyond, tanh|x| = 1 - 2 / (exp(2|x|) + 1), which is 1 when exp
    # is infinite.
    near = do("mul", x, _horner(graph, _TANH, do("mul", x, x)))
    size = do("abs", x)
    grown = do("add", do("exp", do("add", size, size)), np.float32(1))
    far = do("sub", np.float32(1), do("div", np.float32(2), grown))
    far = graph.select(do("lt", x, np.float32(0)), far, do("neg", far))
    return graph.select(do("lt", size, np.float32(_TANH_END)), far, near)


def expand_atan2(graph: ExprGraph, dtype: np.dtype, y: Scalar, x: Scalar) -> Scalar:
    """Expand atan2(y, x) to basic arithmetic, with the sign of y even if it is zero."""
    do = graph.apply
    # The angle from the nearest axis is atan(t) with t up to 1, or π/4 + atan((t - 1) / (t + 1)).
    across, along = do("abs", y), do("abs", x)
    small, large = do("min", across, along), do("max", across, along)
    t = do("div", small, large)
    # 0 / 0: the angle of the origin is 0.
    t = graph.select(do("eq", large, np.float32(0)), t, np.float32(0))
    # Infinity in both directions is halfway between them.
    t = graph.select(do("eq", small, np.float32(np.inf)), t, np.float32(1))
    beyond = do("gt", t, np.float32(_ATAN_END))
    turned = do("div", do("sub", t, np.float32(1)), do("add", t, np.float32(1)))
    # In both cases |u| is at most tan(π/8), so one polynomial serves both.
    u = graph.select(beyond, t, turned)
    angle = do("mul", u, _horner(graph, _ATAN, do("mul", u, u)))
    angle = graph.select(beyond, angle, do("add", angle, np.float32(np.pi / 4)))
    # This is the angle from the nearest axis: reflect it at the diagonal if that is the axis of y,
    # and at the axis of y if x is negative.
    steep = do("gt", across, along)
    angle = graph.select(steep, angle, do("sub", np.float32(np.pi / 2), angle))
    # Test the sign bit, because -0 is not less than 0 but counts as negative here.
    backwards = do("lt", do("bitcast", x), np.int32(0))
    angle = graph.select(backwards, angle, do("sub", np.float32(np.pi), angle))
    return graph.select(do("lt", do("bitcast", y), np.int32(0)), angle, do("neg", angle))


def expand_erf_inv(graph: ExprGraph, dtype: np.dtype, x: Scalar) -> Scalar:
    """Expand the inverse of the error function to basic arithmetic.

    Source: M. Giles, Approximating the erfinv function, GPU Computing Gems 2 (2010), for the form
    x p(w) with w = -log(1 - x²); the polynomials are interpolated here.
    """
    do = graph.apply
    # Compute 1 - x² as (1 - x)(1 + x). Near ±1, where it is small, this loses no digits: the small
    # factor is exact.
    w = do("neg", do("log", do("mul", do("sub", np.float32(1), x), do("add", x, np.float32(1)))))
    # Evaluate both polynomials, around the centres of their intervals, where powers stay small.
    near, far = _inverse_error_polynomials()
    inside = _horner(graph, near, do("sub", w, np.float32(_ERF_INV_NEAR / 2)))
    root = do("sub", do("sqrt", w), np.float32(_ERF_INV_CENTRE))
    factor = graph.select(do("lt", w, np.float32(_ERF_INV_NEAR)), _horner(graph, far, root), inside)
    result = do("mul", x, factor)
    # erf⁻¹(±1) is ±∞.
    is_end = do("eq", do("abs", x), np.float32(1))
    return graph.select(is_end, result, do("mul", x, np.float32(np.inf)))


@functools.cache
def _inverse_error_polynomials() -> tuple[_Polynomial, _Polynomial]:
    """Return polynomials of erf⁻¹(x)/x in w and in √w, around the centres of their intervals."""
    # Imported late, because few programs draw normal numbers.
    from scipy import special

    def factor(w: np.ndarray) -> np.ndarray:
        # 1 - x = 1 - √(1 - e^-w), without cancellation.
        x = np.sqrt(-np.expm1(-w))
        return special.erfcinv(np.exp(-w) / (1 + x)) / x

    near = _Polynomial(
        lambda d: factor(d + _ERF_INV_NEAR / 2), 8, 1e-9 - _ERF_INV_NEAR / 2, _ERF_INV_NEAR / 2
    )
    half = (np.sqrt(_ERF_INV_FAR) - np.sqrt(_ERF_INV_NEAR)) / 2
    far = _Polynomial(lambda d: factor((d + _ERF_INV_CENTRE) ** 2), 8, -half, half)
    return near, far
