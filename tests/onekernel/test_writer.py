"""What a writer of LLVM IR writes, compiled by llvmlite and called on this CPU."""

import ctypes
import re
import textwrap

import numpy as np
import pytest

from onekernel import cpu
from onekernel.codegen import LlvmWriter, Value, module_text, writer

pytest.importorskip("llvmlite")

EXAMPLE = textwrap.dedent(re.search(r"\n((?:    .*\n)+)", writer.__doc__)[1])

_C = {
    "float": ctypes.c_float,
    "double": ctypes.c_double,
    "ptr": ctypes.c_void_p,
    "i1": ctypes.c_bool,
    "i32": ctypes.c_int32,
    "u32": ctypes.c_uint32,
    "i64": ctypes.c_int64,
    "u64": ctypes.c_uint64,
    "void": None,
}
_engines = []


def external(*parameters, **options):
    """A function that Python can call."""
    return LlvmWriter("f", *parameters, convention="external", **options)


def compiled(*functions):
    """The function `f` of a module, in Python."""
    (own,) = (function for function in functions if function.name == "f")
    _engines.append(cpu._load(cpu._compile(module_text(functions))))
    kinds = [_C[x.type] for x in own.parameters]
    return ctypes.CFUNCTYPE(_C[own.result], *kinds)(_engines[-1].get_function_address("f"))


def computed(compute, kind, *numbers):
    """What a formula makes of numbers of a type."""
    names = [f"{kind} x{i}" for i in range(len(numbers))]
    result = compute(*external(*names).parameters)
    w = external(*names, result=result.type)
    w.ret(compute(*w.parameters))
    return compiled(w)(*numbers)


def address(array):
    return array.ctypes.data


def test_the_example_does_what_it_says():
    names = {"LlvmWriter": LlvmWriter, "module_text": module_text}
    exec(EXAMPLE, names)
    assert EXAMPLE.count("\n") <= 10
    scale = names["w"]
    assert names["text"] == module_text([scale])
    w = external("ptr array", "float factor", "u64 count")
    w.call("scale", *w.parameters)
    array = np.float32([0.25, 1, 2, -3, 7])
    compiled(scale, w)(address(array), 0.5, 4)
    np.testing.assert_array_equal(array, np.float32([0.125, 0.5, 1, -1.5, 7]))


