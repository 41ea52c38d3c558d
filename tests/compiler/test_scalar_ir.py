"""Arithmetic that is written down: what is known is done, what is shared is shared."""

import numpy as np
import pytest
import run_program

from jetbot_mjx.compiler import scalar_ir
from jetbot_mjx.compiler.indexing import scalar_array
from jetbot_mjx.compiler.lower_jaxpr import ScalarProgram
from jetbot_mjx.compiler.scalar_ir import ExprGraph, UnsupportedError, is_constant, is_same
from jetbot_mjx.compiler.schedule import schedule

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


def test_the_sign_of_a_number_is_that_of_the_library(graph, x):
    numbers = np.float32([-3, -0.0, 0, 2, np.nan])
    np.testing.assert_array_equal(evaluate(graph.apply("sign", x), (x, numbers)), np.sign(numbers))


def test_whole_numbers_divide_towards_zero(graph):
    assert graph.apply("div", np.int32(-7), np.int32(2)) == -3


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
