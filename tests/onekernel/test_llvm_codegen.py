"""Kernels for CPUs, compiled and called as XLA does it; `test_llvm_backend` has XLA call them."""

import ctypes

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special

from helpers import call_frame
from helpers.call_frame import Pool
from helpers.kernel_cases import FUNCTIONS, LOOPS, SCANS, VECTOR, robots
from helpers.run_program import evaluate
from onekernel import cpu
from onekernel.codegen import LlvmWriter, require, run_program
from onekernel.cpu import xla_call
from onekernel.errors import UnsupportedError
from onekernel.kernel import Kernel
from onekernel.lower.jaxpr import scalarize

pytest.importorskip("llvmlite")
if cpu.obstacle():
    pytest.skip("there is no CPU that it is written for", allow_module_level=True)

LANES = cpu.host_processor().lanes
_engines = []


def text_of(program, carried=1, steps=1):
    return cpu.kernel_text(Kernel(program, carried=carried, steps=steps, fallback=list))


def compiled(program, carried=1, steps=1):
    """A kernel as a function of a call frame."""
    _engines.append(cpu._load(cpu._compile(text_of(program, carried, steps))))
    return call_frame.Handler(_engines[-1].get_function_address(cpu.NAME))


def run(program, arguments, carried=1, steps=1):
    outputs = [np.full_like(x, np.nan) for x in arguments[:carried]]
    assert call_frame.call(compiled(program, carried, steps), arguments, outputs) is None
    return outputs


