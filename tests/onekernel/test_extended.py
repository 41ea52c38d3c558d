"""Numbers as sums of two floats: nothing is lost."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from onekernel import default_backend, fuse
from onekernel.lower import extended

pytestmark = pytest.mark.skipif(default_backend() is None, reason="no back end for kernels")


@pytest.fixture(autouse=True)
def wide():
    with jax.enable_x64(True):
        yield


def run(function, *arguments):
    """Return what a kernel computes: XLA rearranges sums."""
    results = jax.jit(jax.vmap(fuse(function, on_unsupported="raise")))(*arguments)
    return jax.tree.map(np.asarray, results)


def numbers(count=300):
    rng = np.random.default_rng(0)
    return rng.uniform(-1, 1, count) * 10.0 ** rng.integers(-30, 30, count)


@pytest.mark.parametrize(("dtype", "digits"), [(np.float32, 12), (np.float64, 26)])
def test_the_halves_of_a_number_are_the_number(dtype, digits):
    x = numbers().astype(dtype)
    high, low = run(extended.halves, x)
    np.testing.assert_array_equal(high + low, x)
    fraction, _ = np.frexp(high)
    np.testing.assert_array_equal(fraction * 2**digits, np.round(fraction * 2**digits))


def test_a_product_and_its_error_are_the_product():
    x, y = numbers(), numbers()[::-1].copy()
    product, error = run(extended._product, x, y)
    for row in zip(x, y, product, error, strict=True):
        one, other, total, rest = map(Fraction, row)
        exact = one * other
        assert abs(total + rest - exact) <= abs(exact) / 2**103


@pytest.mark.skipif(np.finfo(np.longdouble).nmant < 60, reason="no numbers of more digits")
def test_a_logarithm_has_more_digits_than_a_float():
    x = np.concatenate([np.abs(numbers()), np.linspace(0.5, 2, 300)])
    high, low = run(extended._log, x)
    with np.errstate(divide="ignore"):
        exact = np.log(x.astype(np.longdouble))
    assert np.abs(high + low.astype(np.longdouble) - exact).max() <= 2e-19 * np.abs(exact).max()
    ends = np.array([0.0, np.inf, np.nan])
    high, low = run(extended._log, ends)
    np.testing.assert_array_equal(high, [-np.inf, np.inf, np.nan])
    np.testing.assert_array_equal(low, 0)


def test_powers_of_large_exponents_have_their_digits():
    exponents = np.arange(-1000.0, 1000.0, 37)
    found = run(extended.log_power, np.full_like(exponents, 2.0), exponents)
    np.testing.assert_allclose(found, 2.0**exponents, rtol=4e-16, atol=0)
    assert jnp.isinf(run(extended.log_power, np.array([2.0]), np.array([1025.0]))).all()
