"""What an operation comes to is recorded in its place, if that is simpler."""

import math

import numpy as np
import pytest

from helpers.run_program import WORDS, evaluate_scalar
from onekernel.lower.scalar_ir import is_constant
from onekernel.lower.simplify import make_graph

ONE, TWO, ZERO = (np.float32(x) for x in (1, 2, 0))
YES, NO = np.bool_(True), np.bool_(False)


def test_what_changes_nothing_is_left_out(graph, x):
    assert graph.apply("add", ZERO, x) is x
    assert graph.apply("sub", x, ZERO) is x
    assert graph.apply("mul", x, ONE) is x
    assert graph.apply("div", x, ONE) is x
    assert graph.apply("max", x, x) is x
    assert graph.apply("pow", x, ONE) is x
    assert graph.apply("neg", graph.apply("neg", x)) is x


@pytest.mark.parametrize(("op", "other"), [("mul", ZERO), ("sub", None)])
def test_what_comes_to_nothing_is_zero(graph, x, op, other):
    result = graph.apply(op, x, x if other is None else other)
    assert is_constant(result)
    assert result == 0


def test_minus_one_times_a_number_is_its_negative(graph, x):
    assert graph.apply("mul", x, -ONE) is graph.apply("neg", x)


def test_logic_with_a_known_side_is_the_other_or_known(graph, flag):
    assert graph.apply("and", flag, YES) is flag
    assert not graph.apply("and", NO, flag)
    assert graph.apply("or", flag, NO) is flag
    assert graph.apply("or", YES, flag)
    assert graph.apply("xor", flag, NO) is flag
    assert graph.apply("xor", YES, flag) is graph.apply("not", flag)
    assert graph.apply("not", graph.apply("not", flag)) is flag


@pytest.mark.parametrize("op", ["exp", "expm1", "log", "log1p", "tanh"])
def test_approximate_functions_are_instructions_and_few_operations(op):
    graph = make_graph(approximate=True)
    x, numbers = graph.input(np.float32), np.float32(np.linspace(-0.9, 80, 4001))
    numbers = numbers[numbers > 0] if op == "log" else numbers
    ours = evaluate_scalar(graph.apply(op, x), (x, numbers))
    reference = getattr(np, op)(np.float64(numbers))
    np.testing.assert_allclose(ours, reference, rtol=1e-6, atol=3e-7)
    assert graph.count <= 8


def test_approximate_quotients_share_the_reciprocal():
    graph = make_graph(approximate=True)
    x, y, z = (graph.input(np.float32) for _ in range(3))
    quotients = [graph.apply("div", one, z) for one in (x, y, ONE)]
    given = (x, np.float32([6])), (y, np.float32([-3])), (z, np.float32([4]))
    assert [evaluate_scalar(one, *given)[0] for one in quotients] == [1.5, -0.75, 0.25]
    assert graph.count == 3 + 3
    # Integers are still divided, and a division by a constant still becomes a product.
    whole = graph.input(np.int32)
    assert evaluate_scalar(graph.apply("div", whole, np.int32(4)), (whole, np.int32([-7]))) == [-1]
    assert graph.apply("div", x, TWO).op == "mul"


def test_the_sign_of_a_number_is_that_of_the_library(graph, x):
    numbers = np.float32([-3, -0.0, 0, 2, np.nan])
    np.testing.assert_array_equal(
        evaluate_scalar(graph.apply("sign", x), (x, numbers)), np.sign(numbers)
    )


DIVISORS = [1, 2, 3, 1000, 2**31 - 1]


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("dtype", [np.int32, np.uint32])
@pytest.mark.parametrize("op", ["div", "rem"])
def test_whole_numbers_are_divided_by_what_is_known(graph, op, dtype, known):
    numbers = WORDS.view(dtype)
    reference = {"div": lambda x, by: int(x / by), "rem": math.fmod}[op]
    divisors = [*DIVISORS, *([2**31, 2**32 - 1] if dtype == np.uint32 else [])]
    for by in map(dtype, divisors):
        if known:
            ours = [graph.apply(op, number, by) for number in numbers]
        else:
            x = graph.input(dtype)
            ours = evaluate_scalar(graph.apply(op, x, by), (x, numbers))
        np.testing.assert_array_equal(ours, [reference(int(x), int(by)) for x in numbers])


SHIFTS = {
    "shift_left": lambda x, by: (x << by) % 2**32,
    "shift_right_logical": lambda x, by: x >> by,
    "rotate_left": lambda x, by: (x << by | x >> (32 - by)) % 2**32,
}


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("op", SHIFTS)
def test_words_are_shifted_by_what_is_known(graph, op, known):
    for dtype in (np.uint32, np.int32) if op != "rotate_left" else (np.uint32,):
        numbers = WORDS.view(dtype)
        for by in (0, 1, 13, 31):
            if known:
                ours = np.array([graph.apply(op, number, dtype(by)) for number in numbers])
            else:
                x = graph.input(dtype)
                ours = evaluate_scalar(graph.apply(op, x, dtype(by)), (x, numbers))
            assert ours.dtype == dtype
            wanted = [SHIFTS[op](int(word), by) for word in WORDS]
            np.testing.assert_array_equal(ours.view(np.uint32), wanted)
