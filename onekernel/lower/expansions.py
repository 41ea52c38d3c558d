"""Compute operations of JAX by other operations of JAX, which have lowering rules.

A user could have written these functions in place of the operations: they are traced to jaxprs of
operations that have lowering rules. So to add an operation, add a formula here.

Subnormal numbers (below 1.2e-38 in float32, 2.2e-308 in float64) are taken for 0 by `exp` and
`log`, and so by all functions that are made of them.

Source of formulas: M. Abramowitz and I. A. Stegun, Handbook of Mathematical Functions, chapter 4;
H. S. Warren, Hacker's Delight, chapters 5 and 9. The polynomials are interpolated here.
"""

import functools
import math
from collections.abc import Callable, Sequence
from decimal import Decimal
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from onekernel.errors import UnsupportedError
from onekernel.lower import polynomials
from onekernel.lower.extended import halves, log_power
from onekernel.lower.scalar_ir import bits_of, same_size

_LN2 = math.log(2.0)
_BIG = 1e9
"""Beyond this number, x² + 1 and x² are the same float."""


def _bits(x: Array, kind: str) -> Array:
    """Return the bits of floats as integers of a kind, `i` or `u`."""
    return jax.lax.bitcast_convert_type(x, same_size(kind, x.dtype))


def _float(bits: Array, like: Array) -> Array:
    """Return the floats that have some bits, of the dtype of others."""
    return jax.lax.bitcast_convert_type(bits, like.dtype)


# Functions of floats.


def _asin(x: Array) -> Array:
    # tan(y / 2) = sin y / (1 + cos y) with sin y = x. The factors of 1 - x² keep digits that the
    # difference would lose near ±1.
    return 2.0 * jnp.arctan2(x, 1.0 + jnp.sqrt((1.0 - x) * (1.0 + x)))


def _acos(x: Array) -> Array:
    # tan(y / 2) = sin y / (1 + cos y) with cos y = x.
    angle = 2.0 * jnp.arctan2(jnp.sqrt((1.0 - x) * (1.0 + x)), 1.0 + x)
    return jnp.where(x == -1.0, math.pi, angle)


def _atan(x: Array) -> Array:
    return jnp.arctan2(x, jnp.ones_like(x))


def _asinh(x: Array) -> Array:
    size = jnp.abs(x)
    # asinh x = log(x + √(x² + 1)) = log1p(x + x² / (1 + √(x² + 1))), which keeps the digits of a
    # small x; for a large one, log(2x). The bound keeps the square finite.
    square = jnp.minimum(size, _BIG) ** 2
    near = jnp.log1p(size + square / (1.0 + jnp.sqrt(square + 1.0)))
    return _with_sign(x, jnp.where(size < _BIG, near, jnp.log(size) + _LN2))


def _acosh(x: Array) -> Array:
    # acosh x = log(x + √(x² - 1)) = log1p(d + √(d (d + 2))) with d = x - 1.
    above = jnp.minimum(x, _BIG) - 1.0
    near = jnp.log1p(above + jnp.sqrt(above * (above + 2.0)))
    angle = jnp.where(x < _BIG, near, jnp.log(x) + _LN2)
    return jnp.where(x < 1.0, jnp.nan, angle)


def _atanh(x: Array) -> Array:
    # atanh x = ½ log((1 + x) / (1 - x)) = ½ log1p(2x / (1 - x)).
    size = jnp.abs(x)
    return _with_sign(x, 0.5 * jnp.log1p(2.0 * size / (1.0 - size)))


def _sinh(x: Array) -> Array:
    size = jnp.abs(x)
    # sinh x = (eˣ - e⁻ˣ) / 2 = (g + g / (g + 1)) / 2 with g = eˣ - 1. Beyond 80, e⁻ˣ is nothing
    # beside eˣ, and eˣ / 2 is computed without overflow of eˣ.
    grown = jnp.expm1(jnp.minimum(size, 80.0))
    near = 0.5 * (grown + grown / (grown + 1.0))
    return _with_sign(x, jnp.where(size < 80.0, near, _half_exp(size)))


