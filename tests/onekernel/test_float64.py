"""Kernels of numbers of 64 bits: how exact their functions are, and what becomes of odd numbers."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy import special

from onekernel import UnsupportedError, cpu, default_backend, fuse
from onekernel.kernel import Kernel

pytestmark = pytest.mark.skipif(default_backend() is None, reason="no back end for kernels")

COUNT = 8000
DTYPES = ("float32", "int32", "uint32", "bool", "float64", "int64", "uint64")
precise = pytest.mark.skipif(
    np.finfo(np.longdouble).nmant < 60, reason="NumPy has no numbers of more digits here"
)


@pytest.fixture(autouse=True)
def wide():
    with jax.enable_x64(True):
        yield


def run(function, *arguments):
    """Return the results of a kernel of a function of one instance, in NumPy's arrays."""
    results = jax.jit(jax.vmap(fuse(function, on_unsupported="raise")))(*arguments)
    return jax.tree.map(np.asarray, results)


def same(function, *arguments):
    """Check that a kernel's results are those of XLA, to the last bit."""
    ours, theirs = run(function, *arguments), jax.jit(jax.vmap(function))(*arguments)
    for one, other in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)


def floats():
    """Numbers of all sizes, with those at which functions change."""
    rng = np.random.default_rng(0)
    sign = rng.choice([-1.0, 1.0], COUNT)
    return np.concatenate(
        [
            *(rng.uniform(-size, size, COUNT) for size in (1.0, 6.0, 30.0, 800.0)),
            sign * 10.0 ** rng.uniform(-300, 300, COUNT),
            np.nextafter(sign * rng.choice([0.5, 0.6, 0.8, 1.0, 80.0, 2.0**20], COUNT), sign * 9),
        ]
    )


def angles():
    """Angles of all sizes, many of them next to a multiple of a quarter turn."""
    rng = np.random.default_rng(0)
    turns = rng.integers(0, 2**40, 4 * COUNT) >> rng.integers(0, 40, 4 * COUNT)
    # The last one is closer to such a multiple than any other float64 (W. Kahan).
    nearest = [6381956970095103 * 2.0**797]
    return np.concatenate(
        [floats(), turns * (np.pi / 2), 10.0 ** rng.uniform(5, 308, COUNT), nearest]
    )


def ulps(ours, exact):
    """Return errors in units in the last place, where the result is a normal number."""
    with np.errstate(over="ignore", invalid="ignore"):
        rounded = exact.astype(np.float64)
        known = np.isfinite(rounded) & (np.abs(rounded) > 1e-300)
        np.testing.assert_array_equal(np.isnan(ours), np.isnan(rounded))
        infinite = np.isinf(rounded)
        np.testing.assert_array_equal(ours[infinite], rounded[infinite])
        return np.abs((ours - exact) / np.spacing(np.abs(rounded)))[known]


UNARY = {
    "arccos": 4,
    "arccosh": 4,
    "arcsin": 4,
    "arcsinh": 4,
    "arctan": 3,
    "arctanh": 4,
    "cbrt": 2,
    "cosh": 4,
    "exp": 1,
    "exp2": 1,
    "expm1": 2,
    "log": 2.5,
    "log10": 4,
    "log1p": 4,
    "log2": 4,
    "sinh": 4,
    "tanh": 2,
}
"""The largest error of each function in units in the last place."""

ANGLES = {"sin": 3, "cos": 3, "tan": 4.5}


@precise
@pytest.mark.parametrize(
    ("errors", "numbers"), [(UNARY, floats), (ANGLES, angles)], ids=["numbers", "angles"]
)
def test_functions_are_exact_to_some_units_in_the_last_place(errors, numbers):
    x = numbers()
    ours = run(lambda x: {name: getattr(jnp, name)(x) for name in errors}, x)
    with np.errstate(all="ignore"):
        exact = {name: getattr(np, name)(x.astype(np.longdouble)) for name in errors}
    found = {name: ulps(ours[name], exact[name]).max() for name in errors}
    assert {name: error for name, error in found.items() if error > errors[name]} == {}


