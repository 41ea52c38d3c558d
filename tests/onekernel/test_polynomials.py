"""Functions with many digits, and the polynomials that interpolate them."""

import decimal
import math
from decimal import Decimal

import numpy as np
import pytest
from scipy import special

from onekernel.lower import polynomials


@pytest.fixture(autouse=True)
def digits():
    with decimal.localcontext(prec=polynomials.DIGITS):
        yield


def near(found, wanted, digits=50):
    return abs(Decimal(found) - Decimal(wanted)) < Decimal(10) ** -digits * abs(Decimal(wanted))


# As any table of constants has them.
CONSTANTS = {
    "half of pi": (
        polynomials.half_pi(),
        "1.5707963267948966192313216916397514420985846996875529104874722961",
    ),
    "logarithm of 2": (
        polynomials.ln2(),
        "0.69314718055994530941723212145817656807550013436025525412068000949",
    ),
}


@pytest.mark.parametrize("name", CONSTANTS)
def test_constants_have_many_digits(name):
    assert near(*CONSTANTS[name])


FUNCTIONS = {
    "sine": (polynomials.sine, lambda s: math.sin(math.sqrt(s)) / math.sqrt(s)),
    "cosine": (polynomials.cosine, lambda s: math.cos(math.sqrt(s))),
    "expm1": (polynomials.expm1, lambda x: math.expm1(x) / x),
    "tanh": (polynomials.tanh, lambda s: math.tanh(math.sqrt(s)) / math.sqrt(s)),
    "atanh": (polynomials.atanh, lambda s: math.atanh(math.sqrt(s)) / math.sqrt(s)),
    "erf": (polynomials.erf, lambda s: math.erf(math.sqrt(s)) / math.sqrt(s)),
    "erfc": (polynomials.erfc, math.erfc),
    "beyond": (lambda x: polynomials.erfc(10 * x), lambda x: math.erfc(10 * x)),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_are_those_of_the_library(name):
    precise, plain = FUNCTIONS[name]
    for x in (1e-3, 0.1, 0.25, 0.7):
        assert near(precise(Decimal(x)), plain(x), 14)


def test_the_error_function_goes_on_at_six():
    # A series below, a continued fraction above.
    inside, outside = polynomials.erfc(Decimal("5.999999")), polynomials.erfc(Decimal("6.000001"))
    assert outside < inside
    slope = -(2 / (2 * polynomials.half_pi()).sqrt()) * Decimal(-36).exp()
    assert near(outside - inside, slope * Decimal("0.000002"), 9)


@pytest.mark.parametrize("x", [0.3, 2.0, 5.9])
def test_the_inverse_of_the_error_function_is_its_inverse(x):
    y = polynomials.erfc(Decimal(x))
    assert near(polynomials.erfc_inv(y, float(special.erfcinv(float(y)))), x, 40)


def test_parts_add_up_and_have_few_bits():
    found = polynomials.parts(polynomials.half_pi(), 33, 33, 33)
    assert near(sum(map(Decimal, found)), polynomials.half_pi(), 44)
    for part in found[:-1]:
        fraction = math.frexp(part)[0]
        assert fraction * 2**33 == int(fraction * 2**33)


def test_binary_digits_are_those_of_the_number():
    digits = polynomials.binary_digits_of_turn(1184)
    # The first words of 2/π, as tables for this purpose begin.
    assert digits >> (1184 - 64) == 0xA2F9836E4E441529
    with decimal.localcontext(prec=380):
        product = Decimal(digits) * polynomials.half_pi(380)
        assert 0 <= 2**1184 - product < 2


def test_a_polynomial_of_the_degree_of_a_function_is_the_function():
    found = polynomials.interpolate(lambda x: 3 - x + 2 * x**3, 4, -0.5, 1.5)
    assert np.allclose([float(c) for c in found], [3, -1, 0, 2, 0], rtol=0, atol=1e-40)
