"""Operations of JAX in kernels compute what JAX computes, for ordinary numbers and odd ones."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy import linalg, special

from onekernel import UnsupportedError, default_backend, fuse
from onekernel.build import scalarize

pytestmark = pytest.mark.skipif(default_backend() is None, reason="no back end for kernels")

COUNT = 48
ODD = [0.0, -0.0, 1.0, -1.0, 0.5, -2.5, 1e-3, 88.0, -88.0, 1e10, -1e30, np.inf, -np.inf, np.nan]


@pytest.fixture(params=[32, 64])
def bits(request):
    """Of how many bits numbers are; those of 64 need JAX's setting."""
    with jax.enable_x64(request.param == 64):
        yield request.param


def widened(arrays, bits):
    """Return arrays of numbers of so many bits."""
    return [x.astype(f"{x.dtype.kind}{bits // 8}") for x in arrays]


def unsigned(x):
    """Return the bits of whole numbers as numbers without a sign."""
    return x.view(f"u{x.dtype.itemsize}")


def floats(*shape, seed=0, odd=False):
    x = np.random.default_rng(seed).normal(size=(COUNT, *shape)).astype(np.float32)
    if odd:
        x.reshape(COUNT, -1)[: len(ODD), 0] = ODD
    return x


def wholes(*shape, low=-3, high=9, seed=0):
    numbers = np.random.default_rng(seed).integers(low, high, size=(COUNT, *shape))
    return numbers.astype(np.int32)


def conditioned(size):
    return floats(size, size, seed=4) + 4 * np.eye(size, dtype=np.float32)


def named(*names):
    """Return functions of `jax.numpy`."""
    return {name: getattr(jnp, name) for name in names}


# Functions of the same arguments are one kernel, so that few are compiled.

UNARY = {
    **named(
        "abs",
        "arccos",
        "arccosh",
        "arcsin",
        "arcsinh",
        "arctan",
        "arctanh",
        "cbrt",
        "ceil",
        "cosh",
        "exp",
        "exp2",
        "expm1",
        "floor",
        "isfinite",
        "isinf",
        "isnan",
        "log",
        "log10",
        "log1p",
        "log2",
        "nan_to_num",
        "reciprocal",
        "rint",
        "sign",
        "signbit",
        "sinh",
        "sqrt",
        "square",
        "tanh",
        "trunc",
    ),
    "erf": special.erf,
    "erfc": special.erfc,
    "log_ndtr": lambda x: special.log_ndtr(jnp.maximum(x, -4.0)),
    "away from zero": lambda x: jax.lax.round(x, jax.lax.RoundingMethod.AWAY_FROM_ZERO),
    "fewer bits": lambda x: jax.lax.reduce_precision(x, jnp.finfo(x.dtype).nexp, 7),
    "frexp": lambda x: jnp.frexp(jnp.where(jnp.isfinite(x), x, 3.0)),
    "silu": jax.nn.silu,
    "softplus": jax.nn.softplus,
}

ANGLES = named("sin", "cos", "tan")

BINARY = {
    **named("arctan2", "copysign", "hypot", "logaddexp2", "maximum", "minimum", "nextafter"),
    "power": jnp.power,
    "quotient and rest": lambda x, y: jnp.divmod(jnp.clip(x, -1e6, 1e6), y),
    "rest": lambda x, y: jnp.fmod(jnp.clip(x, -1e6, 1e6), y),
}

WHOLE = {
    "quotient": jax.lax.div,
    "rest": jax.lax.rem,
    "floor": jnp.floor_divide,
    "modulo": jnp.mod,
    "by a negative": lambda x, y: x // -3,
    "ones": lambda x, y: jax.lax.population_count(x),
    "zeros": lambda x, y: jax.lax.clz(x),
    "left": lambda x, y: jax.lax.shift_left(x, y),
    "right": lambda x, y: jax.lax.shift_right_logical(x, y),
    "with sign": lambda x, y: jax.lax.shift_right_arithmetic(x, x.dtype.type(3)),
    "of words": lambda x, y: unsigned(x) // unsigned(jnp.maximum(y, 0)),
}

