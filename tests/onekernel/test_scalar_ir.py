"""Recorded arithmetic: constants are folded, and a repeated operation is recorded once."""

import jax.numpy as jnp
import numpy as np
import pytest

from helpers.run_program import WORDS, evaluate_scalar
from onekernel.errors import UnsupportedError
from onekernel.lower import evaluation, scalar_ir
from onekernel.lower.indexing import scalar_array
from onekernel.lower.jaxpr import ScalarProgram
from onekernel.lower.scalar_ir import is_constant, is_same
from onekernel.lower.schedule import schedule
from onekernel.lower.simplify import make_graph

ONE, TWO, ZERO = (np.float32(x) for x in (1, 2, 0))
YES, NO = np.bool_(True), np.bool_(False)


def test_what_is_known_is_computed(graph):
    result = graph.apply("mul", np.float32(3), graph.apply("sub", TWO, np.float32(0.5)))
    assert is_constant(result)
    assert result == 4.5
    assert result.dtype == np.float32


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


@pytest.mark.parametrize("which", [True, False])
@pytest.mark.parametrize("no", [True, False])
@pytest.mark.parametrize("yes", [True, False])
def test_a_selection_between_truths_is_logic(graph, which, no, yes):
    flags = [graph.input(np.bool_) for _ in range(3)]
    result = graph.select(*flags)
    given = zip(flags, np.array([[which], [no], [yes]]), strict=True)
    assert evaluate_scalar(result, *given) == [yes if which else no]


@pytest.mark.parametrize("known", [True, False])
def test_half_a_number_is_rounded_to_the_even_one(graph, x, known):
    numbers = np.float32([0.5, 1.5, 2.5, -0.5, -1.5, -0.3, 0.7, 4194304.5, 8388607.5, 2**24 + 2])
    wanted = np.float32([0, 2, 2, -0.0, -2, -0.0, 1, 4194304, 8388608, 2**24 + 2])
    if known:
        ours = np.float32([graph.apply("round", number) for number in numbers])
    else:
        ours = evaluate_scalar(graph.apply("round", x), (x, numbers))
    np.testing.assert_array_equal(ours, wanted)
    np.testing.assert_array_equal(np.signbit(ours), np.signbit(wanted))


def test_whole_numbers_divide_towards_zero(graph):
    assert graph.apply("div", np.int32(-7), np.int32(2)) == -3


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
        ours = evaluate_scalar(graph.apply(op, one, other), (one, PAIRS[0]), (other, PAIRS[1]))
    elif known == 1:
        results = [graph.apply(op, one, word) for word in WORDS]
        columns = [evaluate_scalar(result, (one, WORDS)) for result in results]
        ours = np.concatenate(columns)
    else:
        ours = np.array([graph.apply(op, *pair) for pair in zip(*PAIRS, strict=True)])
    theirs = WORD_OPERATIONS[op](*PAIRS)
    assert ours.dtype == theirs.dtype
    np.testing.assert_array_equal(ours, theirs)


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
        ours = evaluate_scalar(graph.convert(x, to), (x, numbers))
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
        ours = evaluate_scalar(graph.convert(x, whole), (x, numbers))
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
    graph = make_graph(approximate=True)
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
    graph = make_graph()
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


def test_a_truth_value_that_a_loop_has_stored_is_a_word_there_and_back(graph, x):
    loop = graph.begin_loop([], 3)
    truth = graph.apply("lt", graph.convert(loop.counter, x.dtype), x)
    whole = graph.convert(x, np.dtype(np.int32))
    loop.stacked = [graph.convert(truth, np.dtype(np.int32)), graph.apply("add", whole, whole)]
    graph.end_loop(loop)
    truths, numbers = ([graph.load(y, np.int32(i)) for i in range(3)] for y in graph.stacks(loop))
    read = [graph.convert(y, np.dtype(bool)) for y in truths]
    assert [graph.convert(y, np.dtype(np.int32)) for y in read] == truths
    assert graph.convert(read[0], np.dtype(np.float32)).op == "convert"
    # Other whole numbers are not: 2 becomes 1.
    again = graph.convert(graph.convert(numbers[0], np.dtype(bool)), np.dtype(np.int32))
    assert again is not numbers[0]


def test_an_array_has_words_of_one_dtype(graph, x, flag):
    for scalars in ([x, np.int32(1)], [flag, YES]):
        with pytest.raises(UnsupportedError, match="an array of"):
            graph.array(scalars)
