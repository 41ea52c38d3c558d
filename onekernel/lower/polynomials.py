"""Interpolate functions by polynomials, for float32 and for float64.

For float32, NumPy's functions of float64 have digits to spare. For float64 nothing of NumPy has,
so the functions are computed here with `DIGITS` decimal digits, by their power series, and are the
same on every machine.

Source of series: M. Abramowitz and I. A. Stegun, Handbook of Mathematical Functions, chapters 4
and 7.
"""

import decimal
import functools
import itertools
import math
from collections.abc import Callable, Iterator
from decimal import Decimal
from typing import NamedTuple

import numpy as np

DIGITS = 60
"""Decimal digits of the functions that polynomials of float64 interpolate."""

_SMALLEST = Decimal(10) ** -DIGITS


class Polynomial(NamedTuple):
    """A `Polynomial` interpolates a function in an interval, once a program needs it."""

    function: Callable[[np.ndarray], np.ndarray]
    degree: int
    low: float
    high: float
    precise: Callable[[Decimal], Decimal]
    """The same function with `DIGITS` digits, for float64."""
    precise_degree: int


@functools.cache
def coefficients(polynomial: Polynomial, dtype: np.dtype) -> list[np.floating]:
    """Return the coefficients of a polynomial, lowest first, in float32 or float64."""
    function, degree, *domain, precise, precise_degree = polynomial
    # Interpolation at Chebyshev's points is close to the best polynomial of its degree, with almost
    # the same error everywhere in the interval. Horner's scheme needs the coefficients of powers.
    if dtype == np.float64:
        return [np.float64(c) for c in interpolate(precise, precise_degree, *domain)]
    fit = np.polynomial.Chebyshev.interpolate(function, degree, domain=domain)
    power = fit.convert(kind=np.polynomial.Polynomial, domain=[-1, 1], window=[-1, 1])
    return [np.float32(c) for c in power.coef]


def interpolate(
    function: Callable[[Decimal], Decimal], degree: int, low: float, high: float
) -> list[Decimal]:
    """Return the coefficients of powers, lowest first, of a polynomial with `DIGITS` digits.

    Args:
      function: what it interpolates at Chebyshev's points.
      degree: its degree.
      low: the lower end of the interval.
      high: the upper end.
    """
    with decimal.localcontext(prec=DIGITS + 20):
        angles = (np.arange(degree + 1) + 0.5) * np.pi / (degree + 1)
        points = [
            Decimal(x) for x in ((low + high) / 2 + (high - low) / 2 * np.cos(angles)).tolist()
        ]
        # Newton's divided differences.
        parts = [function(x) for x in points]
        for k in range(1, degree + 1):
            for i in range(degree, k - 1, -1):
                parts[i] = (parts[i] - parts[i - 1]) / (points[i] - points[i - k])
        # Multiply out (...(c x + b) (x - x₁) + a) (x - x₀) + ...
        result = [parts[-1]]
        for part, point in zip(parts[-2::-1], points[-2::-1], strict=True):
            shifted = [Decimal(0), *result]
            result = [a - point * b for a, b in zip(shifted, [*result, Decimal(0)], strict=True)]
            result[0] += part
        return result


# Functions with many digits.


def _sum(terms: Iterator[Decimal]) -> Decimal:
    """Return the sum of a series up to a term that is nothing beside it."""
    total = Decimal(0)
    for term in terms:
        total += term
        if abs(term) <= _SMALLEST * abs(total):
            break
    return total


def _powers(x: Decimal, first: int, step: int) -> Iterator[Decimal]:
    """Yield xᵏ / (first + step k)! for k = 0, 1, ..."""
    term = Decimal(1)
    for k in range(1, first + 1):
        term /= k
    for k in itertools.count():
        yield term
        term *= x
        for i in range(step):
            term /= first + step * k + i + 1


def sine(s: Decimal) -> Decimal:
    """Return sin(√s) / √s."""
    return _sum(_powers(-s, 1, 2))


def cosine(s: Decimal) -> Decimal:
    """Return cos(√s)."""
    return _sum(_powers(-s, 0, 2))


def expm1(x: Decimal) -> Decimal:
    """Return the quotient of exp(x) - 1 and x."""
    return _sum(_powers(x, 1, 1))


def tanh(s: Decimal) -> Decimal:
    """Return the quotient of the hyperbolic tangent of √s and √s."""
    return _sum(_powers(s, 1, 2)) / _sum(_powers(s, 0, 2))


def atanh(s: Decimal) -> Decimal:
    """Return artanh(√s) / √s; of -s, atan(√s) / √s."""
    return _sum(s**k / (2 * k + 1) for k in itertools.count())


@functools.cache
def half_pi(digits: int = 2 * DIGITS) -> Decimal:
    """Return π/2, by Machin's formula."""
    with decimal.localcontext(prec=digits):
        total = Decimal(0)
        for factor, b in ((8, 5), (-2, 239)):
            power, k = Decimal(factor) / b, 1
            while total + power / k != total:
                total += power / k
                power, k = -power / (b * b), k + 2
        return total


def binary_digits_of_turn(count: int) -> int:
    """Return so many binary digits of 2/π behind the point, as a whole number."""
    digits = int(count * math.log10(2)) + 10
    with decimal.localcontext(prec=digits):
        return int(2**count / half_pi(digits))


@functools.cache
def ln2() -> Decimal:
    """Return the natural logarithm of 2."""
    with decimal.localcontext(prec=2 * DIGITS):
        return Decimal(2).ln()


def parts(x: Decimal, *bits: int) -> tuple[float, ...]:
    """Return a number as a sum of others, of which each but the last has so many bits."""
    found = []
    with decimal.localcontext(prec=4 * DIGITS):
        for count in bits:
            unit = Decimal(2) ** (math.frexp(float(x))[1] - count)
            found.append(float(x // unit * unit))
            x -= Decimal(found[-1])
    return (*found, float(x))


def erf(s: Decimal) -> Decimal:
    """Return the quotient of the error function of √s and √s."""
    series = _sum(x * (-1) ** k / (2 * k + 1) for k, x in enumerate(_powers(s, 0, 1)))
    return series * 2 / (2 * half_pi()).sqrt()


def erfc(x: Decimal) -> Decimal:
    """Return 1 - erf(x) of a positive x."""
    with decimal.localcontext(prec=2 * DIGITS):
        if x < 6:
            return 1 - x * erf(x * x)
        # The continued fraction of Laplace, from its end.
        rest = x
        for k in range(400, 0, -1):
            rest = x + Decimal(k) / 2 / rest
        return (-x * x).exp() / rest / (2 * half_pi()).sqrt()


def erfc_inv(y: Decimal, near: float) -> Decimal:
    """Return the x of which erfc is y, by Newton's method from a float near it."""
    x = Decimal(near)
    for _ in range(2):
        x += (erfc(x) - y) * (half_pi() / 2).sqrt() * (x * x).exp()
    return x