ROWS = {
    **named(
        "all",
        "any",
        "argmax",
        "argmin",
        "cumsum",
        "max",
        "mean",
        "median",
        "min",
        "sort",
        "argsort",
    ),
    "product": lambda x: jnp.prod(jnp.clip(x, -2, 2)),
    "products": lambda x: jnp.cumprod(jnp.clip(x, -2, 2)),
    "largest so far": jax.lax.cummax,
    "smallest from the end": lambda x: jax.lax.cummin(x, reverse=True),
    "two largest": lambda x: jax.lax.top_k(x, 2),
    "a quantile": lambda x: jnp.percentile(x, 30),
    "in order": lambda x: jnp.lexsort((x, jnp.round(x))),
    "different": lambda x: jnp.unique(jnp.round(x), size=4),
    "the first": lambda x: jnp.argmax(x > 0.5),
    "moved": lambda x: jax.lax.pad(x, 0.0, [(-1, 2, 1)]),
    "a polynomial": lambda x: (jnp.polyval(x[:3], x[3]), jnp.polyval(jnp.ones(12), x[1:] / 4)),
    "sums of pairs": lambda x: jax.lax.associative_scan(jnp.add, x),
}

if jax.default_backend() == "cpu":
    # By cuDNN, a NaN reaches more of a row than the numbers that it is added to.
    ROWS["filtered"] = lambda x: jnp.convolve(x, x[:3])

WHOLE_ROWS = {
    **named("max", "min", "argmax", "argmin", "sort", "cumsum", "prod"),
    "largest of words": lambda x: jnp.max(unsigned(x)),
    "smallest of words": lambda x: jnp.min(unsigned(x)),
    "largest of truths": lambda x: jnp.max(x > 0),
    "smallest of truths": lambda x: jax.lax.reduce_min(x > 0, (0,)),
    "larger truths": lambda x: (jnp.maximum(x > 0, x > 5), jnp.minimum(x > 0, x > 5)),
    "order of truths": lambda x: [
        f(x > 0, x > 5) for f in (jax.lax.lt, jax.lax.le, jax.lax.gt, jax.lax.ge)
    ],
    "sorted truths": lambda x: jnp.sort(x > 0),
    "product of truths": lambda x: jnp.dot(x > 0, x < 9),
    "counted truths": lambda x: (jnp.sum(x > 0), jnp.prod(x > 0), jnp.cumsum(x > 0)),
    "largest of none": lambda x: jnp.max(x[:0], initial=-7),
}

NONE = {
    "sorted": lambda x: jnp.sort(x[:0]),
    "sorted rows": lambda x: jnp.sort(x.reshape(2, 3)[:, :0], axis=0),
    "sorted columns": lambda x: jnp.argsort(x.reshape(2, 3)[:0], axis=0),
    "the largest of none": lambda x: jax.lax.top_k(x[:0], 0),
    "none of the largest": lambda x: jax.lax.top_k(x, 0),
}

INDEXED = {
    "one": lambda x, i: x[i],
    "several": lambda x, i: x[jnp.stack([i, i + 1, -i])],
    "of rows": lambda x, i: jnp.outer(x, x)[i, i + 1],
    "along": lambda x, i: jnp.take_along_axis(jnp.outer(x, x[:3]), jnp.full((1, 3), i), 0),
    "filled": lambda x, i: jnp.take(x, i, mode="fill"),
    "clipped": lambda x, i: jnp.take(x, i, mode="clip"),
    "part": lambda x, i: jax.lax.dynamic_slice(x, (i,), (3,)),
    "set": lambda x, i: x.at[i].set(7.0),
    "set several": lambda x, i: x.at[jnp.stack([i, i + 1, i])].add(x[:3]),
    "multiplied": lambda x, i: x.at[i].mul(2.0),
    "raised": lambda x, i: x.at[i].max(0.5),
    "computed": lambda x, i: x.at[i].apply(jnp.exp),
    "computed several times": lambda x, i: x.at[jnp.stack([i, 1, i])].apply(lambda y: 2 * y + 1),
    "replaced": lambda x, i: jax.lax.dynamic_update_slice(x, x[:2], (i,)),
    "rolled": lambda x, i: jnp.roll(x, i),
    "found": lambda x, i: jnp.searchsorted(jnp.cumsum(jnp.abs(x)), i.astype(x.dtype)),
    "between": lambda x, i: jnp.interp(i * 0.3, jnp.cumsum(jnp.abs(x)), x),
    "counted": lambda x, i: jnp.bincount(jnp.stack([i, i, i + 1]), length=5),
    "set in a loop": lambda x, i: jax.lax.fori_loop(
        1, i, lambda k, y: y.at[k].set(y[k - 1] + 1), x
    ),
    "switched": lambda x, i: jax.lax.switch(i, [jnp.sin, jnp.cos, jnp.exp], x),
}

