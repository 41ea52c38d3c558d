"""Elementary functions of a graph are those of the library, whether their arguments are known."""

import numpy as np
import pytest
from scipy import special

from helpers.run_program import evaluate_scalar


@pytest.mark.parametrize(("op", "reference"), [("sin", np.sin), ("cos", np.cos)])
def test_sine_and_cosine_are_those_of_the_library(graph, x, op, reference):
    angles = np.float32(np.concatenate([np.linspace(-9, 9, 4001), np.linspace(-5e3, 5e3, 4001)]))
    ours = evaluate_scalar(graph.apply(op, x), (x, angles))
    np.testing.assert_allclose(ours, reference(np.float64(angles)), atol=3e-7)


ENDS = np.float32([0.0, -0.0, 1, -1, 2.5, -2.5, 3e38, -3e38, np.inf, -np.inf, np.nan])


@pytest.mark.parametrize("known", [True, False])
def test_the_angle_of_a_vector_is_that_of_the_library(graph, x, known):
    y = graph.input(np.float32)
    angles = np.float32(np.linspace(-np.pi, np.pi, 4001))
    ups = np.concatenate([np.repeat(ENDS, len(ENDS)), np.sin(angles)])
    alongs = np.concatenate([np.tile(ENDS, len(ENDS)), np.cos(angles)])
    if known:
        ours = np.float32([graph.apply("atan2", *pair) for pair in zip(ups, alongs, strict=True)])
    else:
        ours = evaluate_scalar(graph.apply("atan2", y, x), (y, ups), (x, alongs))
    exact = np.arctan2(np.float64(ups), np.float64(alongs))
    number = ~np.isnan(exact)
    np.testing.assert_array_equal(np.isnan(ours), ~number)
    np.testing.assert_array_equal(np.signbit(ours[number]), np.signbit(exact[number]))
    np.testing.assert_array_max_ulp(ours[number], np.float32(exact[number]), 4)


@pytest.mark.parametrize("known", [True, False])
def test_the_inverse_of_the_error_function_is_that_of_the_library(graph, x, known):
    near_one = 1 - np.arange(1, 500) * 2.0**-24
    numbers = np.float32([*np.linspace(-0.999, 0.999, 4001), *near_one, *-near_one])
    numbers = np.concatenate([numbers, np.float32([1, -1, 0.0, -0.0, 1.5, np.inf, np.nan])])
    if known:
        ours = np.float32([graph.apply("erf_inv", number) for number in numbers])
    else:
        ours = evaluate_scalar(graph.apply("erf_inv", x), (x, numbers))
    exact = special.erfinv(np.float64(numbers))
    np.testing.assert_array_equal(ours[-7:], np.float32([np.inf, -np.inf, 0, 0, *[np.nan] * 3]))
    np.testing.assert_array_max_ulp(ours[:-7], np.float32(exact[:-7]), 8)