@pytest.mark.parametrize(
    ("kind", "one", "other"),
    [("i32", -7, 2), ("i64", -(2**40), 3), ("u32", 2**32 - 7, 2), ("u64", 2**64 - 7, 10)],
)
def test_integers_have_the_signs_of_their_types(kind, one, other):
    def run(compute):
        return computed(compute, kind, one, other)

    limit = 2 ** int(kind[1:])
    sign = -1 if one < 0 else 1
    assert run(lambda x, y: x // y) == sign * (abs(one) // other)
    assert run(lambda x, y: x % y) == sign * (abs(one) % other)
    assert run(lambda x, y: x < y) == (one < other)
    assert run(lambda x, y: y <= x) == (other <= one)
    assert run(lambda x, y: x >= y) == (one >= other)
    assert run(lambda x, y: x >> y) == one >> other
    assert run(lambda x, y: (x + y) * 3 - y) % limit == ((one + other) * 3 - other) % limit
    assert run(lambda x, y: 5 - x) % limit == (5 - one) % limit
    assert run(lambda x, y: -x) % limit == -one % limit
    assert run(lambda x, y: (x & y) | (x ^ 6)) % limit == ((one & other) | (one ^ 6)) % limit
    assert run(lambda x, y: x.equals(one))
    assert not run(lambda x, y: x.equals(y))
    assert run(lambda x, y: x.to("double")) == float(one)


@pytest.mark.parametrize("kind", ["float", "double"])
def test_a_nan_is_different_from_everything_and_in_no_order(kind):
    nan = float("nan")
    for compare in ("__lt__", "__le__", "__gt__", "__ge__", "equals"):
        assert not computed(lambda x, y, by=compare: getattr(x, by)(y), kind, nan, 1.0)
    assert computed(lambda x: x.differs(x), kind, nan)
    assert not computed(lambda x: x.differs(x), kind, 1.0)
    assert computed(lambda x, y: ~(x < y) & (y <= x), kind, 2.0, 2.0)


def test_formulas_of_floats():
    formula = lambda x, y: (2.0 - x) / y + -x * 0.1  # noqa: E731
    ours = computed(formula, "float", 0.3, 0.7)
    assert ours == pytest.approx(formula(0.3, 0.7), rel=1e-6)
    assert computed(lambda x: 1 / x, "float", 8.0) == 0.125
    # A constant is rounded as the type is, and as large as that can hold.
    assert computed(lambda x: x + 0.1, "float", 0.0) == np.float32(0.1)
    assert computed(lambda x: x + 0.1, "double", 0.0) == 0.1
    assert computed(lambda x: x < float("inf"), "float", 3e38)


@pytest.mark.parametrize(
    ("kind", "to", "number", "wanted"),
    [
        ("i32", "i64", -3, -3),
        ("u32", "u64", 2**32 - 3, 2**32 - 3),
        ("i32", "u32", -1, 2**32 - 1),
        ("u64", "u32", 2**35 + 5, 5),
        ("i1", "i32", True, 1),
        ("float", "double", 0.1, float(np.float32(0.1))),
        ("double", "float", 0.1, float(np.float32(0.1))),
        ("float", "i32", -2.7, -2),
        ("u32", "float", 2**31, 2.0**31),
    ],
)
def test_a_conversion_keeps_the_number(kind, to, number, wanted):
    assert computed(lambda x: x.to(to), kind, number) == wanted


def test_bits_are_those_of_another_type():
    assert computed(lambda x: x.bits_as("u32"), "float", 1.0) == 0x3F800000


@pytest.mark.parametrize("count", [0, 1, 6])
def test_a_loop_runs_as_often_as_it_is_told(count):
    w = external("ptr array", "i32 count")
    array, number = w.parameters
    with w.loop(number) as i, w.loop(3) as j:
        place = i.to("u64") * 3 + j
        array[place] = array[place] + 1.0
    numbers = np.zeros(20, np.float32)
    compiled(w)(address(numbers), count)
    np.testing.assert_array_equal(numbers, np.arange(20) < 3 * count)


@pytest.mark.parametrize(("number", "steps"), [(1, 1), (7, 16), (27, 111)])
def test_a_loop_carries_values_and_leaves_the_last_ones(number, steps):
    # Collatz: x/2 or 3x + 1, until it is 1.
    w = external("u32 start", result="u32")
    with w.repeat(*w.parameters, w.constant(0, "u32")) as loop:
        x, count = loop.carried
        following = w.select((x % 2).equals(0), x // 2, x * 3 + 1)
        more = count + 1
        loop.again(following > 1, following, more)
    w.ret(more)
    found = compiled(w)(number)
    assert found == (3 if number == 1 else steps)


def test_what_is_inside_when_runs_only_then():
    w = external("ptr array", "i32 x", result="i32")
    array, x = w.parameters
    with w.when(x < 10):
        array[0] = 1.0
        with w.when(x < 5):
            array[1] = 2.0
            w.ret(x * 2)
    array[2] = 3.0
    w.ret(x)
    # Nothing follows what returns.
    assert not re.search(r"ret .*\n +br", w.text())
    function = compiled(w)
    for number, result, wanted in ((3, 6, [1, 2, 0]), (7, 7, [1, 0, 3]), (10, 10, [0, 0, 3])):
        numbers = np.zeros(3, np.float32)
        assert function(address(numbers), number) == result
        np.testing.assert_array_equal(numbers, wanted)


@pytest.mark.parametrize("lanes", [1, 4, 8])
def test_vectors_are_computed_lane_by_lane(lanes):
    w = external("ptr read", "ptr written", "float factor", lanes=lanes)
    read, written, factor = w.parameters
    # One float behind the array's start: a vector need not be aligned.
    x = (read + 1).load(w.vector)
    limited = w.select(x < 0.0, -x, w.maximum(x * factor.splat(lanes), 2.0))
    (written + 1).store(w.intrinsic("sqrt", limited))
    numbers = np.float32(np.arange(lanes + 1) - 3)
    results = np.zeros_like(numbers)
    compiled(w)(address(numbers), address(results), 0.75)
    wanted = np.sqrt(np.where(numbers < 0, -numbers, np.maximum(0.75 * numbers, 2)))
    np.testing.assert_allclose(results, [0, *wanted[1:]], rtol=1e-6)


def test_a_shuffle_takes_lanes_of_two_vectors():
    w = external("ptr array", lanes=4)
    (array,) = w.parameters
    first, second = array.load(w.vector), (array + 4).load(w.vector)
    array.store(w.shuffle(first, second, [7, 0, 5, 2]))
    numbers = np.arange(8, dtype=np.float32)
    compiled(w)(address(numbers))
    np.testing.assert_array_equal(numbers[:4], [7, 0, 5, 2])


def test_addresses_count_floats_or_other_elements():
    w = external("ptr array", "u64 place")
    array, place = w.parameters
    (array + place)[1] = 5.0
    array.at(6, "double").store(w.constant(7.0, "double"))
    (array + 0).store(1.0)
    numbers = np.zeros(14, np.float32)
    compiled(w)(address(numbers), 2)
    assert numbers[[0, 3]].tolist() == [1, 5]
    assert numbers.view(np.float64)[6] == 7


def test_functions_call_each_other_and_what_is_alike_is_in_a_module_once():
    def root():
        w = LlvmWriter("root", "float x", result="float")
        w.ret(w.intrinsic("sqrt", *w.parameters))
        return w

    w = external("float x", result="float")
    x = w.call("root", *w.parameters, result="float")
    w.ret(x + w.intrinsic("sqrt", x))
    text = module_text([root(), w, root()])
    assert text.count("declare float @llvm.sqrt.f32(float)") == 1
    assert text.count("define internal float @root") == 1
    assert compiled(root(), w)(16.0) == 6.0


@pytest.mark.parametrize(
    "mistake",
    [
        lambda w, i, x, p: i + x,
        lambda w, i, x, p: i if i < 3 else x,
        lambda w, i, x, p: x // 2.0,
        lambda w, i, x, p: i / 2,
        lambda w, i, x, p: p * 2,
        lambda w, i, x, p: p.to("u64"),
        lambda w, i, x, p: w.select(i < 3, 1, 2),
        lambda w, i, x, p: w.constant(0, "ptr"),
    ],
)
def test_a_mistake_is_found_where_it_is_written(mistake):
    w = LlvmWriter("f", "u32 i", "float x", "ptr p")
    with pytest.raises(TypeError):
        mistake(w, *w.parameters)


def test_a_loop_that_is_not_told_when_to_end_is_refused():
    w = LlvmWriter("f", "u32 x")
    with pytest.raises(AssertionError, match="when to run again"), w.repeat(*w.parameters):
        pass


def test_a_gpus_addresses_have_their_memories():
    w = LlvmWriter("f", "ptr addrspace(1) array", "u32 i", convention="ptx_kernel")
    array, i = w.parameters
    array[i] = array[i] + 1.0
    text = module_text([w])
    assert "define ptx_kernel void @f(ptr addrspace(1) %array, i32 %i) {" in text
    assert isinstance(array + i, Value)
    assert (array + i).type == "ptr addrspace(1)"


def test_memory_is_taken_where_a_function_begins():
    w = LlvmWriter("f", "ptr out", "u32 count", lanes=4)
    out, count = w.parameters
    with w.loop(count):
        own = w.allocate(3, "<4 x u32>", align=16)
        w.divide(0)
        w.divide(255)
        own.at(1, "<4 x u32>").store(w.constant(7, "<4 x u32>"), align=16)
    w.divide(256)
    out[0] = own[4]
    text = module_text([w])
    assert re.search(r"entry:\n  (%v\d+) = alloca \[3 x <4 x i32>\], align 16\n", text)
    # After many accesses of memory, another block begins.
    assert len(re.findall(r"^  more\d+:", text, re.MULTILINE)) == 1
    assert own.type == "ptr"