def _cosh(x: Array) -> Array:
    # The result overflows, and no term before it.
    return _half_exp(x) + _half_exp(-x)


def _half_exp(x: Array) -> Array:
    """Return eˣ / 2, which overflows later than eˣ."""
    if x.dtype == jnp.float32:
        # The half is inside of the exponent.
        return jnp.exp(x - _LN2)
    # There it would cost the digits that x has before the point.
    root = jnp.exp(0.5 * x)
    return (0.5 * root) * root


def _exp2(x: Array) -> Array:
    # 2ˣ = 2ⁿ exp((x - n) ln 2) with the nearest whole n, whose power is a float32 with the exponent
    # n + 127, or a float64 with n + 1023.
    info = jnp.finfo(x.dtype)
    bias = info.maxexp - 1
    whole = jnp.round(jnp.clip(x, -float(bias), bias + 1.0))
    power = _float((whole.astype(same_size("i", x.dtype)) + bias) << info.nmant, x)
    result = jnp.exp((x - whole) * _LN2) * power
    # Infinity times zero would be no number.
    return jnp.where(x >= bias + 1.0, jnp.inf, jnp.where(x < 1.0 - bias, 0.0, result))


def _cbrt(x: Array) -> Array:
    size = jnp.abs(x)
    # ∛x = exp(log(x) / 3).
    root = jnp.exp(jnp.log(size) * (1.0 / 3.0))
    # One step of Newton's method for r³ = |x| gives back the digits that the logarithm has lost.
    root = root - (root - size / (root * root)) * (1.0 / 3.0)
    is_end = (x == 0.0) | jnp.isinf(x)
    return jnp.where(is_end, x, _with_sign(x, root))


def _polynomial(x: Array, *coefficients: Array) -> Array:
    # Horner's rule; the coefficient of the highest power comes last.
    return functools.reduce(lambda sum, a: sum * x + a, reversed(coefficients))


def power(x: Array, y: Array) -> Array:
    """Compute x to the power of y: of float32 to 1e-5 of the result, of float64 to some ulp."""
    y = y.astype(x.dtype)
    size = jnp.abs(x)
    # xʸ = exp(y log|x|); then the sign and the special cases of C's pow.
    result = log_power(size, y) if x.dtype == jnp.float64 else jnp.exp(y * jnp.log(size))
    # A negative number has powers with whole exponents only.
    is_whole, is_odd = jnp.floor(y) == y, jnp.floor(y * 0.5) * 2.0 != y
    is_below = jnp.signbit(x)
    result = jnp.where(is_below & is_whole & is_odd, -result, result)
    result = jnp.where((x < 0.0) & ~is_whole & jnp.isfinite(x), jnp.nan, result)
    return jnp.where((y == 0.0) | (x == 1.0) | ((x == -1.0) & jnp.isinf(y)), 1.0, result)


def _with_sign(x: Array, size: Array) -> Array:
    """Return `size`, which is not negative, with the sign of x; -0 has a sign, too."""
    # The sign of a float is its highest bit.
    word = _bits(x, "u")
    sign = word & word.dtype.type(1 << (bits_of(x.dtype) - 1))
    return _float(_bits(size, "u") | sign, x)


_ERF_END = 0.8
_ERFC_SCALE = 0.4
_ERFC_LAST = {jnp.dtype(jnp.float32): 11.0, jnp.dtype(jnp.float64): 28.0}
"""Beyond these numbers, erfc(x) is 0."""


class _ErrorPolynomials(NamedTuple):
    """An `_ErrorPolynomials` has coefficients, highest first, for erf and erfc in one dtype.

    For large x, erfc(x) falls like exp(-x²)/x; so it is t exp(-x² + p(t)) with t = 1/(1 + c x).
    """

    near: list[float]
    """Those of erf(x)/x in x²."""
    tail: list[float]
    """Those of p(t) = log(erfc(x)/t) + x², in t less `centre`."""
    centre: float