@precise
def test_functions_of_two_numbers_are_exact_to_some_units_in_the_last_place():
    rng = np.random.default_rng(0)
    x, y = floats(), rng.permutation(floats())
    size, power = np.abs(x), np.where(rng.random(x.shape) < 0.5, y, 700 / np.log(np.abs(x) + 1.5))
    ours = run(lambda *z: (jnp.arctan2(*z[:2]), jnp.power(*z[2:])), x, y, size, power)
    with np.errstate(all="ignore"):
        wide = [z.astype(np.longdouble) for z in (x, y, size, power)]
        exact = np.arctan2(*wide[:2]), np.power(*wide[2:])
    assert ulps(ours[0], exact[0]).max() < 3
    assert ulps(ours[1], exact[1]).max() < 3


@precise
def test_quotients_of_exponentials_are_exact_to_some_units_in_the_last_place():
    x = floats()
    ours = run(lambda x: (jax.nn.sigmoid(x), jax.lax.rsqrt(x)), x)
    with np.errstate(all="ignore"):
        wide = x.astype(np.longdouble)
        exact = 1 / (1 + np.exp(-wide)), 1 / np.sqrt(wide)
    for one, other in zip(ours, exact, strict=True):
        assert ulps(one, other).max() < 3


def test_error_functions_are_inverse_to_each_other():
    x = np.linspace(-0.999, 0.999, 4001)
    np.testing.assert_allclose(
        run(lambda x: special.erf(special.erfinv(x)), x), x, rtol=1e-15, atol=0
    )
    y = 10.0 ** np.linspace(-300, -1, 4001)
    back = run(lambda y: jnp.log(special.erfc(jnp.sqrt(y))), -np.log(y) / 2)
    assert np.isfinite(back).all()


def test_error_functions_are_those_of_scipy():
    from scipy import special as reference

    x = np.concatenate([np.linspace(-6, 6, 4001), np.linspace(6, 26.5, 999)])
    ours = run(lambda x: (special.erf(x), special.erfc(x)), x)
    np.testing.assert_allclose(ours[0], reference.erf(x), rtol=1e-15, atol=0)
    # SciPy's own error grows with x.
    np.testing.assert_allclose(ours[1], reference.erfc(x), rtol=1e-13, atol=0)
    y = np.concatenate([np.linspace(-1, 1, 4001), 1 - 2.0 ** -np.arange(1, 54)])
    np.testing.assert_allclose(run(special.erfinv, y), reference.erfinv(y), rtol=3e-15, atol=0)


def odd(dtype):
    """Numbers of a dtype at the ends of what it and others hold, and beyond."""
    kind = np.dtype(dtype).kind
    if kind == "b":
        return np.array([True, False])
    if kind == "f":
        ends = [
            sign * (2.0**n + d)
            for n in (0, 31, 32, 53, 63, 64)
            for sign in (1, -1)
            for d in (0, 0.5)
        ]
        ends += [0.0, -0.0, np.inf, -np.inf, np.nan, 1e30, -1e30, 2.0**24 + 1, 1e-30, 0.1]
        return np.array([*ends, *((1e300, -1e300) if dtype == "float64" else ())], dtype)
    info = np.iinfo(dtype)
    powers = [2**n + d for n in (0, 8, 24, 31, 32, 53, 62, 63) for d in (-1, 0, 1)]
    wanted = {info.min, info.max, info.min + 1, *powers, *(-x for x in powers)}
    return np.array([x for x in sorted(wanted) if info.min <= x <= info.max], dtype)


@pytest.mark.parametrize("source", DTYPES)
def test_conversions_are_those_of_jax(source):
    same(lambda x: [x.astype(to) for to in DTYPES], odd(source))


def test_known_numbers_are_converted_alike():
    def known(x):
        return [
            jnp.asarray(odd(source)).astype(to) for source, to in itertools.product(DTYPES, DTYPES)
        ]

    same(known, np.zeros(1))


