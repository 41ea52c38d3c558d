"""Kernels as WebAssembly, called as a web page does it; Node stands for the browser."""

import math
import shutil
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import map_kernels, node
from helpers.kernel_cases import ARITHMETIC, LOOPS, SCANS, VECTOR, robots
from helpers.large_arrays import remembered
from onekernel import KernelError, UnsupportedError, fuse, wasm
from onekernel.codegen import LlvmWriter
from onekernel.cpu import BLOCK_PARAMETERS, array_of
from onekernel.kernel import Kernel
from onekernel.lower.jaxpr import scalarize

pytest.importorskip("llvmlite")

KEY = jax.ShapeDtypeStruct((2,), jnp.uint32)
WORDS = jax.ShapeDtypeStruct((3,), jnp.uint32)
WHOLE = jax.ShapeDtypeStruct((3,), jnp.int32)
ANGLE = jax.ShapeDtypeStruct((), jnp.float32)

SHOWN = (
    "arithmetic",
    "extremes",
    "whole numbers",
    "comparisons",
    "what is finite",
    "a loop in a loop",
    "one of four",
    "an index that counts",
    "several sequences",
    "a scan in a loop",
    "a place in a table",
)
"""Functions of `kernel_cases` that a module has, of every kind one."""


def _words(x):
    """Arithmetic without a sign, which wraps, and shifts by as many bits as there are or more."""
    a, b, c = x
    most = jnp.maximum(b, jnp.uint32(1))
    return jnp.stack([a * b + c, a - b, a // most, a % most, a >> 3, a << (b % 40), ~a ^ (b & c)])


def _whole(x):
    """Divisions that trap in WebAssembly: by zero, and of the smallest number by -1."""
    a, b, c = x
    quotient, rest = jax.lax.div(a, b), jax.lax.rem(a, b)
    return jnp.stack([quotient, rest, a * c, jnp.abs(a), a >> 2, (a < b).astype(jnp.int32)])


def _numbers(key):
    """What a page draws: keys, bits, and numbers between 0 and 1."""
    bits = jax.random.bits(key, (5,)), jax.random.split(key), jax.random.fold_in(key, 7)
    return *bits, jax.random.uniform(key, (3,)), jax.random.randint(key, (2,), -7, 9)


FUNCTIONS = {
    **{name: (function, VECTOR) for name, function in {**ARITHMETIC, **LOOPS, **SCANS}.items()},
    "words": (_words, WORDS),
    "whole": (_whole, WHOLE),
    "drawn": (_numbers, KEY),
    "angles": (lambda x: (jnp.sin(x), jnp.cos(x)), ANGLE),
    "normal": (jax.random.normal, KEY),
}
LINKED = (*SHOWN, "words", "whole", "drawn", "angles", "normal")

NAMES = {name: f"f{i}" for i, name in enumerate(LINKED)}
"""The names of functions in the module, which are those of a language."""

MAP_ITEMS = 67
HALVES = 5


def thrice():
    """A kernel whose step is made three times, of one number and one that stays."""
    program = scalarize(lambda x, held: x * held + 1.0, ANGLE, ANGLE)
    return Kernel(program, carried=1, steps=3, fallback=list)


def sums_of_products():
    """A function of arrays of `double`: fused multiply-adds."""
    w = LlvmWriter("products", *(f"ptr {x}" for x in "abcr"), "u32 count", convention="external")
    *arrays, result, count = w.parameters
    with w.loop(count.to("u64")) as i:
        numbers = (x.at(i, "double").load("double") for x in arrays)
        result.at(i, "double").store(w.intrinsic("fma", *numbers))
    return wasm.module_text([w])


def halves():
    """A function of blocks: each adds its index to half a number, by way of the scratch memory."""
    w = LlvmWriter("block", *BLOCK_PARAMETERS)
    job, index, scratch = w.parameters
    scratch.at(15, "float").store(array_of(job, 0).at(index, "float").load("float") * 0.5)
    total = scratch.at(15, "float").load("float") + index.to("float")
    array_of(job, 1).at(index, "float").store(total)
    return wasm.blocks_text("halves", [w], arrays=2, blocks=HALVES)


@pytest.fixture(scope="module")
def module():
    if reason := wasm.obstacle():
        pytest.skip(reason)
    texts = {}
    for name, linked in NAMES.items():
        function, like = FUNCTIONS[name]
        kernel = fuse(function, on_unsupported="raise").lowered(like).one
        texts[linked] = wasm.step_text(linked, kernel)
    texts["thrice"] = wasm.step_text("thrice", thrice())
    texts["pixels"] = wasm.map_text("pixels", map_kernels.make(MAP_ITEMS)[1])
    texts["products"], texts["halves"] = sums_of_products(), halves()
    return wasm.link(texts)


CALLS = """
const { exports } = new WebAssembly.Instance(await WebAssembly.compile(given.module), {});
const [results, addresses] = [[], []];
let top = exports.__heap_base.value;
for (const array of given.arrays) {
  // Behind each array there are 64 bytes that no function may change.
  top = Math.ceil(top / 64) * 64;
  addresses.push(top);
  top += array.byteLength + 64;
}
exports.memory.grow(Math.ceil(top / 65536));
const bytes = new Uint8Array(exports.memory.buffer);
given.arrays.forEach((array, i) => {
  bytes.set(new Uint8Array(array.buffer), addresses[i]);
  bytes.fill(0xa5, addresses[i] + array.byteLength, addresses[i] + array.byteLength + 64);
});
exports[given.name](...given.order.map((i) => addresses[i]), ...given.last);
given.arrays.forEach((array, i) => {
  const end = addresses[i] + array.byteLength;
  if (bytes.subarray(end, end + 64).some((x) => x !== 0xa5)) throw Error(`array ${i} is overrun`);
  results.push(new array.constructor(bytes.slice(addresses[i], end).buffer));
});
return results;
"""


def call(module, name, arrays, order=None, last=()):
    """Call a function with the addresses of arrays, which are returned as they are afterwards."""
    order = list(range(len(arrays))) if order is None else order
    given = {"module": module, "name": name, "arrays": arrays, "order": order, "last": list(last)}
    results = node.run(CALLS, page=False, **given)
    return [x.reshape(array.shape) for x, array in zip(results, arrays, strict=True)]


def apply(module, name, argument):
    """The results of a function of all instances, and what `jax.vmap` makes of them."""
    theirs = [
        np.asarray(x) for x in jax.tree.leaves(jax.jit(jax.vmap(FUNCTIONS[name][0]))(argument))
    ]
    # Bytes of NaN where a result is not written.
    empty = [np.full(x.shape, 2**32 - 1, np.uint32).view(x.dtype) for x in theirs]
    given, *ours = call(module, NAMES[name], [argument, *empty], last=[len(argument)])
    np.testing.assert_array_equal(given, argument)
    return ours, theirs


@pytest.mark.parametrize("name", SHOWN)
def test_a_function_of_numbers_does_what_jax_does(name, module):
    # As many robots as fill no vector.
    (ours,), (theirs,) = apply(module, name, robots(11))
    np.testing.assert_allclose(ours, theirs, rtol=2e-5, atol=2e-6)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 8, 1023])