MATRICES = {
    "inverse": jnp.linalg.inv,
    "determinant": jnp.linalg.det,
    "solution": lambda a: jnp.linalg.solve(a, a[0]),
    "LU": linalg.lu,
    "QR": jnp.linalg.qr,
    "QR of a tall one": lambda a: jnp.linalg.qr(a[:, :3]),
    "whole QR of a tall one": lambda a: jnp.linalg.qr(a[:, :3], mode="complete"),
    "QR of a wide one": lambda a: jnp.linalg.qr(a[:3]),
    "power": lambda a: jnp.linalg.matrix_power(a / 5, 5),
}


def filtered(x, outputs, channels, **keywords):
    """Return four images of two channels, whose filter is a part of them."""
    filters = x[: outputs * channels * 3].reshape(outputs, channels, 3)
    return jax.lax.conv_general_dilated(x.reshape(4, 2, 5), filters, (1,), "SAME", **keywords)


IMAGES = {
    "filtered": lambda x: filtered(x, 3, 2),
    "with gaps": lambda x: filtered(x, 3, 2, rhs_dilation=(2,)),
    "each channel": lambda x: filtered(x, 4, 1, feature_group_count=2),
    "groups of images": lambda x: filtered(x, 4, 2, batch_group_count=2),
}

AXES = {
    "reshaped in another order": lambda x: jax.lax.reshape(x, (4, 6), dimensions=(2, 0, 1)),
    "largest": lambda x: [jax.lax.top_k(x, 2, axis=axis) for axis in range(3)],
    "sorted": lambda x: [jax.lax.sort((jnp.round(x), x), dimension=0, num_keys=k) for k in (1, 2)],
    "cumulated": lambda x: [jax.lax.cumsum(x, axis=1, reverse=way) for way in (False, True)],
    "in the middle": lambda x: [jnp.median(x, axis=1), jnp.argmax(x, axis=1), jnp.var(x, axis=1)],
    "repeated": lambda x: [jnp.repeat(x, 2, axis=1), jnp.tile(x, (2, 1, 3)), jnp.roll(x, 1, 2)],
    "products": lambda x: jnp.einsum("abc,dbc->ad", x, x),
    "product's derivative": jax.vmap(jax.grad(lambda x: jnp.prod(1 + x)), in_axes=1),
    "mapped twice": jax.vmap(jax.vmap(lambda x: jax.lax.top_k(x, 2), 1, 1), 2, 0),
}

DERIVATIVES = {
    "gradient": jax.grad(lambda x: jnp.sum(jnp.sin(x) ** 2 * x)),
    "second": jax.hessian(lambda x: jnp.sum(x**3) * x[0]),
    "forward": jax.jacfwd(lambda x: jnp.tanh(x) * x.sum()),
    "of a scan": jax.grad(
        lambda x: jax.lax.scan(lambda c, _: (jnp.sin(c), None), x[0], None, length=9)[0]
    ),
    "computed again": jax.grad(jax.checkpoint(lambda x: jnp.sin(jnp.sin(x)).sum())),
    "of a norm": jax.grad(jnp.linalg.norm),
    "of an inverse": jax.grad(lambda x: jnp.linalg.inv(jnp.outer(x, x) + 5 * jnp.eye(6)).sum()),
    "of a relu": jax.grad(lambda x: jax.nn.relu(x).sum()),
}

RANDOM = {
    "permutation": lambda k: jax.random.permutation(k, 6),
    "choice": lambda k: jax.random.choice(k, jnp.arange(5.0), (2,)),
    "categorical": lambda k: jax.random.categorical(k, jnp.zeros(4)),
    "truncated": lambda k: jax.random.truncated_normal(k, -1, 1, (2,)),
    "in a loop": lambda k: jax.lax.fori_loop(
        0, 70, lambda _, c: (jax.random.split(c[0])[0], c[1] + jax.random.uniform(c[0])),
        (jax.random.wrap_key_data(k), 0.0),
    )[1],
}  # fmt: skip