@pytest.mark.parametrize(
    ("source", "to"), [("float64", "uint32"), ("int64", "float32"), ("uint64", "int64")]
)
def test_bits_are_those_of_other_numbers(source, to):
    def there_and_back(x):
        bits = jax.lax.bitcast_convert_type(x, to)
        return bits, jax.lax.bitcast_convert_type(bits, source)

    same(there_and_back, odd(source))


WHOLE = {
    "quotient": lambda x, y: (jax.lax.div(x, y), x // y, x // 7),
    "rest": lambda x, y: (jax.lax.rem(x, y), x % y, x % 7),
    "shifted": lambda x, y: (x << y, jax.lax.shift_right_logical(x, y), x >> y, x << 63, x >> 64),
    "bits": lambda x, y: (x & y, x | y, x ^ y, ~x, jax.lax.population_count(x), jax.lax.clz(x)),
    "arithmetic": lambda x, y: (x + y, x - y, x * y, -x, jnp.abs(x), jnp.sign(x), x**3),
    "order": lambda x, y: (x < y, x <= y, x == y, jnp.maximum(x, y), jnp.minimum(x, y)),
    "reduced": lambda x, y: (jnp.stack([x, y, x]).sum(), jnp.stack([y, x]).max(), jnp.argmin(y)),
    "sorted": lambda x, y: jnp.sort(jnp.stack([x, y, y - x])),
}


@pytest.mark.parametrize("dtype", ["int64", "uint64"])
@pytest.mark.parametrize("name", WHOLE)
def test_whole_numbers_are_those_of_jax(name, dtype):
    ends = odd(dtype)
    shifts = np.array([0, 1, 31, 32, 33, 63, 64, 65, 200], dtype)
    x, y = (z.ravel() for z in np.meshgrid(ends, [*ends, *shifts]))
    same(WHOLE[name], x.astype(dtype), y.astype(dtype))


def test_known_whole_numbers_are_those_of_jax():
    x, y = (z.ravel() for z in np.meshgrid(odd("int64")[::4], [0, -1, 7, 64, -(2**63)]))
    functions = [function for name, function in WHOLE.items() if name not in ("reduced", "sorted")]

    def together(x, y):
        return [function(x, y) for function in functions]

    # XLA itself cannot divide the lowest number by -1 while it compiles.
    theirs = jax.jit(together)(x, y)
    ours = run(lambda _: together(jnp.asarray(x), jnp.asarray(y)), np.zeros(1))
    for one, other in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_array_equal(one[0], other)


@pytest.mark.parametrize(("dtype", "large"), [(np.float32, 3e38), (np.float64, 1.7e308)])
def test_a_division_by_one_of_the_largest_numbers_is_one(dtype, large):
    x = np.array([large, -large, large / 2], dtype)
    np.testing.assert_array_equal(run(lambda x: x / dtype(large), x), [1, -1, 0.5])


def test_remainders_are_exact():
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-1e6, 1e6, (2, 3000)) * 10.0 ** rng.integers(-5, 1, (2, 3000))
    same(jnp.fmod, x, y)


def mixed(x, n, word, flag, y):
    """A float32, an int64, a uint64, a bool and a float64, with numbers of Python."""
    total, counts = jax.lax.fori_loop(
        0, n, lambda i, c: (c[0] * 0.5 + i, c[1] + jnp.where(flag, i, 1)), (x, n * 0)
    )
    return {
        "weak": (x * 2.5 + 1, n * 2, y * 0.1 + n, jnp.where(flag, x, 0.5)),
        "loop": (total, counts),
        "promoted": (x + y, n + y, x * word, word + jnp.uint64(2**63)),
        "narrow": (y.astype(jnp.float32), n.astype(jnp.int32), word.astype(jnp.uint32)),
        "numbers": (1.5, 7, True),
    }


def test_programs_of_several_dtypes_have_the_dtypes_of_jax():
    rng = np.random.default_rng(0)
    arguments = (
        rng.integers(-64, 64, 50).astype(np.float32) / 8,
        rng.integers(0, 9, 50),
        rng.integers(0, 2**63, 50, np.uint64),
        rng.random(50) < 0.5,
        rng.integers(-64, 64, 50) / 8,
    )
    same(mixed, *arguments)


