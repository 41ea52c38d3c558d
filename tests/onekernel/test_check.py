"""The comparison of a kernel with XLA: what it calls wrong, and what it knows as round-off."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.further import slow_unless
from onekernel import KernelError, default_backend, fuse, fused, traced
from onekernel.check import check

pytestmark = pytest.mark.skipif(default_backend() is None, reason="no back end for kernels")

KEY = jax.ShapeDtypeStruct((2,), np.uint32)
SCALAR = jax.ShapeDtypeStruct((), np.float32)
VECTOR = jax.ShapeDtypeStruct((8,), np.float32)
WRONG = 1 + 1e-4
PARTICLES = 16


def compare(right, wrong, *arguments):
    """Check a kernel of one function with the other as its fallback."""
    one, other = (fuse(f, on_unsupported="raise").lowered(*arguments) for f in (wrong, right))
    kernel = dataclasses.replace(one.one, fallback=other.one.fallback)
    jaxpr = other.traced.jaxpr
    check(kernel, traced.dtypes_of(jaxpr.invars), traced.dtypes_of(jaxpr.outvars))


def gelu(x, *, root=1.0, cube=1.0, half=1.0):
    """`jax.nn.gelu`, with factors of its three coefficients."""
    inner = np.float32(root * np.sqrt(2 / np.pi)) * (x + np.float32(cube * 0.044715) * x**3)
    return np.float32(half * 0.5) * x * (1 + jnp.tanh(inner))


def tail(x, factor=1.0):
    return factor - jnp.tanh(x)


def rotation(key, wrong=False):
    found = jax.random.orthogonal(jax.random.wrap_key_data(key), 3)
    return found.at[1, 2].multiply(WRONG) if wrong else found


def total(key, factor=1.0):
    return jax.random.normal(jax.random.wrap_key_data(key), (20,)).at[3].multiply(factor).sum()


def wave(key, factor=1.0):
    return factor * jnp.sin(1e3 * jax.random.normal(jax.random.wrap_key_data(key)))


def adam(x, decay=0.9):
    def step(i, state):
        x, mean, square = state
        slope = 2 * (x - 1) + 3 * jnp.cos(3 * x)
        mean, square = decay * mean + 0.1 * slope, 0.999 * square + 0.001 * slope**2
        first, second = mean / (1 - 0.9 ** (i + 1.0)), square / (1 - 0.999 ** (i + 1.0))
        return x - 0.05 * first / (jnp.sqrt(second) + 1e-8), mean, square

    return jax.lax.fori_loop(0, 100, step, (x, jnp.zeros_like(x), jnp.zeros_like(x)))


def particle_filter(key, seen, factor=1.0):
    def step(state, y):
        x, key = state
        key, moving, choosing = jax.random.split(key, 3)
        x = 0.9 * x + jax.random.normal(moving, (PARTICLES,))
        weight = jnp.exp(-0.5 * (y - x) ** 2).at[2].multiply(factor)
        weight = weight / weight.sum()
        mean = weight @ x
        place = (jnp.arange(PARTICLES) + jax.random.uniform(choosing)) / PARTICLES
        chosen = (jnp.cumsum(weight) < place[:, None]).sum(axis=1)
        chosen = jnp.minimum(chosen, PARTICLES - 1)
        return (x[chosen], key), (mean, chosen)

    start = jnp.zeros(PARTICLES), jax.random.wrap_key_data(key)
    (x, key), (means, chosen) = jax.lax.scan(step, start, seen)
    return x, jax.random.key_data(key), means, chosen


PROGRAMS = {
    "gelu": (jax.nn.gelu, VECTOR),
    "1 - tanh": (tail, VECTOR),
    "a random rotation": (rotation, KEY),
    "a sum of random numbers": (total, KEY),
    "the sine of a large random number": (wave, KEY),
    "Adam": (adam, VECTOR),
    "a particle filter": (particle_filter, KEY, VECTOR),
}

WRONG_KERNELS = {
    "the root of gelu": ("gelu", lambda x: gelu(x, root=WRONG)),
    "the cube of gelu": ("gelu", lambda x: gelu(x, cube=WRONG)),
    "the half of gelu": ("gelu", lambda x: gelu(x, half=WRONG)),
    "the 1 of 1 - tanh": ("1 - tanh", lambda x: tail(x, WRONG)),
    "one number of a rotation": ("a random rotation", lambda key: rotation(key, wrong=True)),
    "one of the numbers of a sum": ("a sum of random numbers", lambda key: total(key, WRONG)),
    "the bits of a sum": ("a sum of random numbers", lambda key: total(key.at[1].add(1))),
    "the height of a sine": ("the sine of a large random number", lambda key: wave(key, 1.01)),
    "a rate of Adam": ("Adam", lambda x: adam(x, 0.9 * WRONG)),
    "two results of Adam": ("Adam", lambda x: tuple(adam(x)[i] for i in (0, 2, 1))),
    "one weight of a filter": (
        "a particle filter",
        lambda key, seen: particle_filter(key, seen, WRONG),
    ),
    "one index of a filter": (
        "a particle filter",
        lambda key, seen: (*(all := particle_filter(key, seen))[:3], all[3].at[4, 5].add(1)),
    ),
    "the next key of a filter": (
        "a particle filter",
        lambda key, seen: (
            (all := particle_filter(key, seen))[0],
            all[1] ^ np.uint32(1),
            *all[2:],
        ),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", PROGRAMS)
def test_round_off_is_allowed(name, monkeypatch):
    monkeypatch.setenv(fused.CHECK, "1")
    function, *shapes = PROGRAMS[name]
    fuse(function, on_unsupported="raise")(*(jnp.ones(x.shape, x.dtype) for x in shapes))


@pytest.mark.parametrize("name", slow_unless(lambda name: "filter" not in name, WRONG_KERNELS))
def test_a_wrong_kernel_is_caught(name):
    program, wrong = WRONG_KERNELS[name]
    right, *shapes = PROGRAMS[program]
    with pytest.raises(KernelError, match="of a kernel is not XLA's") as raised:
        compare(right, wrong, *shapes)
    assert raised.value.kind == "check"


def rounding_error(x):
    # What is left of 3.1 x - 2.1 x - x depends on how each product is rounded.
    return 3.1 * x - 2.1 * x - x


def test_nothing_is_said_where_round_off_decides():
    def function(sign):
        def chosen(x):
            error = sign * rounding_error(x)
            place = jnp.argmax(error)
            # Another choice changes two of 64 numbers, and not those that a third one changes.
            is_chosen = jnp.arange(64) == place
            return place, is_chosen, jnp.where(is_chosen, 2.0, x / 64), jnp.cos(x)[place], error > 0

        return chosen

    compare(function(1), function(-1), jax.ShapeDtypeStruct((64,), np.float32))


@pytest.mark.parametrize(
    ("right", "wrong"),
    [
        (jnp.argmax, jnp.argmin),
        (lambda x: x[jnp.argmax(x)], lambda x: x[jnp.argmin(x)]),
        (lambda x: x > 0.1, lambda x: x > 0.11),
        (lambda x: jnp.where(x > 0.1, 1.0, x), lambda x: jnp.where(x > 0.11, 1.0, x)),
    ],
)
def test_a_decision_that_no_round_off_changes_is_compared(right, wrong):
    with pytest.raises(KernelError, match="of a kernel is not XLA's"):
        compare(right, wrong, jax.ShapeDtypeStruct((64,), np.float32))


def test_a_number_beside_one_that_round_off_decides_is_compared():
    with pytest.raises(KernelError, match="result 1 of a kernel"):
        compare(
            lambda x: (rounding_error(x) > 0, 2 * x),
            lambda x: (rounding_error(x) > 0, 2 * WRONG * x),
            SCALAR,
        )


def test_one_huge_number_hides_no_other():
    # Some instances of 65 have a number of 1e30.
    def function(x, i):
        return jnp.where((i == 3) & (x > 0.5), 1e30, 1.0) * x

    with pytest.raises(KernelError, match="of a kernel is not XLA's"):
        compare(
            function,
            lambda x, i: function(x, i) * jnp.where(x > 0.5, 1.0, WRONG),
            SCALAR,
            jax.ShapeDtypeStruct((), np.int32),
        )