GROUPS = {
    "one number": (UNARY, [floats(3, odd=True)]),
    "angles": (ANGLES, [floats(3) * 100]),
    "two numbers": (BINARY, [floats(3, odd=True), floats(3, seed=1, odd=True)[::-1].copy()]),
    "rows": (ROWS, [floats(6, odd=True)]),
    "nothing": (NONE, [floats(6)]),
    "indices": (INDEXED, [floats(7), wholes()]),
    "matrices": (MATRICES, [conditioned(4)]),
    "derivatives": (DERIVATIVES, [floats(6)]),
    "images": (IMAGES, [floats(40)]),
    "axes": (AXES, [floats(3, 4, 2)]),
}


def both(functions, arguments):
    """Return the results of a kernel of all functions, and those of JAX."""

    def together(*x):
        return {name: function(*x) for name, function in functions.items()}

    reasons = []
    kernel = fuse(together, on_unsupported=reasons.append)
    found = jax.jit(jax.vmap(kernel))(*arguments)
    assert not reasons
    return found, jax.jit(jax.vmap(together))(*arguments)


TOLERANCES = {"float32": (2e-5, 2e-6), "float64": (3e-14, 1e-15)}
"""Relative and absolute."""


def assert_close(found, expected):
    for name, want in expected.items():
        for one, other in zip(jax.tree.leaves(found[name]), jax.tree.leaves(want), strict=True):
            assert one.dtype == other.dtype, name
            if other.dtype.kind == "f":
                tolerances = TOLERANCES[other.dtype.name]
                np.testing.assert_allclose(one, other, *tolerances, err_msg=name)
            else:
                np.testing.assert_array_equal(one, other, err_msg=name)


@pytest.mark.parametrize("group", GROUPS)
def test_functions_of_floats(group, bits):
    functions, arguments = GROUPS[group]
    if bits == 64:
        # As by cuDNN.
        functions = {name: f for name, f in functions.items() if name != "filtered"}
    found, expected = both(functions, widened(arguments, bits))
    assert_close(found, expected)


def test_functions_of_whole_numbers(bits):
    x, y = wholes(3, low=-(2**31), high=2**31 - 1), wholes(3, low=-40, high=40, seed=1)
    x, y = widened([x, y], bits)
    x <<= bits - 32
    half = 1 << (bits - 1)
    ends = [0, 1, -1, half - 1, -half, 7, -7]
    x[: len(ends), 0], y[: len(ends), 0] = ends, ends[::-1]
    x[: len(ends), 1], y[: len(ends), 1] = ends[4], ends
    found, expected = both(WHOLE, [x, y])
    assert_close(found, expected)
    found, expected = both(WHOLE_ROWS, [x])
    assert_close(found, expected)


def test_functions_of_random_keys(bits):
    keys = np.random.default_rng(0).integers(0, 2**32, (COUNT, 2), np.uint64).astype(np.uint32)
    found, expected = both(RANDOM, [keys])
    assert_close(found, expected)


def test_a_sort_keeps_the_order_of_equal_numbers():
    x, marks = np.round(floats(9)), np.broadcast_to(np.arange(9, dtype=np.int32), (COUNT, 9))
    sort = functools.partial(jax.lax.sort, num_keys=1)
    found, expected = both({"pairs": lambda x, y: sort((x, y))}, [x, marks.copy()])
    assert_close(found, expected)


def test_the_largest_numbers_are_ordered_by_their_bits():
    rows = [[-0.0, 0.0, -0.0], [np.nan, 1, -np.nan], [-np.nan, np.inf, np.nan], [-np.inf, -3, -4]]
    functions = {
        "computed": lambda x: jax.lax.top_k(x, 3),
        "known": lambda x: [jax.lax.top_k(jnp.array(row, jnp.float32), 3) for row in rows],
    }
    found, expected = both(functions, [np.array(rows, np.float32)])
    assert_close(found, expected)


def test_operands_of_a_sort_stay_as_they_are():
    found, expected = both({"sum": lambda x: jnp.sort(x) + x}, [floats(5)])
    assert_close(found, expected)


@pytest.mark.parametrize(
    ("function", "reason"),
    [
        (lambda x: jnp.fft.rfft(x), "operation fft"),
        (lambda x: jax.lax.reduce_precision(x, 5, 10), "a rounding to 5 and 10 bits"),
        (lambda x: jnp.zeros(300).at[x[0].astype(int)].set(1.0), "the state, with 300 places"),
        (lambda x: jax.scipy.special.gammaln(x), "operation lgamma"),
    ],
)
def test_what_has_no_rule_is_named(function, reason):
    with pytest.raises(UnsupportedError, match=reason):
        scalarize(function, jax.ShapeDtypeStruct((4,), jnp.float32))