def tables(x, i):
    """Numbers read and written at computed indices, in registers and in memory."""
    table = jnp.arange(300) ** 2 * 0.25
    words = jnp.array([0.25, 0.0, 1e300, np.nan])
    _, rows = jax.lax.scan(lambda c, v: (c + v, (c * v, c > v, v.astype(int))), x[0], x[:70])
    places = jnp.arange(400)[i * 30] * 2**40
    return (
        table[i * 30],
        places,
        words[i % 4],
        x[i],
        x.at[i].add(1.0),
        x[i * 9 % 70],
        rows,
        jnp.roll(x, i),
    )


def test_arrays_in_memory_hold_numbers_of_64_bits():
    x = np.random.default_rng(0).integers(-64, 64, (20, 70)) / 8
    same(tables, x, np.arange(20) % 9)


def test_a_table_of_64_bits_may_have_the_bytes_of_one_of_32():
    long = np.arange(300) * 3
    short = long.view(np.int32)
    same(lambda i: (jnp.asarray(long)[i], jnp.asarray(short)[i]), np.arange(0, 290, 7))


def test_random_numbers_are_those_of_jax():
    def draw(key, n):
        draws = (
            jax.random.uniform(key, (3,)),
            jax.random.bits(key, (2,)),
            jax.random.randint(key, (2,), 0, n),
        )
        return *draws, jax.random.key_data(jax.random.fold_in(jax.random.key(n), n))

    same(draw, jax.random.split(jax.random.key(3), 40), np.arange(40) * 2**35 + 5)
    ours = run(jax.random.normal, jax.random.split(jax.random.key(3), 400))
    theirs = jax.vmap(jax.random.normal)(jax.random.split(jax.random.key(3), 400))
    assert ours.dtype == np.float64
    np.testing.assert_allclose(ours, theirs, rtol=1e-14, atol=0)


def orbit(state, length=40):
    """A chaotic map, whose last bit decides after some steps."""

    def step(s, _):
        return jnp.sin(3 * s) + jnp.exp(-s * s) * jnp.roll(s, 1) + s**0.5, s.sum()

    return jax.lax.scan(step, state, None, length=length)


@pytest.mark.parametrize("count", [1, 7, 1000])
def test_bits_do_not_depend_on_the_number_of_instances(count):
    states = np.random.default_rng(0).uniform(0, 1, (1000, 3))
    function = functools.partial(orbit, length=70)
    for one, other in zip(run(function, states[:count]), run(function, states), strict=True):
        np.testing.assert_array_equal(one, other[:count])


def test_batches_have_any_axes():
    x = np.random.default_rng(0).normal(size=(4, 3, 5))
    fused = jax.vmap(
        jax.vmap(fuse(lambda x: x * 2 + 1, on_unsupported="raise"), in_axes=1), in_axes=2
    )
    np.testing.assert_array_equal(fused(x), (x * 2 + 1).transpose(2, 1, 0))


def test_a_kernel_of_one_setting_is_not_that_of_another():
    function = fuse(lambda x: x * 0.1 + 1, on_unsupported="raise")
    assert function(np.float64(3)).dtype == np.float64
    with jax.enable_x64(False):
        assert function(np.float64(3)).dtype == np.float32
    assert function(np.float32(3)).dtype == np.float32


@pytest.mark.skipif(cpu.obstacle() is not None, reason="llvmlite compiles nothing here")
def test_without_the_setting_no_number_has_64_bits():
    with jax.enable_x64(False):
        kernel = fuse(lambda x: jnp.sin(x) ** 1.3 * 2, on_unsupported="raise").lowered(1.0).one
        assert isinstance(kernel, Kernel)
        assert all(x.dtype.itemsize <= 4 for x in kernel.program.block.values())


def test_what_has_no_numbers_of_its_dtype_is_named():
    with pytest.raises(UnsupportedError, match="arguments or results of complex128"):
        fuse(lambda x: x * 1j, on_unsupported="raise")(1.5)
    with pytest.raises(UnsupportedError, match="float16"):
        fuse(lambda x: x * 2, on_unsupported="raise")(np.float16(1.5))