@functools.cache
def _error_polynomials(dtype: np.dtype) -> _ErrorPolynomials:
    """Return the polynomials for float32 or float64."""
    if dtype == np.float64:
        return _precise_error_polynomials()
    # Imported late, because few programs need it.
    from scipy import special

    def fit(function: Callable[[np.ndarray], np.ndarray], degree: int, *ends: float) -> list[float]:
        found = np.polynomial.Chebyshev.interpolate(function, degree, domain=ends)
        power = found.convert(kind=np.polynomial.Polynomial, domain=[-1, 1], window=[-1, 1])
        return [float(c) for c in reversed(power.coef)]

    def tail(t: np.ndarray) -> np.ndarray:
        # erfcx(x) is exp(x²) erfc(x), which neither overflows nor vanishes.
        x = (1.0 / t - 1.0) / _ERFC_SCALE
        return np.log(special.erfcx(x) / t)

    near = fit(lambda s: special.erf(np.sqrt(s)) / np.sqrt(s), 7, 1e-12, _ERF_END**2)
    return _ErrorPolynomials(near, fit(tail, 11, 0.15, 1.0), 0.0)


def _precise_error_polynomials() -> _ErrorPolynomials:
    last = _ERFC_LAST[jnp.dtype(jnp.float64)]
    low, high = (1.0 / (1.0 + _ERFC_SCALE * x) for x in (last, _ERF_END))
    centre, half = (low + high) / 2.0, (high - low) / 2.0

    def tail(u: Decimal) -> Decimal:
        t = Decimal(centre) + u
        x = (1 / t - 1) / Decimal(_ERFC_SCALE)
        return (polynomials.erfc(x) / t).ln() + x * x

    def fit(function: Callable[[Decimal], Decimal], degree: int, *ends: float) -> list[float]:
        return [float(c) for c in reversed(polynomials.interpolate(function, degree, *ends))]

    near = fit(polynomials.erf, 12, 0.0, _ERF_END**2)
    return _ErrorPolynomials(near, fit(tail, 23, -half, half), centre)


def _erf(x: Array) -> Array:
    # erf(x) is x times a polynomial near 0, and 1 - erfc(x) beyond.
    near = x * _horner(_error_polynomials(x.dtype).near, x * x)
    far = _with_sign(x, 1.0 - _positive_erfc(jnp.abs(x)))
    return jnp.where(jnp.abs(x) < _ERF_END, near, far)


def _erfc(x: Array) -> Array:
    # 1 - erf(x) loses no digits as long as erf(x) is not near 1.
    near = 1.0 - x * _horner(_error_polynomials(x.dtype).near, x * x)
    far = _positive_erfc(jnp.abs(x))
    far = jnp.where(x < 0.0, 2.0 - far, far)
    return jnp.where(jnp.abs(x) < _ERF_END, near, far)


def _positive_erfc(x: Array) -> Array:
    """Return erfc(x) for x of at least `_ERF_END`; float32 has none beyond x = 10.1."""
    _, tail, centre = _error_polynomials(x.dtype)
    x = jnp.minimum(x, _ERFC_LAST[x.dtype])
    t = 1.0 / (1.0 + _ERFC_SCALE * x)
    # The relative error of exp(-x²) is the absolute error of x². So split x² = c² + (x - c)(x + c),
    # where c is x with half of its bits, whose square is exact, and the rest is small.
    coarse, _ = halves(x)
    rest = (x - coarse) * (x + coarse)
    u = t - centre if centre else t
    return t * jnp.exp(-coarse * coarse) * jnp.exp(_horner(tail, u) - rest)


def _horner(coefficients: list[float], x: Array) -> Array:
    """Return the value of a polynomial, whose coefficients are given highest power first."""
    highest, following, *others = coefficients
    total = highest * x + following
    for coefficient in others:
        total = total * x + coefficient
    return total


def round_away_from_zero(x: Array) -> Array:
    """Round to the nearest whole number, and half of one away from zero."""
    size = jnp.abs(x)
    below = jnp.floor(size)
    return _with_sign(x, jnp.where(size - below >= 0.5, below + 1.0, below))


# Functions of bits.


