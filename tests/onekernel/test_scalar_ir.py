"""Recorded arithmetic: constants are folded, and a repeated operation is recorded once."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special

from helpers import run_program
from onekernel.errors import UnsupportedError
from onekernel.lower import evaluation, scalar_ir
from onekernel.lower.indexing import scalar_array
from onekernel.lower.jaxpr import ScalarProgram
from onekernel.lower.scalar_ir import ExprGraph, is_constant, is_same
from onekernel.lower.schedule import schedule

ONE, TWO, ZERO = (np.float32(x) for x in (1, 2, 0))
YES, NO = np.bool_(True), np.bool_(False)


@pytest.fixture
def graph():
    return ExprGraph()


@pytest.fixture
def x(graph):
    return graph.input(np.float32)


@pytest.fixture
def flag(graph):
    return graph.input(np.bool_)


def test_what_is_known_is_computed(graph):
    result = graph.apply("mul", np.float32(3), graph.apply("sub", TWO, np.float32(0.5)))
    assert is_constant(result)
    assert result == 4.5
    assert result.dtype == np.float32


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


def test_the_same_operation_is_recorded_once(graph, x):
    y = graph.input(np.float32)
    assert graph.apply("add", x, y) is graph.apply("add", y, x)
    assert graph.apply("sub", x, y) is not graph.apply("sub", y, x)
    assert graph.apply("add", x, ONE) is not graph.apply("add", x, TWO)


def test_zero_and_minus_zero_are_not_taken_for_each_other(graph, x):
    assert graph.apply("atan2", x, ZERO) is not graph.apply("atan2", x, -ZERO)


def test_selection_by_what_is_known_or_between_equals_needs_no_selection(graph, x, flag):
    y = graph.input(np.float32)
    assert graph.select(YES, x, y) is y
    assert graph.select(NO, x, y) is x
    assert graph.select(flag, x, x) is x
    assert graph.select(graph.apply("not", flag), x, y) is graph.select(flag, y, x)


def evaluate(result, *inputs):
    """A number for each robot; `inputs` are what it depends on, with an array of numbers each."""
    values, columns = zip(*inputs, strict=True)
    leaves = [scalar_array([value], ()) for value in values]
    program = ScalarProgram(leaves, [scalar_array([result], ())], schedule([result]))
    (ends,) = run_program.evaluate(program, columns)
    return ends


@pytest.mark.parametrize("which", [True, False])
@pytest.mark.parametrize("no", [True, False])
@pytest.mark.parametrize("yes", [True, False])
def test_a_selection_between_truths_is_logic(graph, which, no, yes):
    flags = [graph.input(np.bool_) for _ in range(3)]
    result = graph.select(*flags)
    given = zip(flags, np.array([[which], [no], [yes]]), strict=True)
    assert evaluate(result, *given) == [yes if which else no]


@pytest.mark.parametrize(("op", "reference"), [("sin", np.sin), ("cos", np.cos)])
def test_sine_and_cosine_are_those_of_the_library(graph, x, op, reference):
    angles = np.float32(np.concatenate([np.linspace(-9, 9, 4001), np.linspace(-5e3, 5e3, 4001)]))
    ours = evaluate(graph.apply(op, x), (x, angles))
    np.testing.assert_allclose(ours, reference(np.float64(angles)), atol=3e-7)


@pytest.mark.parametrize("op", ["exp", "expm1", "log", "log1p", "tanh"])
def test_approximate_functions_are_instructions_and_few_operations(op):
    graph = ExprGraph(approximate=True)
    x, numbers = graph.input(np.float32), np.float32(np.linspace(-0.9, 80, 4001))
    numbers = numbers[numbers > 0] if op == "log" else numbers
    ours = evaluate(graph.apply(op, x), (x, numbers))
    reference = getattr(np, op)(np.float64(numbers))
    np.testing.assert_allclose(ours, reference, rtol=1e-6, atol=3e-7)
    assert graph.count <= 8


def test_approximate_quotients_share_the_reciprocal():
    graph = ExprGraph(approximate=True)
    x, y, z = (graph.input(np.float32) for _ in range(3))
    quotients = [graph.apply("div", one, z) for one in (x, y, ONE)]
    given = (x, np.float32([6])), (y, np.float32([-3])), (z, np.float32([4]))
    assert [evaluate(one, *given)[0] for one in quotients] == [1.5, -0.75, 0.25]
    assert graph.count == 3 + 3
    # Integers are still divided, and a division by a constant still becomes a product.
    whole = graph.input(np.int32)
    assert evaluate(graph.apply("div", whole, np.int32(4)), (whole, np.int32([-7]))) == [-1]
    assert graph.apply("div", x, TWO).op == "mul"


def test_the_sign_of_a_number_is_that_of_the_library(graph, x):
    numbers = np.float32([-3, -0.0, 0, 2, np.nan])
    np.testing.assert_array_equal(evaluate(graph.apply("sign", x), (x, numbers)), np.sign(numbers))


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
        ours = evaluate(graph.apply("atan2", y, x), (y, ups), (x, alongs))
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
        ours = evaluate(graph.apply("erf_inv", x), (x, numbers))
    exact = special.erfinv(np.float64(numbers))
    np.testing.assert_array_equal(ours[-7:], np.float32([np.inf, -np.inf, 0, 0, *[np.nan] * 3]))
    np.testing.assert_array_max_ulp(ours[:-7], np.float32(exact[:-7]), 8)


@pytest.mark.parametrize("known", [True, False])
def test_half_a_number_is_rounded_to_the_even_one(graph, x, known):
    numbers = np.float32([0.5, 1.5, 2.5, -0.5, -1.5, -0.3, 0.7, 4194304.5, 8388607.5, 2**24 + 2])
    wanted = np.float32([0, 2, 2, -0.0, -2, -0.0, 1, 4194304, 8388608, 2**24 + 2])
    if known:
        ours = np.float32([graph.apply("round", number) for number in numbers])
    else:
        ours = evaluate(graph.apply("round", x), (x, numbers))
    np.testing.assert_array_equal(ours, wanted)
    np.testing.assert_array_equal(np.signbit(ours), np.signbit(wanted))


def test_whole_numbers_divide_towards_zero(graph):
    assert graph.apply("div", np.int32(-7), np.int32(2)) == -3


WORDS = np.uint32([0, 1, 7, 2**24 + 1, 2**31 - 1, 2**31, 2**31 + 129, 2**32 - 129, 2**32 - 1])
PAIRS = [x.ravel() for x in np.meshgrid(WORDS, WORDS)]
WORD_OPERATIONS = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "max": np.maximum,
    "min": np.minimum,
    "and": np.bitwise_and,
    "or": np.bitwise_or,
    "xor": np.bitwise_xor,
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
    "eq": np.equal,
    "ne": np.not_equal,
}


@pytest.mark.parametrize("known", [0, 1, 2])
@pytest.mark.parametrize("op", WORD_OPERATIONS)
def test_words_without_a_sign_are_those_of_the_library(graph, op, known):
    one, other = graph.input(np.uint32), graph.input(np.uint32)
    if known == 0:
        ours = evaluate(graph.apply(op, one, other), (one, PAIRS[0]), (other, PAIRS[1]))
    elif known == 1:
        results = [graph.apply(op, one, word) for word in WORDS]
        columns = [evaluate(result, (one, WORDS)) for result in results]
        ours = np.concatenate(columns)
    else:
        ours = np.array([graph.apply(op, *pair) for pair in zip(*PAIRS, strict=True)])
    theirs = WORD_OPERATIONS[op](*PAIRS)
    assert ours.dtype == theirs.dtype
    np.testing.assert_array_equal(ours, theirs)


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
            ours = evaluate(graph.apply(op, x, by), (x, numbers))
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
                ours = evaluate(graph.apply(op, x, dtype(by)), (x, numbers))
            assert ours.dtype == dtype
            wanted = [SHIFTS[op](int(word), by) for word in WORDS]
            np.testing.assert_array_equal(ours.view(np.uint32), wanted)


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("to", [np.float32, np.int32, np.uint32, bool])
@pytest.mark.parametrize("source", [np.float32, np.int32, np.uint32, bool])
def test_conversions_are_those_of_jax(graph, source, to, known):
    numbers = {
        np.float32: np.float32(
            [*range(-3, 4), 0.7, -0.7, -0.0, 2**31, 2**32 - 256, 2**32, -(2**31)]
        ),
        np.int32: WORDS.view(np.int32),
        np.uint32: WORDS,
        bool: np.array([True, False]),
    }[source]
    if source == np.float32:
        numbers = np.append(numbers, np.float32([1e20, -1e20, np.inf, -np.inf, np.nan]))
    to = np.dtype(to)
    theirs = np.asarray(jnp.asarray(numbers).astype(to))
    if known:
        ours = np.array([graph.convert(number, to) for number in numbers])
    else:
        x = graph.input(source)
        ours = evaluate(graph.convert(x, to), (x, numbers))
    assert ours.dtype == theirs.dtype
    np.testing.assert_array_equal(ours, theirs)


def test_what_is_converted_there_and_back_is_what_it_was(graph):
    word = graph.input(np.uint32)
    whole = graph.convert(word, np.dtype(np.int32))
    assert graph.convert(whole, np.dtype(np.uint32)) is word
    assert graph.convert(word, np.dtype(np.uint32)) is word


@pytest.mark.parametrize("known", [True, False])
def test_a_float_becomes_the_nearest_whole_number_there_is_towards_zero(graph, x, known):
    numbers = np.float32([-2.75, 2.75, 3e9, -3e9, np.inf, np.nan])
    whole = np.dtype(np.int32)
    if known:
        ours = [graph.convert(number, whole) for number in numbers]
    else:
        ours = evaluate(graph.convert(x, whole), (x, numbers))
    np.testing.assert_array_equal(ours, [-2, 2, 2**31 - 1, -(2**31), 2**31 - 1, 0])


def test_numbers_are_the_same_by_what_they_are_and_not_by_what_they_equal(graph, x):
    assert is_same(x, x)
    assert is_same(np.float32(np.nan), np.float32(np.nan))
    assert not is_same(x, graph.input(np.float32))
    assert not is_same(x, ZERO)
    assert not is_same(ZERO, -ZERO)
    assert not is_same(ZERO, np.int32(0))


def test_of_a_branch_what_both_sides_agree_on_is_no_choice(graph, x, flag):
    y = graph.input(np.float32)
    same, other, nan = graph.branch(
        flag, [x, y, np.float32(np.nan)], [x, graph.apply("neg", y), np.float32(np.nan)]
    )
    assert same is x
    assert np.isnan(nan)
    assert (other.op, other.place) == ("result", 1)


def test_too_many_operations_are_refused(graph, x, monkeypatch):
    monkeypatch.setattr(scalar_ir, "MAX_OPERATIONS", 10)
    for _ in range(9):
        x = graph.apply("sqrt", x)
    with pytest.raises(UnsupportedError, match="more than 10 operations"):
        graph.apply("sqrt", x)


def test_a_program_is_evaluated_in_the_precision_of_its_numbers():
    graph = ExprGraph(approximate=True)
    x, y = graph.input(np.float32), graph.input(np.float32)
    below = graph.apply("lt", x, y)
    ends = [graph.select(below, graph.apply("div", x, y), graph.apply("exp", x)), ZERO]
    ends.append(graph.convert(below, np.dtype(np.float32)))
    arrays = [scalar_array([one], ()) for one in (x, y)], [scalar_array(ends, (3,))]
    a, b = np.array([0.1, 3.0]), np.array([0.7, 0.3])
    result, zero, less = evaluation.evaluate(ScalarProgram(*arrays, schedule(ends)), [a, b])
    assert result.dtype == np.float64
    np.testing.assert_allclose(result, [np.exp(0.1), 10.0], rtol=1e-15)
    np.testing.assert_array_equal(zero, 0)
    np.testing.assert_array_equal(less, [1, 0])


def test_a_program_with_a_branch_is_not_evaluated(graph, x, flag):
    chosen = graph.branch(flag, [x], [graph.apply("sqrt", x)])
    inputs = [scalar_array([one], ()) for one in (x, flag)]
    program = ScalarProgram(inputs, [scalar_array(chosen, (1,))], schedule(chosen))
    with pytest.raises(UnsupportedError, match="a loop or a branch"):
        evaluation.evaluate(program, [np.ones(1), np.ones(1, bool)])


def test_what_is_not_known_here_is_named(graph, x):
    with pytest.raises(UnsupportedError, match="cbrt"):
        graph.apply("cbrt", x)
    with pytest.raises(UnsupportedError, match="float16"):
        graph.convert(x, np.dtype(np.float16))


def test_an_expression_is_named_and_not_written_out():
    """Written out, shared operands would double at every level, and a jaxpr prints its kernel."""
    graph = ExprGraph()
    value = graph.input(np.float32)
    for _ in range(64):
        value = graph.apply("mul", value, value)
    assert len(repr(value)) < 200


def test_an_array_is_read_only_where_no_scalar_is_known(graph, x):
    index = graph.convert(x, np.dtype(np.int32))
    array = graph.array([x, ONE, graph.apply("neg", x)])
    assert graph.array([x, ONE, graph.apply("neg", x)]) is array
    assert graph.load(array, np.int32(1)) is ONE
    assert graph.load(array, index).op == "load"
    assert graph.load(array, index) is graph.load(array, index)
    # The numbers 0, 1, 2, ... are their own indices.
    assert graph.load(graph.array([np.int32(i) for i in range(5)]), index) is index
    assert graph.load(graph.array([np.int32(i) for i in (0, 2, 1)]), index).op == "load"
    assert [scalar_ir.is_table(each) for each in (array, graph.array([ONE, TWO]))] == [False, True]


def test_what_a_loop_has_stored_is_an_array_already(graph, x):
    loop = graph.begin_loop([], 3)
    loop.stacked = [graph.apply("mul", x, graph.convert(loop.counter, x.dtype)), x]
    graph.end_loop(loop)
    stack, other = graph.stacks(loop)
    loads = [graph.load(stack, np.int32(i)) for i in range(3)]
    assert graph.array(loads) is stack
    assert scalar_ir.length_of(stack) == 3
    for others in (loads[:2], loads[::-1], [*loads[:2], graph.load(other, np.int32(2))]):
        assert graph.array(others).op == "array"


def test_an_array_has_words_of_one_dtype(graph, x, flag):
    for scalars in ([x, np.int32(1)], [flag, YES]):
        with pytest.raises(UnsupportedError, match="an array of"):
            graph.array(scalars)