def test_any_number_of_instances_is_stepped_and_nothing_else_is_written(count, module):
    (ours,), (theirs,) = apply(module, "arithmetic", robots(count))
    np.testing.assert_allclose(ours, theirs, rtol=2e-6, atol=1e-6)


def test_no_instance_is_nothing_to_do(module):
    given = [np.full((4, 4), x, np.float32) for x in (1, 2)]
    for before, after in zip(
        given, call(module, NAMES["arithmetic"], given, last=[0]), strict=True
    ):
        np.testing.assert_array_equal(before, after)


def test_the_bits_of_words_are_those_of_jax(module):
    ends = [[0, 0, 0], [2**32 - 1, 0, 1], [2**32 - 1, 2**32 - 1, 2**32 - 1], [2**31, 39, 5]]
    random = np.random.default_rng(0).integers(0, 2**32, (57, 3), np.uint32)
    (ours,), (theirs,) = apply(module, "words", np.concatenate([np.uint32(ends), random]))
    np.testing.assert_array_equal(ours, theirs)


def test_whole_numbers_are_divided_by_zero_as_by_jax(module):
    ends = [[7, 0, 0], [-7, 0, 3], [-(2**31), -1, 2], [-(2**31), 0, -1], [2**31 - 1, -1, 9]]
    random = np.random.default_rng(0).integers(-(2**31), 2**31, (58, 3)).astype(np.int32)
    (ours,), (theirs,) = apply(module, "whole", np.concatenate([np.int32(ends), random]))
    np.testing.assert_array_equal(ours, theirs)


