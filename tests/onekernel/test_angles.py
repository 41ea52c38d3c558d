"""Angles of float64 that are far from 0 are reduced with as many digits as it takes."""

import decimal
from decimal import Decimal

import numpy as np
import pytest

from helpers.run_program import evaluate
from onekernel.lower import polynomials
from onekernel.lower.angles import far_angle


def angles():
    rng = np.random.default_rng(0)
    some = 2.0 ** rng.uniform(0, 1024, 400) * rng.choice([-1, 1], 400)
    turns = (rng.integers(1, 2**40, 400) * (np.pi / 2)).astype(float)
    # The first one is closer to a multiple of a quarter turn than any other (W. Kahan).
    ends = [6381956970095103 * 2.0**797, np.finfo(float).max, 2.0**20, -(2.0**20), 1.0, 0.75]
    return np.array([*some, *turns, *ends])


def exact(x):
    """The nearest number of quarter turns, modulo 4, and the angle that is left."""
    with decimal.localcontext(prec=420):
        quarter = polynomials.half_pi(420)
        turns = (Decimal(x) / quarter).to_integral_value(decimal.ROUND_HALF_EVEN)
        return int(turns % 4), float(Decimal(x) - turns * quarter)


@pytest.mark.parametrize("place", [0, 1])
def test_angles_are_reduced_to_their_last_digit(place):
    x = angles()
    op = ("quarter_turns", "angle_rest")[place]
    (found,) = evaluate(far_angle(op), [x])
    wanted = np.array([exact(one)[place] for one in x])
    if place:
        np.testing.assert_array_max_ulp(found, wanted, 2)
    else:
        np.testing.assert_array_equal(found % 4, wanted % 4)


def test_what_is_no_angle_has_no_rest():
    (found,) = evaluate(far_angle("angle_rest"), [np.array([np.inf, -np.inf, np.nan])])
    assert np.isnan(found).all()