@pytest.fixture(params=["as many lanes as there are", "one lane"])
def lanes(request, monkeypatch):
    """One lane is what a GPU's thread does."""
    if request.param == "one lane":
        host = cpu.host_processor()._replace(lanes=1)
        monkeypatch.setattr(cpu, "host_processor", lambda: host)
    return cpu.host_processor().lanes


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_kernel_does_what_the_function_does(name, lanes):
    function, x = FUNCTIONS[name], robots(2 * LANES + 3)
    program = scalarize(function, VECTOR)
    theirs = jax.vmap(function)(x)
    np.testing.assert_allclose(evaluate(program, [x])[0], theirs, rtol=2e-5, atol=2e-6)
    (ours,) = run(program, [x])
    np.testing.assert_allclose(ours, theirs, rtol=2e-5, atol=2e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", SCANS)
def test_arrays_hold_the_numbers_of_each_robot(name, lanes):
    function, x = SCANS[name], robots(2 * LANES + 3)
    program = scalarize(function, VECTOR)
    theirs = jax.jit(jax.vmap(function))(x)
    np.testing.assert_allclose(evaluate(program, [x])[0], theirs, rtol=2e-5, atol=2e-6)
    (ours,) = run(program, [x])
    np.testing.assert_allclose(ours, theirs, rtol=2e-5, atol=2e-6)


@pytest.mark.parametrize("name", {**LOOPS, **SCANS})
def test_a_lane_that_is_done_keeps_its_numbers(name):
    # Alone each robot ends its loops by itself; in a register the slowest keeps all of them there.
    x = robots(LANES)
    program = scalarize({**LOOPS, **SCANS}[name], VECTOR)
    handler = compiled(program)
    together = np.zeros_like(x)
    call_frame.call(handler, [x], [together])
    for i in range(LANES):
        alone = np.zeros((1, 4), np.float32)
        call_frame.call(handler, [x[i : i + 1]], [alone])
        np.testing.assert_array_equal(alone[0], together[i])


def test_what_is_not_a_number_stays_so_in_an_extreme():
    x = np.float32([[np.nan, 1, 2, 3]])
    (ours,) = run(scalarize(lambda x: jnp.maximum(x, x[::-1]) + jnp.minimum(1.5, x), VECTOR), [x])
    np.testing.assert_array_equal(np.isnan(ours), [[True, False, False, True]])
    (ours,) = run(scalarize(lambda x: jnp.maximum(x, 0.0), VECTOR), [x])
    np.testing.assert_array_equal(ours, x)
    (ours,) = run(scalarize(lambda x: jnp.minimum(x[::-1], x), VECTOR), [x])
    np.testing.assert_array_equal(np.isnan(ours), [[True, False, False, True]])


def test_approximate_functions_are_instructions_of_gpus_and_no_others():
    def function(x):
        return jnp.exp(x) / jnp.log(x)

    def called(program, **options):
        w = LlvmWriter("kernel", "float x")
        run_program(w, program, w.parameters, **options)
        return [
            line.split('asm "')[1].split()[0] for line in w.text().splitlines() if "asm" in line
        ]

    program = scalarize(function, jnp.zeros(()), approximate=True)
    names = [f"{name}.approx.ftz.f32" for name in ("ex2", "lg2", "rcp")]
    assert sorted(called(program, for_gpu=True)) == names
    with pytest.raises(UnsupportedError, match="an approximate exp on a CPU"):
        called(program)
    with pytest.raises(UnsupportedError, match="an approximate exp on a CPU"):
        require(program)
    # With polynomials, the same function needs none of them.
    assert called(scalarize(function, jnp.zeros(())), for_gpu=True) == []


def test_subnormal_numbers_are_zeros_on_every_thread():
    # As in XLA's own threads, or a result would depend on who made it.
    x = np.full((8 * LANES * xla_call._BLOCKS_PER_THREAD, 4), 1e-39, np.float32)
    out = np.full_like(x, np.nan)
    handler = compiled(scalarize(lambda x: x * 3.0, VECTOR))
    call_frame.call(handler, [x], [out], Pool(threads=3))
    np.testing.assert_array_equal(out, 0)
    # The caller's own arithmetic is what it was.
    assert np.float32(1e-39) * np.float32(3) > 0


def test_results_become_arguments_and_what_is_held_stays():
    def step(x, held):
        return jnp.roll(x, 1) + held

    x = np.float32(np.random.default_rng(0).normal(size=(5, 4)))
    held = np.float32([[0.5], [1], [2], [3], [4]])
    program = scalarize(step, VECTOR, jax.ShapeDtypeStruct((1,), jnp.float32))
    (ours,) = run(program, [x, held], steps=6)
    np.testing.assert_allclose(ours, np.roll(x, 6, 1) + 6 * held, rtol=1e-5)


@pytest.fixture(scope="module")
def plus_one():
    shapes = VECTOR, jax.ShapeDtypeStruct((), jnp.float32)
    return compiled(scalarize(lambda x, n: (x + n, n + 1), *shapes), carried=2, steps=2)


@pytest.mark.parametrize("robots", [0, 1, LANES - 1, LANES, LANES + 1, 1000])
@pytest.mark.parametrize("threads", [1, 3])
def test_every_robot_is_stepped_once_and_nothing_beside_them_is_touched(plus_one, robots, threads):
    x = np.arange(4 * robots, dtype=np.float32).reshape(robots, 4)
    n = np.arange(robots, dtype=np.float32)
    around = [np.full(4 * robots + 64, 7, np.float32), np.full(robots + 64, 7, np.float32)]
    outputs = [around[0][32:-32].reshape(robots, 4), around[1][32:-32]]
    call_frame.call(plus_one, [x, n], outputs, Pool(threads))
    np.testing.assert_array_equal(outputs[0], x + 2 * n[:, None] + 1)
    np.testing.assert_array_equal(outputs[1], n + 2)
    for array in around:
        np.testing.assert_array_equal([array[:32], array[-32:]], 7)


def test_robots_beyond_the_end_are_not_read(plus_one):
    # A page that may not be touched follows the last robot.
    page = 4096
    libc = ctypes.CDLL(None)
    libc.mmap.restype = ctypes.c_void_p
    libc.mmap.argtypes = [ctypes.c_void_p, *[ctypes.c_size_t] * 5]
    libc.mprotect.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
    start = libc.mmap(None, 2 * page, 3, 0x22, -1 % 2**64, 0)
    assert libc.mprotect(start + page, page, 0) == 0
    robots = LANES + 1
    numbers = (ctypes.c_float * (4 * robots)).from_address(start + page - 16 * robots)
    x = np.frombuffer(numbers, np.float32).reshape(robots, 4)
    x[:] = 3
    n = np.zeros(robots, np.float32)
    outputs = [np.zeros_like(x), np.zeros_like(n)]
    call_frame.call(plus_one, [x, n], outputs)
    np.testing.assert_array_equal(outputs[0], 4)
    call_frame.call(plus_one, [outputs[0], n], [x, outputs[1]])
    np.testing.assert_array_equal(x, 5)


def many(blocks):
    robots = blocks * LANES - 1
    return np.ones((robots, 4), np.float32), np.zeros(robots, np.float32)


@pytest.mark.parametrize("pool", [{"refuses": True}, {"waits": True}, {}])
def test_threads_help_and_nobody_waits_for_one_that_does_not_come(plus_one, pool):
    arguments = many(4 * xla_call._BLOCKS_PER_THREAD)
    outputs = [np.zeros_like(x) for x in arguments]
    pool = Pool(threads=3, **pool)
    assert call_frame.call(plus_one, arguments, outputs, pool) is None
    assert len(pool.scheduled) == 2
    assert pool.destroyed == ([0xBAD] * 2 if pool.refuses else [])
    np.testing.assert_array_equal(outputs[0], 2)


def test_the_call_is_over_when_all_robots_are_done():
    steps = 50_000  # a block takes so long that the last ones end one after the other
    handler = compiled(scalarize(lambda x: x + 1, VECTOR), steps=steps)
    x, _ = many(2 * xla_call._BLOCKS_PER_THREAD + 1)
    pool = Pool(threads=2)
    for _ in range(20):
        call_frame.call(handler, [x], [np.zeros_like(x)], pool)
        np.testing.assert_array_equal(pool.left[0], 1 + steps)


def test_few_robots_wake_no_thread(plus_one):
    arguments = many(2 * xla_call._BLOCKS_PER_THREAD - 1)
    pool = Pool(threads=8)
    call_frame.call(plus_one, arguments, [np.zeros_like(x) for x in arguments], pool)
    assert pool.scheduled == []


def test_it_says_for_which_interface_it_was_written(plus_one):
    assert call_frame.ask_metadata(plus_one) == xla_call.VERSION


def grown(part):
    def change(frame):
        part(frame).struct_size += 8

    return change


@pytest.mark.parametrize(
    "change",
    [
        grown(lambda frame: frame),
        grown(lambda frame: frame.arguments),
        grown(lambda frame: frame.results),
        grown(lambda frame: frame.arguments.buffers[0].contents),
        lambda frame: setattr(frame.api.contents.version, "major", 1),
    ],
)
def test_of_another_interface_nothing_is_touched(plus_one, change):
    outputs = [np.full((5, 4), 7, np.float32), np.full(5, 7, np.float32)]
    arguments = np.ones((5, 4), np.float32), np.ones(5, np.float32)
    assert call_frame.call(plus_one, arguments, outputs, change=change) is None
    np.testing.assert_array_equal(outputs[0], 7)
    np.testing.assert_array_equal(outputs[1], 7)


def test_what_is_not_written_for_a_cpu_is_named():
    program = scalarize(lambda i: i + 1, jax.ShapeDtypeStruct((1,), jnp.int32))
    with pytest.raises(UnsupportedError, match="not float32"):
        text_of(program)


@pytest.mark.parametrize("triple", ["x86_64-linux-gnu", "aarch64-linux-gnu", "arm64-apple-macosx"])
def test_the_text_is_good_for_every_machine(triple, monkeypatch):
    import llvmlite.binding as binding

    binding.initialize_all_targets()
    binding.initialize_all_asmprinters()
    machine = "x86_64" if triple.startswith("x86") else "aarch64"
    host = cpu.host_processor()._replace(machine=machine, lanes=4)
    monkeypatch.setattr(cpu, "host_processor", lambda: host)
    text = text_of(scalarize(FUNCTIONS["a loop of conditions"], VECTOR))
    module = binding.parse_assembly(text)
    module.triple = triple
    assert binding.Target.from_triple(triple).create_target_machine().emit_object(module)


EXACT = {
    "exp": (jnp.exp, np.exp),
    "expm1": (jnp.expm1, np.expm1),
    "log": (jnp.log, np.log),
    "log1p": (jnp.log1p, np.log1p),
    "logistic": (jax.nn.sigmoid, lambda x: 1 / (1 + np.exp(-x))),
    "tanh": (jnp.tanh, np.tanh),
}


@pytest.mark.parametrize("name", EXACT)
def test_functions_are_those_of_float64(name):
    function, exact = EXACT[name]
    rng = np.random.default_rng(0)
    small = np.geomspace(1.2e-38, 1e3, 20_000)
    special = [0, -0.0, np.inf, -np.inf, np.nan, 88.7228, 88.73, -87.3, 3e38, 1.2e-38]
    x = np.concatenate([rng.uniform(-100, 100, 20_000), small, -small, special]).astype(np.float32)
    program = scalarize(function, jax.ShapeDtypeStruct((), np.float32))
    (ours,) = run(program, [x])
    with np.errstate(all="ignore"):
        expected = exact(x.astype(np.float64))
        rounded = expected.astype(np.float32)
    # Subnormal numbers are flushed to zero.
    normal = np.isfinite(rounded) & (np.abs(expected) > np.finfo(np.float32).tiny)
    units = np.abs(ours[normal] - expected[normal]) / np.spacing(np.abs(rounded[normal]))
    assert units.max() < 3.0
    flushed = np.where(np.isfinite(rounded) & ~normal, 0.0, rounded)[~normal]
    np.testing.assert_array_equal(np.where(np.isfinite(ours[~normal]), 0.0, ours[~normal]), flushed)


def in_units(ours, exact):
    """How far numbers are off, in units of the last place, where they are not too small."""
    with np.errstate(all="ignore"):
        rounded = exact.astype(np.float32)
    normal = np.isfinite(rounded) & (np.abs(exact) > np.finfo(np.float32).tiny)
    return np.abs(ours[normal] - exact[normal]) / np.spacing(np.abs(rounded[normal]))


@pytest.mark.parametrize("name", ["sin", "cos", "tan"])
def test_an_angle_has_the_right_sine_or_none(name, lanes):
    rng = np.random.default_rng(0)
    ends = [2.0**50, np.nextafter(np.float32(2**50), 0), 3.4e38, np.inf, np.nan]
    x = np.float32([*2.0 ** rng.uniform(-3, 50, 20_000), *2.0 ** rng.uniform(50, 128, 999), *ends])
    x *= rng.choice([-1, 1], len(x))
    number = jax.ShapeDtypeStruct((), np.float32)
    (ours,) = run(scalarize(getattr(jnp, name), number, finite=False), [x])
    is_far = ~(np.abs(x) < 2.0**50)
    assert np.isnan(ours[is_far]).all()
    exact = getattr(np, name)(x[~is_far].astype(np.float64))
    assert in_units(ours[~is_far], exact).max() <= 4


def directions():
    """Vectors of all sizes and directions, and next to the axes and the diagonals."""
    rng = np.random.default_rng(0)
    angles = np.linspace(-np.pi, np.pi, 20_001)
    sizes = 10 ** rng.uniform(-37, 38, (2, 20_000))
    ratios = 10 ** rng.uniform(-6, 6, 20_000)
    near = 1 + np.arange(-500, 500) * 2.0**-23
    one = np.concatenate([np.sin(angles), sizes[0], ratios, np.ones(1000)])
    other = np.concatenate([np.cos(angles), sizes[1], 1 / ratios, near])
    signs = rng.choice([-1, 1], (2, len(one)))
    return np.float32(signs * [one, other])


def test_the_angle_of_a_vector_is_that_of_float64(lanes):
    program = scalarize(jnp.arctan2, *[jax.ShapeDtypeStruct((), np.float32)] * 2)
    y, x = directions()
    (ours,) = run(program, [y, x])
    exact = np.arctan2(np.float64(y), np.float64(x))
    assert in_units(ours, exact).max() <= 4
    too_small = np.abs(exact) < np.finfo(np.float32).tiny
    assert too_small.any()
    np.testing.assert_array_less(np.abs(ours[too_small]), 2 * np.finfo(np.float32).tiny)
    np.testing.assert_array_equal(np.signbit(ours), np.signbit(exact))


def test_the_angles_between_zeros_and_infinities_are_those_of_numpy(lanes):
    program = scalarize(jnp.arctan2, *[jax.ShapeDtypeStruct((), np.float32)] * 2)
    ends = np.float32([0.0, -0.0, 1, -1, 1.2e-38, 3e38, -3e38, np.inf, -np.inf, np.nan])
    y, x = (part.ravel() for part in np.meshgrid(ends, ends))
    (ours,) = run(program, [y, x])
    exact = np.arctan2(np.float64(y), np.float64(x))
    number = ~np.isnan(exact)
    np.testing.assert_array_equal(np.isnan(ours), ~number)
    np.testing.assert_array_equal(np.signbit(ours[number]), np.signbit(exact[number]))
    np.testing.assert_allclose(ours[number], exact[number], rtol=2e-7, atol=2e-38)


def test_the_inverse_of_the_error_function_is_that_of_float64(lanes):
    rng = np.random.default_rng(0)
    near_one = 1 - np.arange(1, 20_000) * 2.0**-24
    small = np.geomspace(1.2e-38, 0.5, 20_000)
    inside = np.concatenate([rng.uniform(-1, 1, 20_000), near_one, -near_one, small, -small])
    x = np.float32([*inside, 1, -1, 0.0, -0.0, 1.5, np.inf, -np.inf, np.nan])
    (ours,) = run(scalarize(jax.lax.erf_inv, jax.ShapeDtypeStruct((), np.float32)), [x])
    assert in_units(ours[:-8], special.erfinv(np.float64(x[:-8]))).max() <= 8
    np.testing.assert_array_equal(ours[-8:-4], np.float32([np.inf, -np.inf, 0, 0]))
    np.testing.assert_array_equal(np.signbit(ours[-6:-4]), [False, True])
    assert np.isnan(ours[-4:]).all()


def test_half_a_number_is_rounded_to_the_even_one(lanes):
    halves = np.arange(-1000, 1000) / 4
    large = [4194304.5, 4194305.5, 8388607.5, 2**23 + 1, 2**24 + 2, -8388607.5, 3e38]
    x = np.float32([*halves, *large, -0.0, -0.3, np.inf, -np.inf, np.nan])
    (ours,) = run(scalarize(jnp.round, jax.ShapeDtypeStruct((), np.float32)), [x])
    np.testing.assert_array_equal(ours, np.round(x))
    np.testing.assert_array_equal(np.signbit(ours), np.signbit(np.round(x)))


def of_words(function, *arrays):
    """What a kernel makes of numbers of 32 bits, one of each array for a robot."""

    def as_floats(*words):
        result = function(*(x.view(y.dtype) for x, y in zip(words, arrays, strict=True)))
        return [(result.astype(jnp.uint32) if result.dtype == bool else result).view(jnp.float32)]

    program = scalarize(as_floats, *[jax.ShapeDtypeStruct((), np.float32)] * len(arrays))
    (ours,) = run(program, [x.view(np.float32) for x in arrays])
    return ours.view(np.uint32)


def check_words(function, *arrays):
    theirs = np.asarray(jax.vmap(function)(*arrays))
    theirs = theirs.astype(np.uint32) if theirs.dtype == bool else theirs.view(np.uint32)
    np.testing.assert_array_equal(of_words(function, *arrays), theirs)


WORDS = np.uint32([0, 1, 7, 2**24 + 1, 2**31 - 1, 2**31, 2**31 + 129, 2**32 - 129, 2**32 - 1])
PAIRS = [x.ravel() for x in np.meshgrid(WORDS, WORDS)]
LARGE = {np.uint32: np.uint32(2**31 + 7), np.int32: np.int32(-7)}
WORD_FUNCTIONS = {
    "sums": lambda a, b, large: a + b - large,
    "differences": lambda a, b, large: large - (a - b),
    "products": lambda a, b, large: (a + 3) * b * large,
    "negatives": lambda a, b, large: -a,
    "extremes": lambda a, b, large: jnp.maximum(a, b) ^ jnp.minimum(a, b),
    "extremes of a constant": lambda a, b, large: jnp.maximum(a, large) ^ jnp.minimum(b, large),
    "bits": lambda a, b, large: (a & b) + (a | large) * (a ^ b),
    "less": lambda a, b, large: (a < b) * 1 + (a <= b) * 2 + (a < large) * 4 + (large <= b) * 8,
    "more": lambda a, b, large: (a > b) * 1 + (a >= b) * 2 + (a > large) * 4 + (large >= b) * 8,
    "equal": lambda a, b, large: (a == b) * 1 + (a != b) * 2 + (a == large) * 4,
    "choices": lambda a, b, large: jnp.where(a > b, a, b - large),
    "quotients": lambda a, b, large: (a // 7) ^ (b % 1000) ^ jax.lax.div(a, a.dtype.type(3)),
    "remainders": lambda a, b, large: jax.lax.rem(a, a.dtype.type(2**31 - 1)),
    "shifts": lambda a, b, large: (
        (a << 0) ^ (a << 31) ^ jax.lax.shift_right_logical(b, a.dtype.type(13))
    ),
    "truths": lambda a, b, large: a.astype(bool) ^ (b > large),
    "a loop": lambda a, b, large: jax.lax.while_loop(
        lambda state: (state[0] > 5) & (state[1] < 40),
        lambda state: (state[0] - state[0] // 4, state[1] + 1),
        (a, 0),
    )[0],
}


@pytest.mark.parametrize("dtype", LARGE)
@pytest.mark.parametrize("name", WORD_FUNCTIONS)
def test_whole_numbers_with_and_without_a_sign_are_those_of_jax(name, dtype, lanes):
    def function(a, b):
        return WORD_FUNCTIONS[name](a, b, LARGE[dtype])

    check_words(function, *(x.view(dtype) for x in PAIRS))


@pytest.mark.parametrize("by", [2**31, 2**32 - 1])
def test_words_are_divided_by_what_has_the_highest_bit(by, lanes):
    check_words(lambda x: x // jnp.uint32(by), WORDS)
    check_words(lambda x: x % jnp.uint32(by), WORDS)


@pytest.mark.parametrize("to", [np.float32, np.int32, np.uint32, bool])
@pytest.mark.parametrize("source", [np.float32, np.int32, np.uint32])
def test_conversions_are_those_of_jax(source, to, lanes):
    numbers = WORDS.view(source)
    if source == np.float32:
        ends = [0.7, -0.7, -0.0, 2**31, -(2**31), 2**32 - 256, 2**32, 1e20, -1e20]
        numbers = np.float32([*range(-3, 4), *ends, np.inf, -np.inf, np.nan])
    check_words(lambda x: x.astype(to), numbers)