def test_random_numbers_are_those_of_jax_to_the_bit(module):
    ends = [[0, 0], [0, 2**32 - 1], [2**32 - 1, 2**32 - 1], [2**31, 2**31]]
    random = np.random.default_rng(0).integers(0, 2**32, (203, 2), np.uint32)
    keys = np.concatenate([np.uint32(ends), random])
    ours, theirs = apply(module, "drawn", keys)
    for one, other in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(one, other)
    (ours,), (theirs,) = apply(module, "normal", keys)
    np.testing.assert_allclose(ours, theirs, rtol=2e-5, atol=1e-7)


def test_sine_and_cosine_are_right_up_to_a_million(module):
    rng = np.random.default_rng(0)
    angles = np.concatenate([rng.uniform(-1e6, 1e6, 4000), rng.uniform(-9, 9, 999)])
    # Beside multiples of a quarter turn, where few digits are left.
    whole = np.arange(0, 640_000, 997) * (math.pi / 2)
    angles = np.float32([*angles, *whole, *-whole, 0.0, 1e6, -1e6])
    ours, _ = apply(module, "angles", angles)
    for one, exact in zip(ours, (np.sin, np.cos), strict=True):
        np.testing.assert_allclose(one, exact(np.float64(angles)), rtol=0, atol=1.2e-7)
    # The sine of a small result is right to its own last digits.
    small = np.abs(np.sin(np.float64(angles))) < 1e-3
    assert small.sum() > 50
    np.testing.assert_allclose(ours[0][small], np.sin(np.float64(angles[small])), rtol=3e-7)


def test_a_product_and_a_sum_are_rounded_once(module):
    rng = np.random.default_rng(0)
    count = 3000
    a, b = rng.normal(size=(2, count)) * 10.0 ** rng.integers(-9, 9, (2, count))
    c = rng.normal(size=count) * 10.0 ** rng.integers(-18, 18, count)
    # What is left of a product is its rounding error, or little more.
    c[:1000] = -(a * b)[:1000]
    c[1000:2000] = np.nextafter(-(a * b)[1000:2000], 0)
    *_, ours = call(module, "products", [a, b, c, np.zeros(count)], last=[count])
    exact = [
        float(Fraction(x) * Fraction(y) + Fraction(z)) for x, y, z in zip(a, b, c, strict=True)
    ]
    # Two roundings would be wrong in every other one of the first thousand.
    assert (a * b + c)[:1000].tolist() != exact[:1000]
    np.testing.assert_array_equal(ours[:2000], exact[:2000])
    np.testing.assert_allclose(ours, exact, rtol=np.finfo(float).eps / 2, atol=0)
    assert (ours != exact).mean() < 1e-3


def test_a_result_may_take_the_place_of_its_argument(module):
    x, held = np.float32(np.random.default_rng(0).normal(size=(2, 7)))
    expected = x
    for _ in range(3):
        expected = expected * held + 1
    changed, kept, result = call(module, "thrice", [x, held, np.zeros_like(x)], last=[7])
    np.testing.assert_array_equal([changed, kept], [x, held])
    np.testing.assert_allclose(result, expected, rtol=1e-6)
    in_place, _ = call(module, "thrice", [x, held], order=[0, 1, 0], last=[7])
    np.testing.assert_array_equal(in_place, result)