def _shift_right_arithmetic(x: Array, by: Array) -> Array:
    if x.dtype.kind == "u":
        whole = _bits(x, "i")
        shifted = _shift_right_arithmetic(whole, by.astype(whole.dtype))
        return jax.lax.bitcast_convert_type(shifted, x.dtype)
    # Of a negative number, shift the inverted bits: what is filled with zeros is inverted to ones.
    shift = jax.lax.shift_right_logical
    return jnp.where(x < 0, ~shift(~x, by), shift(x, by))


def _population_count(x: Array) -> Array:
    word = x.astype(same_size("u", x.dtype) if x.dtype.itemsize == 8 else jnp.uint32)
    ones = np.iinfo(word.dtype).max
    # Every second bit, every second pair of them, every second group of four, and the first bit of
    # every byte.
    pairs, fours, eights, bytes = (word.dtype.type(ones // n) for n in (3, 5, 17, 255))
    # Count the ones of each pair of bits, then of each 4, of each 8, and add up the bytes.
    word = word - ((word >> 1) & pairs)
    word = (word & fours) + ((word >> 2) & fours)
    word = (word + (word >> 4)) & eights
    return ((word * bytes) >> (bits_of(word.dtype) - 8)).astype(x.dtype)


def _clz(x: Array) -> Array:
    word = x.astype(same_size("u", x.dtype) if x.dtype.itemsize == 8 else jnp.uint32)
    # Fill all bits below the highest one, and count those that are left.
    for by in (1, 2, 4, 8, 16, 32):
        if by < bits_of(word.dtype):
            word = word | (word >> by)
    return _population_count(~word).astype(x.dtype)


def _total_order(x: Array) -> Array:
    """Return integers in the order of floats by their bits: -NaN < -inf < ... < -0 < 0 < ..."""
    if x.dtype.kind != "f":
        return x
    bits = _bits(x, "i")
    return jnp.where(bits < 0, bits ^ np.iinfo(bits.dtype).max, bits)


def _lt_to(x: Array, y: Array) -> Array:
    return _total_order(x) < _total_order(y)


def _le_to(x: Array, y: Array) -> Array:
    return _total_order(x) <= _total_order(y)


def _nextafter(x: Array, y: Array) -> Array:
    # In the order of `_total_order`, neighbouring numbers are neighbouring integers.
    order = _total_order(x)
    # -0 and 0 are one number: start from the one that lies on the side of y.
    order = jnp.where(x == 0.0, jnp.where(y > 0.0, 0, -1), order)
    order = jnp.where(y > x, order + 1, order - 1)
    bits = jnp.where(order < 0, order ^ np.iinfo(order.dtype).max, order)
    moved = _float(bits, x)
    return jnp.where(jnp.isnan(x) | jnp.isnan(y), jnp.nan, jnp.where(x == y, y, moved))


def _reduce_precision(x: Array, *, exponent_bits: int, mantissa_bits: int) -> Array:
    # Keep the exponent and drop the last bits of the fraction, as in bfloat16.
    info = jnp.finfo(x.dtype)
    dropped = info.nmant - mantissa_bits
    if exponent_bits >= info.nexp and dropped <= 0:
        # With as many bits as it has, which is what `jax.checkpoint` asks of what it stores.
        return x
    if exponent_bits == info.nexp:
        bits = _bits(x, "u")
        word, ones = bits.dtype.type, np.iinfo(bits.dtype).max
        # Round to the nearest, and half to the even.
        odd = (bits >> dropped) & 1
        bits = (bits + odd + word((1 << (dropped - 1)) - 1)) & word(ones & ~((1 << dropped) - 1))
        return jnp.where(jnp.isnan(x), x, _float(bits, x))
    raise UnsupportedError(f"a rounding to {exponent_bits} and {mantissa_bits} bits")


def _cumlogsumexp(x: Array, *, axis: int, reverse: bool) -> Array:
    # Unrolled: every entry is combined with the one before.
    rows = list(jnp.moveaxis(x, axis, 0))
    rows = rows[::-1] if reverse else rows
    for i in range(1, len(rows)):
        rows[i] = jnp.logaddexp(rows[i - 1], rows[i])
    return jnp.moveaxis(jnp.stack(rows[::-1] if reverse else rows), 0, axis)


def _conv_general_dilated(
    x: Array,
    kernel: Array,
    *,
    window_strides: Sequence[int],
    padding: Sequence[tuple[int, int]],
    lhs_dilation: Sequence[int],
    rhs_dilation: Sequence[int],
    dimension_numbers: jax.lax.ConvDimensionNumbers,
    feature_group_count: int,
    batch_group_count: int,
) -> Array:
    # Bring the axes into the order (batch, channels, space ...), and (outputs, inputs, space ...).
    x = x.transpose(dimension_numbers.lhs_spec)
    kernel = kernel.transpose(dimension_numbers.rhs_spec)
    groups, outputs, inputs = feature_group_count, *kernel.shape[:2]
    if batch_group_count > 1:
        # Groups of images are groups of the channels of fewer images.
        groups = batch_group_count
        x = x.reshape(groups, -1, *x.shape[1:]).swapaxes(0, 1)
        x = x.reshape(len(x), groups * inputs, *x.shape[3:])
    # Pad the image, also between its numbers (a transposed convolution).
    inside = [by - 1 for by in lhs_dilation]
    widths = [(low, high, n) for (low, high), n in zip(padding, inside, strict=True)]
    x = jax.lax.pad(x, jnp.zeros((), x.dtype), [(0, 0, 0), (0, 0, 0), *widths])
    # The size of the result, from how far the kernel reaches with its gaps.
    space = kernel.shape[2:]
    reach = [(n - 1) * by + 1 for n, by in zip(space, rhs_dilation, strict=True)]
    sizes = zip(x.shape[2:], reach, window_strides, strict=True)
    shape = [(n - size) // by + 1 for n, size, by in sizes]
    total = jnp.zeros((len(x), groups, outputs // groups, *shape), x.dtype)
    # For each weight of the kernel: take the numbers of the image that it meets at all positions of
    # the kernel, a strided slice, and add their products with it.
    for place in np.ndindex(*space):
        first = [i * by for i, by in zip(place, rhs_dilation, strict=True)]
        last = [i + (n - 1) * by + 1 for i, n, by in zip(first, shape, window_strides, strict=True)]
        part = jax.lax.slice(x, (0, 0, *first), (*x.shape[:2], *last), (1, 1, *window_strides))
        part = part.reshape(len(x), groups, inputs, *shape)
        weights = kernel[(..., *place)].reshape(groups, outputs // groups, inputs)
        total = total + jnp.einsum("bgi...,goi->bgo...", part, weights)
    result = total.reshape(len(x), outputs, *shape)
    return result.transpose(np.argsort(dimension_numbers.out_spec))


EXPANSIONS: dict[str, Callable[..., Array]] = {
    "acos": _acos,
    "acosh": _acosh,
    "asin": _asin,
    "asinh": _asinh,
    "atan": _atan,
    "atanh": _atanh,
    "cbrt": _cbrt,
    "ceil": lambda x: -jnp.floor(-x),
    "clz": _clz,
    "conv_general_dilated": _conv_general_dilated,
    "cosh": _cosh,
    "cumlogsumexp": _cumlogsumexp,
    "erf": _erf,
    "erfc": _erfc,
    "exp2": _exp2,
    "le_to": _le_to,
    "log2": lambda x: jnp.log(x) * (1.0 / _LN2),
    "lt_to": _lt_to,
    "nextafter": _nextafter,
    # The derivative of tanh has it since JAX 0.12.
    "one_minus_square": lambda x: (1.0 - x) * (1.0 + x),
    # `jnp.polyval` and functions of statistics have it since JAX 0.12.
    "polynomial": _polynomial,
    "population_count": _population_count,
    "reduce_precision": _reduce_precision,
    "shift_right_arithmetic": _shift_right_arithmetic,
    "sinh": _sinh,
    "tan": lambda x: jnp.sin(x) / jnp.cos(x),
}
"""Functions that compute the JAX primitive of a name; some take its parameters as keywords."""
