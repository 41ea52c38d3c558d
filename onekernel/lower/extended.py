"""Compute with more digits than a float has, by sums of two floats.

Source: T. J. Dekker, A floating-point technique for extending the available precision, 1971.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from onekernel.lower import polynomials
from onekernel.lower.scalar_ir import same_size

_DROPPED = {np.dtype(np.float32): 12, np.dtype(np.float64): 27}
"""Bits that the first half of a number is without."""

_TERMS = 10
"""Terms of a power series whose argument is below 0.03."""


def halves(x: Array) -> tuple[Array, Array]:
    """Return two numbers whose sum is the number, the first with half of its bits."""
    unsigned = same_size("u", x.dtype)
    mask = unsigned.type(np.iinfo(unsigned).max - (1 << _DROPPED[x.dtype]) + 1)
    bits = jax.lax.bitcast_convert_type(x, unsigned) & mask
    high = jax.lax.bitcast_convert_type(bits, x.dtype)
    return high, x - high


def log_power(x: Array, y: Array) -> Array:
    """Return exp(y log x) in float64, where x is not negative."""
    # exp turns an absolute error of its argument into a relative one: the logarithm needs as many
    # more digits as the argument has before the point.
    high, low = _log(x)
    product, error = _product(y, high)
    rest = error + y * low
    result = jnp.exp(product)
    is_plain = jnp.isfinite(rest) & jnp.isfinite(result)
    # Not result + result · rest: that product may be too small for a number.
    return jnp.where(is_plain, result * (1.0 + rest), result)


def _log(x: Array) -> tuple[Array, Array]:
    """Return log x as a sum of two numbers; of 0, infinity and NaN, the first is all of it."""
    # x = 2ⁿ m with m from √½ to √2, and log m = 2 artanh t = 2 t + 2/3 t³ + ..., t = (m - 1) / (m +
    # 1). All but the terms behind t³ are sums of two numbers.
    m, exponent = jnp.frexp(x)
    is_low = m < np.sqrt(0.5)
    m, n = jnp.where(is_low, 2.0 * m, m), exponent.astype(x.dtype)
    n = jnp.where(is_low, n - 1.0, n)
    below, above = m - 1.0, m + 1.0
    t = below / above
    product, error = _product(t, above)
    # What `above` has lost of the sum is exact, too.
    t_low = (below - product - error - t * (m - (above - 1.0))) / above
    square, square_low = _product(t, t)
    square_low = square_low + 2.0 * t * t_low
    cube, cube_low = _product(square, t)
    cube_low = cube_low + square * t_low + square_low * t
    third, third_low = _product(cube, jnp.asarray(2.0 / 3.0, x.dtype))
    # ⅔ itself is rounded.
    third_low = third_low + cube_low * (2.0 / 3.0) + cube * 2.0**-54 * (2.0 / 3.0)
    tail = jnp.zeros_like(x)
    for k in reversed(range(_TERMS)):
        tail = tail * square + 2.0 / (2 * k + 5)
    coarse, fine = polynomials.parts(polynomials.ln2(), 42)
    high, one = _sum(n * coarse, 2.0 * t)
    high, other = _sum(high, third)
    low = one + other + (n * fine + 2.0 * t_low + third_low + tail * square * cube)
    high, low = _sum(high, low)
    is_number = (x > 0.0) & (x < jnp.inf)
    return jnp.where(is_number, high, jnp.log(x)), jnp.where(is_number, low, 0.0)


def _sum(a: Array, b: Array) -> tuple[Array, Array]:
    """Return a + b and its rounding error, for an a that is 0 or not smaller than b."""
    total = a + b
    return total, b - (total - a)


def _product(a: Array, b: Array) -> tuple[Array, Array]:
    """Return a · b and its rounding error."""
    (a1, a2), (b1, b2) = halves(a), halves(b)
    product = a * b
    return product, ((a1 * b1 - product + a1 * b2) + a2 * b1) + a2 * b2