@pytest.mark.slow
@pytest.mark.parametrize("count", [0, 1, 9])
def test_an_image_is_made_of_every_item(count, module):
    table, _ = map_kernels.make(MAP_ITEMS)
    of_robot, number = map_kernels.robots(max(count, 1))
    pixels = np.zeros((max(count, 1), 3 * MAP_ITEMS), np.uint8)
    *_, ours = call(module, "pixels", [of_robot, number, table, pixels], last=[count])
    theirs = jax.vmap(lambda *x: map_kernels.reference(*x, table))(of_robot, number)
    different = ours[:count].astype(int) - np.asarray(theirs)[:count]
    assert np.all(ours[count:] == 0)
    if count:
        # A sum that is rounded once instead of twice may fall on the other side of a whole number.
        assert np.abs(different).max() <= 1
        assert (different != 0).mean() < 1e-3
        assert len(np.unique(ours)) > 20


def test_the_blocks_of_an_instance_are_computed_one_after_the_other(module):
    numbers = np.float32(np.random.default_rng(0).normal(size=HALVES))
    scratch = np.zeros(16, np.float32)
    _, result, _ = call(module, "halves", [numbers, np.zeros(HALVES + 2, np.float32), scratch])
    np.testing.assert_array_equal(
        result, [*(numbers * 0.5 + np.arange(HALVES, dtype=np.float32)), 0, 0]
    )


def test_arrays_that_the_stack_does_not_hold_are_refused():
    def kernel(length):
        program = scalarize(lambda x: remembered(x, length), VECTOR)
        return Kernel(program, carried=1, steps=1, fallback=list)

    assert "[262144 x i8]" in wasm.step_text("fits", kernel(4096))
    reason = "^arrays of 65,552 bytes for each instance, more than 65,536 on a page$"
    with pytest.raises(UnsupportedError, match=reason):
        wasm.step_text("large", kernel(4097))


def test_a_module_needs_nothing_and_is_the_same_every_time(module):
    interface = """
    const compiled = await WebAssembly.compile(given.module);
    const exported = WebAssembly.Module.exports(compiled);
    return { imports: WebAssembly.Module.imports(compiled), names: exported.map((x) => x.name) };
    """
    found = node.run(interface, page=False, module=module)
    assert found["imports"] == []
    functions = {*NAMES.values(), "thrice", "pixels", "products", "halves"}
    assert {*found["names"]} == {"memory", "__heap_base", *functions}
    texts = {"halves": halves()}
    assert wasm.link(texts) == wasm.link(texts)


@pytest.fixture
def linkers(monkeypatch):
    """Programs that this machine has, by name."""
    programs = {}
    monkeypatch.setattr(shutil, "which", programs.get)
    wasm._linker.cache_clear()
    yield programs
    wasm._linker.cache_clear()


def test_a_missing_linker_is_told_with_its_remedy(linkers):
    reason = "LLVM's linker wasm-ld is not installed: apt install lld, or brew install lld"
    assert wasm.obstacle() == reason
    with pytest.raises(KernelError) as caught:
        wasm.link({"halves": halves()})
    assert str(caught.value) == reason


def test_a_linker_of_any_version_is_found(linkers):
    linkers["wasm-ld-17"] = "/usr/lib/llvm-17/bin/wasm-ld"
    assert wasm.obstacle() is None


def test_what_a_linker_says_is_told(linkers, tmp_path):
    program = tmp_path / "wasm-ld"
    program.write_text("#!/bin/sh\necho 'this linker' >&2\necho 'refuses' >&2\nexit 1\n")
    program.chmod(0o755)
    linkers["wasm-ld"] = str(program)
    with pytest.raises(KernelError) as caught:
        wasm.link({"halves": halves()})
    assert str(caught.value) == f"{program}: this linker refuses"


def test_a_missing_compiler_is_told_with_its_remedy(linkers, monkeypatch):
    def missing():
        raise ImportError("no llvmlite")

    linkers["wasm-ld"] = "/usr/bin/wasm-ld"
    monkeypatch.setattr(wasm, "_binding", missing)
    assert wasm.obstacle() == "llvmlite cannot be used (no llvmlite): pip install llvmlite"
